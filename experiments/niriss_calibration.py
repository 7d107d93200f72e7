"""How NIRISS's mask lies on the detector, from a single star, beside the affine map of the JWST pipeline.

    python experiments/niriss_calibration.py --data FOLDER
    python experiments/niriss_calibration.py --data FOLDER --smoke    # one exposure and three modes

`calibrate_mask` measures the affine map from the mask as designed to where it lies. The pipeline holds such a map for
this mask, in a convention of its own; the experiment translates it and compares. The folder holds calibrated exposures
of programme 1093, from the public archive of JWST, as hd-37093_*.fits.
"""

from __future__ import annotations

import dataclasses
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from niriss_ab_dor import GAIN
from niriss_pose import MASK
from torch import Tensor

from torchmask.cli.options import ExperimentOptions
from torchmask.cli.program import run_script
from torchmask.cli.run import new_run
from torchmask.data.observe import read_observation
from torchmask.interferometry.calibration import MaskCalibration, calibrate_mask
from torchmask.observation import Observation
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.geometry import MaskGeometry


@dataclass(frozen=True, kw_only=True)
class Options(ExperimentOptions):
    """Options of the calibration."""

    data: Path = Path("niriss")
    """Folder of the exposures."""
    star: str = "hd-37093"
    """Name of the single star, whose files are <star>_*.fits."""
    exposures: int = 7
    """Number of exposures to use."""
    crop: int = 52
    """Side of the field around the star [pixels]."""
    n_modes: int = 6
    """Number of Zernike modes of every hole in each exposure."""


@dataclass(frozen=True)
class PipelineAffine:
    """The affine map of the JWST pipeline (jwst.ami.utils.Affine2d) from where a point lies to where it is designed.

    x' = mx x + sx y, y' = my y + sy x, where x and y run along the rows' and the columns' index of an image. The
    pipeline multiplies the hole centres of the design with it transposed and inverted in the exponent of a fringe, so
    that a hole lies where the inverse map takes it.
    """

    mx: float = 0.99282
    my: float = 0.99854
    sx: float = 6.186e-3
    sy: float = -7.270e-3

    def geometry(self) -> MaskGeometry:
        """Return the same map as `MaskGeometry`: x along the columns, from the design to where the mask lies.

        The pipeline first reverses x of the design and turns it by 90 degrees, which, with its axes in the order (y,
        x), turns the design by 180 degrees: that no image shows.
        """
        inverse = torch.linalg.inv(torch.tensor([[self.mx, self.sx], [self.sy, self.my]], dtype=torch.float64))
        return MaskGeometry.from_matrix(inverse.flip(0, 1))


def read_star(options: Options) -> Observation:
    """Return the exposures as one stack, each cut out around its star. Raises ValueError if there is none."""
    paths = sorted(options.data.glob(f"{options.star}_*.fits"))[: options.exposures]
    if not paths:
        raise ValueError(f"{options.data} has no {options.star}_*.fits: give the folder of the exposures with --data")
    aperture = SparseAperture.from_catalog(MASK)
    parts = [read_observation(path, aperture, gain=GAIN, crop=options.crop) for path in paths]
    valid = [torch.ones_like(part.frames, dtype=torch.bool) if part.valid is None else part.valid for part in parts]
    together = [each.expand_as(part.frames) for each, part in zip(valid, parts, strict=True)]
    return dataclasses.replace(
        parts[0],
        frames=torch.cat([part.frames for part in parts]),
        valid=torch.cat(together),
        errors=None,
        frame_numbers=(),
    )


def compare(found: MaskCalibration, told: MaskGeometry) -> list[tuple[str, float, float, float]]:
    """Name, ours, its error and the pipeline's, of what does not depend on wavelength and scale of the pixels."""
    g, errors = found.geometry, found.geometry_errors.tolist()
    ratio = g.magnification_y / g.magnification_x
    both = math.hypot(errors[1] / g.magnification_x, errors[2] / g.magnification_y)
    size = g.magnification
    return [
        ("rotation [deg]", math.degrees(g.rotation), math.degrees(errors[0]), math.degrees(told.rotation)),
        ("magnification, y over x", ratio, ratio * both, told.magnification_y / told.magnification_x),
        ("shear over magnification", g.shear / size, errors[3] / size, told.shear / told.magnification),
        ("magnification", size, size * both / 2, told.magnification),
    ]


def pixel_sides(seen: Observation) -> Tensor:
    """Sides of a pixel along x and y, over the pixel scale of the grid."""
    assert seen.sky_matrix is not None
    return torch.linalg.vector_norm(seen.sky_matrix, dim=0) / seen.grid.pixel_scale


def run(options: Options) -> None:
    """Calibrate and compare in a new folder."""
    if options.smoke:
        options = dataclasses.replace(options, exposures=1, n_modes=3, crop=40)
    seen = read_star(options)
    with new_run("niriss_calibration", options) as output:
        aperture = seen.aperture
        assert isinstance(aperture, SparseAperture)
        found = calibrate_mask(
            *(seen.frames, aperture, seen.grid),
            **{"valid": seen.valid, "pixel": seen.pixel, "n_modes": options.n_modes},
            callback=output.callback,
        )
        rows = compare(found, PipelineAffine().geometry())
        lines = [
            "# How NIRISS's mask lies on the detector",
            "",
            *(f"    {line}" for line in str(found).splitlines()),
            "",
            f"Sides of a pixel over the scale of the grid: {', '.join(f'{side:.4f}' for side in pixel_sides(seen))}.",
            "",
            "| | this library | JWST pipeline |",
            "|---|---|---|",
            *(f"| {name} | {ours:.4f} ± {error:.4f} | {told:.4f} |" for name, ours, error, told in rows),
        ]
        numbers = [dict(zip(("name", "ours", "error", "pipeline"), row, strict=True)) for row in rows]
        output.report("niriss_calibration", {"rows": numbers}, "\n".join(lines) + "\n")
        output.summary.extend(lines[2:])


def main(argv: Sequence[str] | None = None) -> int:
    """Return the exit status."""
    return run_script("niriss_calibration", run, Options, __doc__, argv)


if __name__ == "__main__":
    sys.exit(main())

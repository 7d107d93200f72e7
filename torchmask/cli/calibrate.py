"""`torchmask calibrate`: how a mask lies, from exposures of a star."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import tyro

from torchmask.cli.options import RunOptions
from torchmask.cli.run import new_run
from torchmask.cli.stacks import StackOptions, read_stack
from torchmask.design.manufacture import save_json
from torchmask.interferometry.calibration import MaskCalibration, calibrate_mask
from torchmask.io import write_json
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.pixel import SquarePixel


@dataclass(frozen=True, kw_only=True)
class Options(StackOptions, RunOptions):
    """Measure how a mask lies, turned, magnified or mirrored, on short exposures of a star or pinhole.

    The exposures are an .npz file or FITS files, of one star through the mask, in any turbulence. FITS files need
    --mask. Writes mask.json, the mask where it lies, for --mask of `torchmask restore`, and calibration.json with all
    estimates and their errors to a new folder.
    """

    stacks: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Exposures of the star, .npz or .fits; several FITS files are one stack."""
    pixel_fill: float | None = None
    """Part of the area of its pitch in which a pixel is sensitive, 1 for gapless pixels; None: pixels are points."""
    n_modes: int = 6
    """Zernike modes per hole of each frame, Noll 1 (piston) to this."""


def run(options: Options) -> None:
    """Measure, write and print."""
    if not options.stacks:
        raise ValueError("there is no star to calibrate with: give .npz or FITS files")
    seen = read_stack(options.stacks, options)
    if not isinstance(seen.aperture, SparseAperture):
        raise ValueError("--mask is a full pupil: only a mask can be calibrated, by its fringes")
    pixel = None if options.pixel_fill is None else SquarePixel(options.pixel_fill)
    with new_run("calibrate", options) as output:
        found = calibrate_mask(
            seen.frames,
            seen.aperture,
            seen.grid,
            valid=seen.valid,
            readout_noise=seen.readout_noise or 0.0,
            pixel=pixel,
            n_modes=options.n_modes,
            callback=output.callback,
        )
        save_json(output.directory / "mask.json", found.aperture, seen.grid.wavelength)
        write_json(output.directory / "calibration.json", estimates(found, options.stacks))
        output.summary.append(str(found))


def estimates(found: MaskCalibration, files: Sequence[Path]) -> dict[str, Any]:
    """What calibration.json says: angles in rad, places of the star in pixels."""
    names = ("rotation", "magnification_x", "magnification_y", "shear")
    return {
        "stars": [str(file) for file in files],
        **asdict(found.geometry),
        "errors": dict(zip(names, found.geometry_errors.tolist(), strict=True)),
        "mirror_seen": found.mirror_seen,
        "transmissions": found.transmissions.tolist(),
        "transmission_errors": found.transmission_errors.tolist(),
        "offset": found.offset.tolist(),
        "offset_errors": found.offset_errors.tolist(),
        "explained": found.explained.tolist(),
    }

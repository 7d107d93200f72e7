"""`torchmask calibrate`: measure the geometry of a mask from exposures of a star."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import tyro

from torchmask.cli.options import RunOptions
from torchmask.cli.program import NOT_EXPLAINED
from torchmask.cli.run import Run, new_run
from torchmask.cli.stacks import StackOptions, read_stack
from torchmask.design.manufacture import save_json
from torchmask.instrument.instrument import Instrument
from torchmask.interferometry.calibration import MaskCalibration, calibrate_mask
from torchmask.io import write_json
from torchmask.observation import Observation
from torchmask.optics.aperture import SparseAperture
from torchmask.record import Callback


@dataclass(frozen=True, kw_only=True)
class Options(StackOptions, RunOptions):
    """Measure rotation, magnification and mirroring of a mask on short exposures of a star or pinhole.

    The exposures are an .npz file or FITS files, of one star through the mask, in any turbulence. FITS files need
    --mask. Writes mask.json, the mask with its measured geometry, for --mask of `torchmask restore`, calibration.json
    with all estimates and their errors, and with --instrument instrument.json, to a new folder. The exit status is 3 if
    a star and the mask do not explain the exposures.
    """

    stacks: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Exposures of the star, .npz or .fits; several FITS files are one stack."""
    estimate_pixel: tyro.conf.FlagCreatePairsOff[bool] = False
    """Estimate the sensitive fraction of a pixel too; exposures must be short, as motion looks like larger pixels."""
    n_modes: int = 6
    """Number of Zernike modes per hole and frame, from Noll mode 1 (piston)."""

    @classmethod
    def of_instrument(cls, known: Instrument) -> Options:
        """Return the options that an instrument sets: none, as it completes what the exposures say."""
        return cls()


def run(options: Options) -> int:
    """Measure the geometry, write it and print it; return the exit status."""
    if not options.stacks:
        raise ValueError("no exposures of a star are given: give .npz or FITS files")
    require_one_pixel(options, options.estimate_pixel)
    seen = read_stack(options.stacks, options)
    with new_run("calibrate", options) as output:
        output.keep_instrument(options.known_instrument())
        found = calibrate_on(seen, options.estimate_pixel, options.n_modes, output.callback)
        write_calibration(output, found, options.stacks, seen.grid.wavelength)
    return 0 if found.verdict is None or found.verdict.explained else NOT_EXPLAINED


def require_one_pixel(options: StackOptions, estimate: bool) -> None:
    """Raise ValueError if the blur by pixels is both given and to be estimated."""
    if estimate and options.pixel_fill is not None:
        raise ValueError("--pixel-fill says how large pixels are, and --estimate-pixel asks for it: give one of them")
    if estimate and options.jitter:
        raise ValueError("--estimate-pixel does not tell jitter from large pixels: give --jitter with --pixel-fill")


def calibrate_on(
    star: Observation,
    estimate_pixel: bool = False,
    n_modes: int = 6,
    callback: Callback | None = None,
) -> MaskCalibration:
    """Measure the mask's geometry on exposures of a star. Raises ValueError as `calibrate_mask` or for a full pupil."""
    if not isinstance(star.aperture, SparseAperture):
        raise ValueError("--mask is a full pupil: only a mask has fringes, which calibration needs")
    found = calibrate_mask(
        star.frames,
        star.aperture,
        star.grid,
        valid=star.valid,
        readout_noise=star.readout_noise or 0.0,
        pixel=None if estimate_pixel else star.pixel,
        estimate_pixel=estimate_pixel,
        n_modes=n_modes,
        callback=callback,
    )
    return replace(found, frame_numbers=star.frame_numbers)


def read_star(path: Path, options: StackOptions, estimate_pixel: bool) -> MaskCalibration:
    """Measure the mask's geometry on a file with a star. Raises ValueError, which names --star, if that fails."""
    try:
        return calibrate_on(read_stack([path], options), estimate_pixel)
    except ValueError as error:
        raise ValueError(f"--star {path}: {error}") from error


def write_calibration(output: Run, found: MaskCalibration, files: Sequence[Path], wavelength: float) -> None:
    """Write mask.json, for the wavelength [m] of the exposures, and calibration.json, and add to the summary."""
    save_json(output.directory / "mask.json", found.aperture, wavelength)
    write_json(output.directory / "calibration.json", estimates(found, files))
    output.summary.append(str(found))


def estimates(found: MaskCalibration, files: Sequence[Path]) -> dict[str, Any]:
    """Return the content of calibration.json, with angles in rad and positions of the star in pixels."""
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
        "frame_numbers": list(found.frame_numbers),
        "explained": found.explained.tolist(),
        "verdict": None if found.verdict is None else found.verdict.to_json(),
        "fill_factor": found.fill_factor,
        "fill_factor_error": found.fill_factor_error,
    }

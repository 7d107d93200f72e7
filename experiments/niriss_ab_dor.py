"""AB Dor and its faint companion, from nine exposures of JWST/NIRISS through its seven-hole mask.

    python experiments/niriss_ab_dor.py --data FOLDER
    python experiments/niriss_ab_dor.py --data FOLDER --smoke    # everything, small, in seconds

Filter F480M as a few wavelengths, hexagonal holes, aberrations common to all exposures plus small ones of each, bad
pixels left out. The calibrator HD 37093, a single star, goes the same way: it tells how the mask lies on the detector,
how far the model can be trusted, and how faint a companion would be found. Beside the restored images, star and
companion are fitted with everything else (`torchmask.interferometry.companion_fit`). Tables, figures and TensorBoard
events go to a new folder.

The folder holds calibrated exposures of programme 1093, from the public archive of JWST, as ab-dor_*.fits and
hd-37093_*.fits with extensions SCI, ERR and DQ.
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from niriss_pose import MASK, Pose, effective_wavelengths, find_pose, placed_mask
from niriss_report import brightest_beside, exposures_figure, findings, images_figure, search_figure, table, upright
from rich.console import Console
from torch import Tensor

from torchmask.cli.options import ExperimentOptions
from torchmask.cli.program import run_script
from torchmask.cli.run import Run, new_run
from torchmask.data.observe import read_observation
from torchmask.grid import Grid
from torchmask.interferometry.companion import CompanionModel, Exposures
from torchmask.interferometry.companion_errors import (
    MEASURED,
    differences_over_errors,
    injection_errors,
    measured_companion,
    polar,
    rotation_towards,
)
from torchmask.interferometry.companion_fit import CompanionFit, fit_companion, search_companions, unexplained_flux
from torchmask.interferometry.companion_limits import DetectionLimits, detection_limits, search_offsets
from torchmask.io import save_npz
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.band import Band
from torchmask.record import Callback, label_stage
from torchmask.restoration.myopic import MyopicDeconvolution
from torchmask.restoration.result import RestorationResult

GAIN = 1.61  # electrons per DN: NIRISS detector performance, JWST user documentation
FLUX_ERROR = 0.02  # of the model, before the single star tells


@dataclass(frozen=True, kw_only=True)
class Options(ExperimentOptions):
    """Everything the result depends on."""

    data: Path = Path("niriss")
    """Folder of the exposures."""
    target: str = "ab-dor"
    """Name of the target, whose files are <target>_*.fits."""
    calibrator: str = "hd-37093"
    """Name of the calibrator, a single star observed in the same way; its files are <calibrator>_*.fits."""
    crop: int = 48
    """Side of the field around the star [pixels]."""
    radius: float = 16.0
    """Radius around the star of the pixels in the fits: the bright part of the image of one hole [pixels]."""
    n_wavelengths: int = 3
    """Number of wavelengths in the filter, with equal weights."""
    static_modes: int = 10
    """Number of Zernike modes of every hole that are common to all exposures."""
    r0: float = 20.0
    """Fried parameter that represents the small aberrations of each exposure [m]: 20 m for 0.07 rad rms over a hole."""
    max_iterations: int = 3200
    """Maximum number of iterations over all starts of a restoration."""
    n_injections: int = 8
    """Number of companions injected beside the calibrator, all around it, to measure the errors."""
    step: float = 0.05
    """Step of the search for companions [arcsec]."""


def read(folder: Path, star: str, crop: int) -> tuple[Exposures, Grid]:
    """Return the exposures of a star, cut out around it, with the pixels' directions on the sky."""
    paths = sorted(folder.glob(f"{star}_*.fits"))
    if not paths:
        raise ValueError(f"{folder} has no {star}_*.fits: give the folder of the exposures with --data")
    aperture = SparseAperture.from_catalog(MASK)
    parts = [read_observation(path, aperture, gain=GAIN, crop=crop) for path in paths]
    try:
        return Exposures.from_observations(parts), parts[0].grid
    except ValueError as error:
        raise ValueError(f"{folder}, {star}_*.fits: {error}") from error


def make_model(options: Options, pose: Pose, grid: Grid, exposures: Exposures, flux_error: float) -> CompanionModel:
    aperture = placed_mask(pose, grid, exposures.to_pixels)
    band = Band.of(effective_wavelengths(pose, options.n_wavelengths))
    return CompanionModel(aperture, grid, options.static_modes, band, options.radius, flux_error)


@dataclass(frozen=True, eq=False)
class Calibration:
    """What a single star tells: the mask on the detector, the model and how far it can be trusted.

    contrast : of the companion that is found at each of `offsets`, where there is none
    """

    pose: Pose
    model: CompanionModel
    exposures: Exposures
    star: CompanionFit
    offsets: Tensor
    contrast: Tensor
    limits: DetectionLimits


def calibrate(
    options: Options, exposures: Exposures, grid: Grid, callback: Callback
) -> tuple[Calibration, list[dict[str, Any]]]:
    """Everything that is known before the target is looked at, and the orientations that were tried."""

    def guess(pose: Pose, some: Exposures) -> CompanionModel:
        return make_model(options, pose, grid, some, FLUX_ERROR)

    pose, tried = find_pose(guess, exposures, callback)
    model = guess(pose, exposures)
    star = fit_companion(model, exposures, callback=label_stage(callback, "calibrator"))
    model = make_model(options, pose, grid, exposures, unexplained_flux(model, exposures, star))
    star = fit_companion(
        model, exposures, start=star.parameters, callback=label_stage(callback, f"{options.calibrator}_weighted")
    )
    offsets = search_offsets(options.step)
    contrast, _ = search_companions(model, exposures, star, offsets)
    return Calibration(pose, model, exposures, star, offsets, contrast, detection_limits(offsets, contrast)), tried


def characterise(
    options: Options,
    known: Calibration,
    grid: Grid,
    target: Exposures,
    alone: CompanionFit,
    start: Tensor,
    callback: Callback,
) -> tuple[CompanionFit, dict[str, Any]]:
    """Return the companion near `start`, its errors, and whether the two halves of the exposures agree on it."""
    fit = fit_companion(known.model, target, start, alone.parameters, callback=label_stage(callback, "companion"))
    wrong, recovered = injection_errors(
        known.model, known.exposures, known.star, fit.companion, options.n_injections, options.step, callback
    )
    fewer = dataclasses.replace(options, static_modes=max(3, options.static_modes - 4))
    simpler = make_model(fewer, known.pose, grid, target, known.model.flux_error)
    plain = fit_companion(simpler, target, callback=label_stage(callback, "fewer_modes_star"))
    refit = fit_companion(simpler, target, start, plain.parameters, callback=label_stage(callback, "fewer_modes"))
    changed = refit.companion
    # What the calibrator shows, and what a choice of ours changes.
    floor = torch.hypot(wrong.square().mean(0).sqrt(), rotation_towards(fit.companion) @ (changed - fit.companion))
    halves = []
    for first in (0, 1):
        chosen = slice(first, None, 2)
        own, labelled = alone.parameters.of_exposures(chosen), label_stage(callback, f"half_{first + 1}")
        half = fit_companion(known.model, target[chosen], start, own, callback=labelled)
        halves.append(measured_companion(half, floor))
    rest, _ = search_companions(known.model, target, fit, known.offsets)
    return fit, {
        "companion": measured_companion(fit, floor),
        "fewer_modes": polar(changed),
        "injections": recovered,
        "halves": halves,
        "half_differences": differences_over_errors(*halves),
        "rest": rest,
        "rest_over_limit": float((rest / known.limits(known.offsets)).max()),
    }


def restore(options: Options, pose: Pose, grid: Grid, exposures: Exposures, callback: Callback) -> RestorationResult:
    """Return the image, without being told that there is a star or a companion."""
    # Its coarser pupil samples narrow the image of a hole, as larger holes would: the nominal size fits.
    pose = dataclasses.replace(pose, hole=Pose.hole)
    method = MyopicDeconvolution(
        placed_mask(pose, grid, exposures.to_pixels),
        grid,
        n_modes=3,
        r0=options.r0,
        wavelengths=effective_wavelengths(pose, options.n_wavelengths),
        static_modes=options.static_modes,
        max_iterations=options.max_iterations,
    )
    return method.restore(exposures.frames, valid=exposures.valid, callback=callback)


def analyse(options: Options, stars: dict[str, tuple[Exposures, Grid]], output: Run) -> dict[str, Any]:
    """Everything, calibrator first; figures and restored images go to `output`."""
    callback, log = output.callback, output.logger
    (target, grid), (single, single_grid) = (stars[name] for name in (options.target, options.calibrator))
    known, tried = calibrate(options, single, single_grid, callback)
    log.table("orientation", tried)
    limit = known.limits(known.offsets)

    alone = fit_companion(known.model, target, callback=label_stage(callback, "star"))
    contrast, noise = search_companions(known.model, target, alone, known.offsets)
    best = int((contrast / limit).argmax())
    calibrator_best = int((known.contrast / limit).argmax())
    results: dict[str, Any] = {
        "pose": known.pose,
        "orientations_tried": tried,
        "flux_error": known.model.flux_error,
        "calibrator": {
            "chi_square": known.star.chi_square.tolist(),
            "limits": {
                "separation": known.limits.separation.tolist(),
                "magnitude_difference": (-2.5 * np.log10(known.limits.contrast)).tolist(),
            },
            "highest_over_limit": float((known.contrast / limit)[calibrator_best]),
            "highest_at": polar(torch.cat([known.contrast[calibrator_best, None], known.offsets[calibrator_best]])),
        },
        "found": bool(contrast[best] > limit[best]),
        "highest_over_limit": float((contrast / limit)[best]),
        "highest_significance": float(contrast[best] / noise[best]),
        "companion": None,
    }
    maps, fit = {options.target: contrast, options.calibrator: known.contrast}, alone
    if results["found"]:
        start = torch.cat([contrast[best, None], known.offsets[best]])
        fit, measured = characterise(options, known, grid, target, alone, start, callback)
        maps[f"{options.target}, companion taken out"] = measured.pop("rest")
        results |= measured
    marks = [polar(fit.companion)] if results["found"] else []
    log.figure("search", search_figure(known.offsets, maps, known.limits, marks))
    log.figure("exposure", exposures_figure(target, fit, options.radius))

    images, results["restored"] = {}, {}
    for name, (exposures, its_grid) in stars.items():
        result = restore(options, known.pose, its_grid, exposures, label_stage(callback, name))
        seen = brightest_beside(result.object, exposures.to_pixels)
        images[name] = upright(result.object, seen["star"], exposures.to_pixels)
        results["restored"][name] = seen | {"summary": result.summary()}
        save_npz(output.directory / f"{name}.npz", {"object": result.object, "coefficients": result.coefficients})
    log.figure("restored", images_figure(images, marks))
    return results


def run(options: Options) -> None:
    """Analyse both stars in a new folder."""
    if options.smoke:
        options = dataclasses.replace(
            options, crop=32, n_wavelengths=1, static_modes=3, radius=12.0, max_iterations=20, n_injections=1, step=0.1
        )
    stars = {name: read(options.data, name, options.crop) for name in (options.target, options.calibrator)}
    if options.smoke:
        stars = {name: (exposures[:2], grid) for name, (exposures, grid) in stars.items()}
    with new_run("niriss_ab_dor", options) as output:
        results = analyse(options, stars, output)
        lines = findings(options.target, options.calibrator, results)
        output.report("results", results | {"findings": lines}, "\n\n".join(lines))
        if results["companion"] is not None:
            for name in MEASURED:
                output.logger.scalar(f"companion/{name}", results["companion"][name])
        output.summary.extend(lines)
    if results["companion"] is not None:
        Console().print(table(results))


def main(argv: Sequence[str] | None = None) -> int:
    """Return the exit status."""
    return run_script("niriss_ab_dor", run, Options, __doc__, argv)


if __name__ == "__main__":
    sys.exit(main())

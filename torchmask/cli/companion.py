"""`torchmask companion`: search for a companion of a star in squared visibilities and closure phases."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import tyro
from torch import Tensor

from torchmask.cli.options import RunOptions
from torchmask.cli.program import NOT_EXPLAINED
from torchmask.cli.run import new_run
from torchmask.grid import ARCSEC, MAS
from torchmask.interferometry.companion_errors import MEASURED, polar, rotation_towards
from torchmask.interferometry.companion_limits import MOSTLY, SIGNIFICANCE, DetectionLimits
from torchmask.interferometry.companion_map import map_companions, raster, rival_place
from torchmask.interferometry.measurements import Measurements, join
from torchmask.interferometry.oifits_reader import load_oifits
from torchmask.interferometry.pair_fit import PairFit, PairVerdict, fit_pair
from torchmask.interferometry.pair_limits import pair_limits
from torchmask.io import save_npz, write_json
from torchmask.viz.companion import companion_figure


@dataclass(frozen=True, kw_only=True)
class Options(RunOptions):
    """Search for a companion of a star in OIFITS files, and give the contrasts that would have been detected.

    The files are those of `torchmask restore --oifits` or of any other program; several are analysed jointly. The
    command writes companion.json, the map of all positions tried (companion.npz) and a figure to a new folder. The exit
    status is 3 if neither a star and one companion nor a uniform disc explains the measurements.
    """

    files: tyro.conf.Positional[tuple[Path, ...]] = ()
    """OIFITS files of the star that may have a companion."""
    star: tuple[Path, ...] = ()
    """OIFITS files of a calibrator star: one for each of the files, or one for all. Without it the files
    must be calibrated already."""
    target: str | None = None
    """Name of the target, for files with several."""
    star_target: str | None = None
    """Name of the calibrator star, for files of --star with several targets."""
    star_diameter_mas: tuple[float, ...] = ()
    """Angular diameters of the calibrator stars, uniform discs [mas]: one for each file of --star, or one for all.
    Without them they are points."""
    star_diameter_error_mas: tuple[float, ...] = ()
    """Rms errors of those diameters [mas], as many."""
    closures_only: tyro.conf.FlagCreatePairsOff[bool] = False
    """Ignore the squared visibilities, since closure phases alone need no calibrated contrast."""
    least_arcsec: float | None = None
    """Smallest separation to try [arcsec]; None: half the period of the finest fringe."""
    most_arcsec: float | None = None
    """Largest separation to try [arcsec]; None: half the period of the widest fringe."""


def run(options: Options) -> int:
    """Read the files, search, and write and print the results; return the exit status."""
    measured = read_measurements(options)
    least, most = (None if value is None else value * ARCSEC for value in (options.least_arcsec, options.most_arcsec))
    try:
        offsets = raster(measured, least, most)
    except ValueError as error:
        raise ValueError(f"--least-arcsec, --most-arcsec: {error}") from error
    with new_run("companion", options) as output:
        found = map_companions(measured, offsets)
        fit = fit_pair(measured, found.best, least, most)
        limits = pair_limits(measured, fit, offsets, measured.finest)
        rival = rival_place(measured, found, fit) if fit.detected else None
        sides = len(measured.closure_phases) > 0
        numbers = {
            "files": [str(path) for path in options.files],
            "stars": [str(path) for path in options.star],
            "verdict": fit.verdict.value,
            "explained": fit.explained,
            "detected": fit.detected,
            "companion": describe(fit),
            "disc": describe_disc(fit),
            "rival": None if rival is None else {**polar(rival[0]), "chi_square": rival[1]},
            "side_known": sides,
            "limits": dataclasses.asdict(limits),
        }
        write_json(output.directory / "companion.json", numbers)
        arrays = {
            name: getattr(found, name) for name in ("offsets", "contrast", "errors", "chi_square", "significance")
        }
        save_npz(output.directory / "companion.npz", arrays)
        output.logger.figure("companion", companion_figure(found, limits))
        output.logger.conclude(explained=fit.explained, detected=fit.detected)
        if not options.star and len(measured.vis2):
            output.summary.append(
                "without --star, |V|^2 are taken as calibrated: losses of contrast look like companions"
            )
        output.summary.extend(summary(fit, limits, sides, rival))
    return 0 if fit.explained else NOT_EXPLAINED


def read_measurements(options: Options) -> Measurements:
    """Read and join all files, calibrated by the star. Raises ValueError, which names the file, for unusable ones."""
    if not options.files:
        raise ValueError("there are no files to search: give OIFITS files")
    if len(options.star) not in (0, 1, len(options.files)):
        raise ValueError(
            f"--star names {len(options.star)} files for {len(options.files)} of the object: give one for each, or one "
            "for all"
        )
    stars = [read_star(path, options.star_target) for path in options.star]
    sizes = one_for_each("--star-diameter-mas", options.star_diameter_mas, len(stars))
    errors = one_for_each("--star-diameter-error-mas", options.star_diameter_error_mas, len(stars))
    parts = []
    for number, path in enumerate(options.files):
        seen = load_oifits(path, options.target)
        if stars:
            star = number if len(stars) > 1 else 0
            try:
                seen = seen.calibrate(stars[star], MAS * sizes[star], MAS * errors[star])
            except ValueError as error:
                raise ValueError(f"--star {options.star[star]} and {path}: {error}") from error
        parts.append(seen.closures_only() if options.closures_only else seen)
    if options.closures_only and not any(len(part.closure_phases) for part in parts):
        raise ValueError("--closures-only: the files have no closure phases")
    return join(parts)


def one_for_each(option: str, values: tuple[float, ...], count: int) -> tuple[float, ...]:
    """Return as many values as stars: those given, one for all, or zeros. Raises ValueError for another number."""
    if len(values) not in (0, 1, count) or (values and not count):
        raise ValueError(
            f"{option} has {len(values)} values for {count} files of --star: give one for each, or one for all"
        )
    return values if len(values) == count else (values or (0.0,)) * count


def read_star(path: Path, target: str | None) -> Measurements:
    """Read a file of the calibrator star. Raises ValueError, which names the option."""
    try:
        return load_oifits(path, target)
    except ValueError as error:
        raise ValueError(f"--star, --star-target: {error}") from error


def describe(fit: PairFit) -> dict[str, Any]:
    """Return the companion of a fit with its errors, in mas, degrees and magnitudes."""
    rotation = rotation_towards(fit.companion)
    contrast, along, across = (rotation @ fit.covariance @ rotation.T).diagonal().sqrt().tolist()
    radius = float(torch.linalg.vector_norm(fit.companion[1:]))
    share = contrast / abs(float(fit.companion[0]))
    errors = (along / MAS, math.degrees(across / radius), 2.5 / math.log(10) * share)
    return {
        "contrast": float(fit.companion[0]),
        "contrast_error": contrast,
        **polar(fit.companion),
        "errors": dict(zip(MEASURED, errors, strict=True)),
        "significance": fit.significance,
        "chi_square": fit.chi_square,
        "chi_square_limit": fit.limit,
        "chi_square_without": fit.star_chi_square,
        "degrees_of_freedom": fit.degrees_of_freedom,
    }


def describe_disc(fit: PairFit) -> dict[str, float]:
    """Return the uniform disc that fits best, in mas."""
    disc = fit.disc
    return {"diameter": disc.diameter / MAS, "diameter_error": disc.error / MAS, "chi_square": disc.chi_square}


def summary(
    fit: PairFit, limits: DetectionLimits, side_known: bool, rival: tuple[Tensor, float] | None = None
) -> Sequence[str]:
    """Return the lines to print; limits only if the measurements are explained, as they rest on the residuals.

    A `rival` is a companion elsewhere that fits as well, and its chi-square.
    """
    lines = verdict_lines(fit)
    if not fit.explained:
        return lines
    if not side_known:
        lines.append("without closure phases, a companion on the opposite side of the star fits equally well")
    if rival is not None:
        place, contrast = polar(rival[0]), float(rival[0][0])
        lines.append(
            f"the place is not certain: {contrast:.3g} of the star's light {place['separation']:.4g} mas away at "
            f"{place['position_angle']:.4g} deg leave a chi-square of {rival[1]:.4g}"
        )
    return [*lines, *limit_lines(limits)]


def verdict_lines(fit: PairFit) -> list[str]:
    """Return what the fit says, with the chi-squares of its rivals."""
    seen = describe(fit)
    errors, freedom = seen["errors"], f"of {fit.degrees_of_freedom} degrees of freedom"
    where = (
        f"of {seen['contrast']:.3g} +- {seen['contrast_error']:.2g} of the star's light, "
        f"{seen['separation']:.4g} +- {errors['separation']:.2g} mas from it at "
        f"{seen['position_angle']:.4g} +- {errors['position_angle']:.2g} deg, north through east"
    )
    least, most = (f"{value / MAS:.4g} mas" for value in fit.separations)
    disc = f"a uniform disc of {fit.disc.diameter / MAS:.4g} +- {fit.disc.error / MAS:.2g} mas"
    rivals = f"{fit.disc.chi_square:.4g} for {disc}, {fit.star_chi_square:.4g} for the star alone"
    if fit.verdict is PairVerdict.NOT_EXPLAINED:
        return [
            f"not explained: a star and one companion leave a chi-square of {fit.chi_square:.4g} {freedom}, and "
            f"{disc} {fit.disc.chi_square:.4g}; up to {fit.limit:.4g} counts as explained; check that the star has one "
            f"companion at most, within {most} (--most-arcsec looks farther), that --star is a point seen through the "
            "same mask, and the errors in the files",
            f"the companion that fits best, which the measurements contradict, is {where}",
        ]
    if fit.verdict is PairVerdict.RESOLVED:
        return [
            f"resolved, or a pair closer than {least}: {disc} leaves a chi-square of {fit.disc.chi_square:.4g}, the "
            f"star alone {fit.star_chi_square:.4g}",
            f"the companion that fits best leaves {fit.chi_square:.4g} {freedom}, and is {where}",
        ]
    head = {
        PairVerdict.COMPANION: "a companion",
        PairVerdict.NONE: f"no companion above {SIGNIFICANCE:g} standard errors; the likeliest is",
        PairVerdict.OUTSIDE: f"a pair closer than {least}, which --least-arcsec looks for, or a star that is resolved "
        "but no uniform disc; what fits best is a companion",
    }[fit.verdict]
    if fit.verdict is PairVerdict.OUTSIDE and fit.separation > fit.separations[1]:
        head = f"no companion within {most}: --most-arcsec looks farther, where what fits best is one"
    if seen["contrast"] <= 0:
        head = "no companion; what fits best is one of negative light, as fringes stronger than a star's make it,"
    return [
        f"{head} {where} ({fit.significance:.1f} standard errors; chi-square {fit.chi_square:.4g} {freedom}, {rivals})"
    ]


def limit_lines(limits: DetectionLimits) -> list[str]:
    """Return the faintest companion that would be found, at each separation."""
    lines = []
    for place, contrast, error in zip(limits.separation, limits.contrast, limits.errors, strict=True):
        found = (
            f"a companion of {contrast:.2g} +- {error:.1g} of the star's light would be found half of the time, one of "
            f"{MOSTLY * contrast:.2g} in nine of ten"
        )
        if contrast > 1:
            found = "a companion would not be found everywhere: at some places its fringes are those of the star alone"
        lines.append(f"  at {1000 * place:.4g} mas {found}")
    return lines

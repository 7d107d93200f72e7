"""AB Dor and its faint companion, from nine exposures of JWST/NIRISS through its seven-hole mask.

    python experiments/niriss_ab_dor.py --data FOLDER
    python experiments/niriss_ab_dor.py --data FOLDER --smoke    # everything, small, in seconds

Filter F480M as a few wavelengths, hexagonal holes, aberrations common to all exposures plus small ones of each, bad
pixels left out. The calibrator HD 37093, a single star, goes the same way: it tells how the mask lies on the detector,
how far the model can be trusted, and how faint a companion would be found. Beside the restored images, star and
companion are fitted with everything else (`companion_fit`, `companion_errors`). Tables, figures and TensorBoard events
go to a new folder, runs/<name>/.

The folder holds calibrated exposures of programme 1093, from the public archive of JWST, as ab-dor_*.fits and
hd-37093_*.fits with extensions SCI, ERR and DQ.
"""

from __future__ import annotations

import dataclasses
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from companion_errors import (
    MEASURED,
    Limits,
    agreement,
    detection_limits,
    injection_errors,
    measurement,
    places,
    polar,
    turn,
)
from companion_fit import CompanionModel, Exposures, Fit
from niriss_report import exposures_figure, findings, images_figure, search_figure, table, upright
from rich.console import Console
from torch import Tensor

from torchmask.data.observe import read_observation
from torchmask.grid import ARCSEC, Grid
from torchmask.io import save_npz, write_json
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.band import FILTERS
from torchmask.progress import Progress
from torchmask.record import Callback, Record, fan_out
from torchmask.restoration.myopic import MyopicDeconvolution
from torchmask.restoration.result import RestorationResult
from torchmask.tracking import RunLogger

MASK, FILTER = "jwst_niriss_ami_7", FILTERS[("NIRISS", "F480M")]  # (wavelength, width) [m], its source beside it
GAIN = 1.61  # electrons per DN: NIRISS detector performance, JWST user documentation


@dataclass(frozen=True)
class Config:
    """Everything the result depends on."""

    data: Path = Path("niriss")
    """Folder of the exposures."""
    target: str = "ab-dor"
    """Files of the star are <target>_*.fits."""
    calibrator: str = "hd-37093"
    """Files of the single star, observed in the same way."""
    crop: int = 48
    """Side of the field around the star [pixels]."""
    radius: float = 16.0
    """Pixels this far from the star take part in the fits: the bright part of the image of one hole."""
    n_wavelengths: int = 3
    """In the filter, with equal weights."""
    static_modes: int = 10
    """Zernike modes of every hole that are common to all exposures."""
    r0: float = 20.0
    """Of the small aberrations of each exposure, as if they were turbulence [m]: 0.07 rad rms over a hole."""
    max_iterations: int = 800
    """Of the restorations."""
    n_injections: int = 8
    """Companions put beside the calibrator, around the clock, to see how well they are found."""
    step: float = 0.05
    """Of the search for companions [arcsec]."""
    smoke: bool = False
    """Everything small, to see that it runs."""
    name: str | None = None
    """Folder of the run below `runs`; None: date and time."""
    runs: Path = Path("runs")
    """Where run folders are made."""


@dataclass(frozen=True)
class Pose:
    """How the mask lies on the detector."""

    mirrored: bool = False
    rotation: float = 0.0  # [deg], from x to y of the detector
    magnification: float = 1.0  # of the pupil in units of the wavelength: stands for the effective wavelength
    hole: float = 0.80  # [m] flat to flat


def read(folder: Path, star: str, crop: int) -> tuple[Exposures, Grid]:
    """The exposures of a star, cut out around it, with the pixels' directions on the sky."""
    paths = sorted(folder.glob(f"{star}_*.fits"))
    if not paths:
        raise ValueError(f"{folder} has no {star}_*.fits: give the folder of the exposures with --data")
    aperture = SparseAperture.from_catalog(MASK)
    parts = [read_observation([path], aperture, gain=GAIN, crop=crop) for path in paths]
    matrices = [part.sky_matrix for part in parts]
    if any(matrix is None for matrix in matrices):
        raise ValueError(f"{folder}: the headers of {star}_*.fits have no CD matrix, which tells where north is")
    to_pixels = np.stack([np.linalg.inv(np.array(matrix))[::-1] for matrix in matrices])
    columns = {name: [getattr(part, name) for part in parts] for name in ("frames", "errors", "valid")}
    frames, errors, valid = (torch.cat(values) for values in columns.values())
    return Exposures(frames.double(), errors.double(), valid, torch.from_numpy(to_pixels)), parts[0].grid


def optics(config: Config, pose: Pose, grid: Grid, to_pixels: Tensor) -> tuple[SparseAperture, list[float]]:
    """The mask on the detector's axes, whose pixels are a little oblong, and the wavelengths."""
    mask = SparseAperture.from_catalog(MASK, mirrored=pose.mirrored)
    angle = math.radians(pose.rotation)
    turn = torch.tensor([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]], dtype=torch.float64)
    pixel = torch.linalg.vector_norm(torch.linalg.inv(to_pixels[0]), dim=0).flip(0)  # sides along x and y [rad]
    centers = mask.centers @ turn.T * (pixel / grid.pixel_scale)
    hexagon = SparseAperture(centers, pose.hole, mask.mask_diameter, "hexagon", mask.orientation + angle)
    middle, width = FILTER
    places = [(i + 0.5) / config.n_wavelengths - 0.5 for i in range(config.n_wavelengths)]
    return hexagon, [(middle + width * place) / pose.magnification for place in places]


def make_model(config: Config, pose: Pose, grid: Grid, exposures: Exposures, flux_error: float) -> CompanionModel:
    aperture, wavelengths = optics(config, pose, grid, exposures.to_pixels)
    weights = [1.0] * len(wavelengths)
    return CompanionModel(aperture, grid, config.static_modes, wavelengths, weights, config.radius, flux_error)


def find_pose(
    config: Config, grid: Grid, exposures: Exposures, callback: Callback
) -> tuple[Pose, list[dict[str, Any]]]:
    """How the mask lies on the detector, by the lowest chi-square, and all that was tried.

    On two exposures of a single star on different pixels. A mask turned by 180 degrees makes the same image with
    aberrations of opposite parity, so x mirrored and y mirrored are the same to these data.
    """
    some = exposures[[0, min(1, len(exposures.frames) - 1)]]
    rows: list[dict[str, Any]] = []

    def chi_square(pose: Pose) -> float:
        fit = make_model(config, pose, grid, some, 0.02).fit(some, steps=3)
        rows.append(dataclasses.asdict(pose) | {"chi_square": float(fit.chi_square.mean())})
        callback(Record("orientation", len(rows), 21, {"chi_square": rows[-1]["chi_square"]}))
        return rows[-1]["chi_square"]

    scans: dict[bool, list[tuple[float, float]]] = {False: [], True: []}
    for mirrored, scan in scans.items():
        scan += [(angle, chi_square(Pose(mirrored, angle))) for angle in (-1.0, -0.5, 0.0, 0.5, 1.0)]
    mirrored = min(scans, key=lambda side: min(value for _, value in scans[side]))
    rotation = valley(scans[mirrored])
    scales = [(m, chi_square(Pose(mirrored, rotation, m))) for m in (0.995, 1.0, 1.005)]
    magnification = valley(scales)
    turns = [rotation + turn for turn in (-0.2, 0.0, 0.2)]
    rotation = valley([(turn, chi_square(Pose(mirrored, turn, magnification))) for turn in turns])
    holes = [(hole, chi_square(Pose(mirrored, rotation, magnification, hole))) for hole in (0.79, 0.81, 0.83)]
    best = Pose(mirrored, rotation, magnification, valley(holes))
    chi_square(best)
    return best, rows


def valley(points: Sequence[tuple[float, float]]) -> float:
    """Where the parabola through the lowest point and its neighbours is lowest, within them."""
    x, y = np.array(sorted(points)).T
    low = min(max(int(y.argmin()), 1), len(x) - 2)
    a, b, _ = np.polyfit(x[low - 1 : low + 2], y[low - 1 : low + 2], 2)
    return float(np.clip(-b / (2 * a), x[low - 1], x[low + 1])) if a > 0 else float(x[y.argmin()])


def under(stage: str, callback: Callback) -> Callback:
    """The same callback under another stage's name."""
    return lambda record: callback(dataclasses.replace(record, stage=stage))


@dataclass(frozen=True, eq=False)
class Calibration:
    """What a single star tells: the mask on the detector, the model and how far it can be trusted.

    contrast : of the companion that is found at each of `offsets`, where there is none
    """

    pose: Pose
    model: CompanionModel
    exposures: Exposures
    star: Fit
    offsets: Tensor
    contrast: Tensor
    limits: Limits


def calibrate(
    config: Config, exposures: Exposures, grid: Grid, callback: Callback
) -> tuple[Calibration, list[dict[str, Any]]]:
    """Everything that is known before the target is looked at, and the orientations that were tried."""
    pose, tried = find_pose(config, grid, exposures, callback)
    model = make_model(config, pose, grid, exposures, 0.02)
    star = model.fit(exposures, callback=under("fit/single_star", callback))
    model.flux_error = model.flux_error_of(exposures, star)
    star = model.fit(exposures, start=star, callback=under("fit/single_star_weighted", callback))
    offsets = places(config.step)
    contrast, _ = model.search(exposures, star, offsets)
    return Calibration(pose, model, exposures, star, offsets, contrast, detection_limits(offsets, contrast)), tried


def characterise(
    config: Config, known: Calibration, grid: Grid, target: Exposures, alone: Fit, start: Tensor, callback: Callback
) -> tuple[Fit, dict[str, Any]]:
    """The companion near `start`, its errors, and whether the two halves of the exposures agree on it."""
    fit = known.model.fit(target, start, alone, callback=under("fit/companion", callback))
    wrong, recovered = injection_errors(
        known.model, known.exposures, known.star, fit.companion, config.n_injections, config.step, callback
    )
    fewer = dataclasses.replace(config, static_modes=max(3, config.static_modes - 4))
    simpler = make_model(fewer, known.pose, grid, target, known.model.flux_error)
    plain = simpler.fit(target, callback=under("fit/fewer_modes_star", callback))
    changed = simpler.fit(target, start, plain, callback=under("fit/fewer_modes", callback)).companion
    # What the calibrator shows, and what a choice of ours changes.
    floor = torch.hypot(wrong.square().mean(0).sqrt(), turn(fit.companion) @ (changed - fit.companion))
    halves = []
    for first in (0, 1):
        chosen = slice(first, None, 2)
        own = dataclasses.replace(alone, own=alone.own[chosen])
        half = known.model.fit(target[chosen], start, own, callback=under(f"fit/half_{first + 1}", callback))
        halves.append(measurement(half, floor))
    rest, _ = known.model.search(target, fit, known.offsets)
    return fit, {
        "companion": measurement(fit, floor),
        "fewer_modes": polar(changed),
        "injections": recovered,
        "halves": halves,
        "half_differences": agreement(*halves),
        "rest": rest,
        "rest_over_limit": float((rest / known.limits(known.offsets)).max()),
    }


def restore(config: Config, pose: Pose, grid: Grid, exposures: Exposures, callback: Callback) -> RestorationResult:
    """The image, without being told that there is a star or a companion."""
    # Its coarser pupil samples narrow the image of a hole, as larger holes would: the nominal size fits.
    pose = dataclasses.replace(pose, hole=Pose.hole)
    aperture, wavelengths = optics(config, pose, grid, exposures.to_pixels)
    method = MyopicDeconvolution(
        aperture,
        grid,
        n_modes=3,
        r0=config.r0,
        wavelengths=wavelengths,
        static_modes=config.static_modes,
        max_iterations=config.max_iterations,
    )
    return method.restore(exposures.frames, valid=exposures.valid, callback=callback)


def centroid(image: Tensor, row: int, column: int) -> tuple[float, Tensor]:
    """Light of 3 x 3 pixels, and its centre (y, x)."""
    box = image[row - 1 : row + 2, column - 1 : column + 2]
    offsets = torch.arange(-1, 2, dtype=torch.float64)
    place = torch.stack([(box.sum(1) * offsets).sum(), (box.sum(0) * offsets).sum()]) / box.sum().clamp(min=1e-30)
    return float(box.sum()), place + torch.tensor([row, column])


def look(image: Tensor, to_pixels: Tensor, most: float = 0.7) -> dict[str, Any]:
    """The brightest source beside the star in a restored image, up to a separation [arcsec]."""
    row, column = divmod(int(image.argmax()), image.shape[1])
    flux, star = centroid(image, row, column)
    rest = image.clone()
    rest[row - 1 : row + 2, column - 1 : column + 2] = 0
    y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in image.shape), indexing="ij")
    pixels_per_radian = float(to_pixels[0].norm()) / 2**0.5
    rest[torch.hypot(y - row, x - column) > most * ARCSEC * pixels_per_radian] = 0
    light, place = centroid(image, *divmod(int(rest.argmax()), image.shape[1]))
    position = torch.linalg.inv(to_pixels.mean(0)) @ (place - star)
    return polar(torch.cat([torch.tensor([light / flux], dtype=torch.float64), position])) | {"star": star.tolist()}


def analyse(config: Config, log: RunLogger, callback: Callback) -> dict[str, Any]:
    """Everything, calibrator first; figures go to `log`."""
    target, grid = read(config.data, config.target, config.crop)
    single, single_grid = read(config.data, config.calibrator, config.crop)
    if config.smoke:
        target, single = target[:3], single[:2]
    known, tried = calibrate(config, single, single_grid, callback)
    log.table("orientation", tried)
    limit = known.limits(known.offsets)

    alone = known.model.fit(target, callback=under("fit/star", callback))
    contrast, noise = known.model.search(target, alone, known.offsets)
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
    maps, fit = {config.target: contrast, config.calibrator: known.contrast}, alone
    if results["found"]:
        start = torch.cat([contrast[best, None], known.offsets[best]])
        fit, measured = characterise(config, known, grid, target, alone, start, callback)
        maps[f"{config.target}, companion taken out"] = measured.pop("rest")
        results |= measured
    marks = [polar(fit.companion)] if results["found"] else []
    log.figure("search", search_figure(known.offsets, maps, known.limits, marks))
    log.figure("exposure", exposures_figure(target, fit, config.radius))

    images, results["restored"] = {}, {}
    for name, exposures, its_grid in ((config.target, target, grid), (config.calibrator, single, single_grid)):
        result = restore(config, known.pose, its_grid, exposures, under(f"restoration/{name}", callback))
        seen = look(result.object, exposures.to_pixels)
        images[name] = upright(result.object, seen["star"], exposures.to_pixels)
        results["restored"][name] = seen | {"summary": result.summary()}
        save_npz(log.directory / f"{name}.npz", {"object": result.object, "coefficients": result.coefficients})
    log.figure("restored", images_figure(images, marks))
    return results


def main(config: Config) -> int:
    """Run in a new folder."""
    directory = config.runs / (config.name or datetime.now().strftime("niriss-%Y%m%d-%H%M%S"))
    if config.smoke:
        config = dataclasses.replace(
            config, crop=32, n_wavelengths=1, static_modes=3, radius=12.0, max_iterations=20, n_injections=2, step=0.1
        )
    try:
        for star in (config.target, config.calibrator):  # before a folder is made
            read(config.data, star, config.crop)
        with RunLogger(directory) as log, Progress() as progress:
            log.log_config(config)
            results = analyse(config, log, fan_out(log, progress))
            lines = findings(config.target, config.calibrator, results)
            log.text("findings", "\n\n".join(lines))
            write_json(directory / "results.json", results | {"findings": lines})
            if results["companion"] is not None:
                for name in MEASURED:
                    log.scalar(f"companion/{name}", results["companion"][name])
    except KeyboardInterrupt:
        print(f"\ninterrupted: what is there lies in {directory}", file=sys.stderr)
        return 130
    except ValueError as problem:
        print(f"niriss_ab_dor: {problem}", file=sys.stderr)
        return 2
    if results["companion"] is not None:
        Console().print(table(results))
    print(*lines, f"written to {directory}", sep="\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Config, description=__doc__)))

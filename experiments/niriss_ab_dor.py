"""AB Dor and its faint companion, from nine exposures of JWST/NIRISS through its seven-hole mask.

    python experiments/niriss_ab_dor.py --data ../shared/real/niriss
    python experiments/niriss_ab_dor.py --data ../shared/real/niriss --smoke    # everything, small, in seconds

Filter F480M as a few wavelengths, hexagonal holes, aberrations common to all exposures plus small ones of each, bad
pixels left out. The calibrator HD 37093, a single star, goes the same way: it tells how the mask lies on the detector,
how far the model can be trusted, and how faint a companion would be found. Beside the restored images, star and
companion are fitted with everything else (`companion_fit`). Tables, figures and TensorBoard events go to a new folder,
runs/<name>/. Files are AB-DOR_*.fits or ab-dor_*.fits and hd-37093_*.fits, with extensions SCI, ERR and DQ.
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
from companion_fit import CompanionModel, Exposures, Fit
from niriss_figures import exposures_figure, images_figure, search_figure, upright
from rich.console import Console
from rich.table import Table
from torch import Tensor

from torchmask.data.keywords import ARCSEC, FILTERS, pixel_matrix
from torchmask.grid import Grid
from torchmask.io import save_npz, write_json
from torchmask.optics.aperture import SparseAperture
from torchmask.progress import Progress
from torchmask.record import Callback, Record
from torchmask.restoration.myopic import MyopicDeconvolution
from torchmask.restoration.result import RestorationResult
from torchmask.simulation.observation import Observation
from torchmask.tracking import RunLogger, fan_out

MASK, FILTER = "jwst_niriss_ami_7", FILTERS[("NIRISS", "F480M")]  # (wavelength, width) [m], its source beside it
GAIN = 1.61  # electrons per DN: NIRISS detector performance, JWST user documentation
SIGNIFICANCE = 5.0  # times the scatter of the calibrator: what counts as found
MAS = ARCSEC / 1000


@dataclass(frozen=True)
class Config:
    """Everything the result depends on."""

    data: Path = Path("../shared/real/niriss")
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
    parts = [Observation.from_fits([path], aperture, gain=GAIN, crop=crop) for path in paths]
    matrices = [pixel_matrix(part.header) for part in parts]  # (x, y) to (east, north) [deg]
    if any(matrix is None for matrix in matrices):
        raise ValueError(f"{folder}: the headers of {star}_*.fits have no CD matrix, which tells where north is")
    to_pixels = np.stack([np.linalg.inv(np.radians(np.array(matrix)))[::-1] for matrix in matrices])
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


def polar(companion: Tensor) -> dict[str, float]:
    """Separation [mas], position angle [deg, north through east] and magnitude difference."""
    contrast, east, north = companion.tolist()
    return {
        "separation": math.hypot(east, north) / MAS,
        "position_angle": math.degrees(math.atan2(east, north)) % 360,
        "magnitude_difference": -2.5 * math.log10(contrast) if contrast > 0 else math.inf,
    }


def places(step: float, least: float = 0.1, most: float = 0.7) -> Tensor:
    """Offsets (M, 2) to search, between two separations [arcsec]."""
    n = math.ceil(most / step)
    line = torch.arange(-n, n + 1, dtype=torch.float64) * step * ARCSEC
    grid = torch.cartesian_prod(line, line)
    separation = torch.linalg.vector_norm(grid, dim=1) / ARCSEC
    return grid[(separation > least) & (separation < most)]


@dataclass(frozen=True)
class Limits:
    """Faintest companion that would be found, by separation [arcsec] of annuli."""

    separation: np.ndarray
    contrast: np.ndarray

    def __call__(self, offsets: Tensor) -> Tensor:
        """Limiting contrast at offsets (..., 2) [rad]."""
        away = torch.linalg.vector_norm(offsets, dim=-1) / ARCSEC
        return torch.from_numpy(np.interp(away.numpy(), self.separation, self.contrast))


def detection_limits(offsets: Tensor, contrast: Tensor) -> Limits:
    """SIGNIFICANCE times the rms contrast that is found, annulus by annulus, where there is no companion."""
    away = torch.linalg.vector_norm(offsets, dim=1) / ARCSEC
    edges = torch.arange(0.1, float(away.max()) + 0.05, 0.1, dtype=torch.float64)
    inside = [(away >= low - 0.025) & (away < low + 0.125) for low in edges[:-1]]
    rms = [SIGNIFICANCE * float(contrast[ring].square().mean().sqrt()) for ring in inside]
    return Limits((edges[:-1] + 0.05).numpy(), np.array(rms))


def inject(exposures: Exposures, star: Fit, companion: Tensor) -> Exposures:
    """The exposures with a companion made of the star's own light, shifted; bad pixels give the model's."""
    light = torch.where(exposures.valid, exposures.frames, star.images) - star.own[:, 1, None, None]
    nu = [torch.fft.fftfreq(n, dtype=torch.float64) for n in light.shape[1:]]
    move = torch.einsum("tij,j->ti", exposures.to_pixels, companion[1:])
    turn = nu[0][:, None] * move[:, 0, None, None] + nu[1] * move[:, 1, None, None]
    moved = torch.fft.ifft2(torch.fft.fft2(light) * torch.exp(-2j * math.pi * turn)).real
    return dataclasses.replace(exposures, frames=exposures.frames + companion[0] * moved)


def turned(change: Tensor, companion: Tensor) -> Tensor:
    """A difference in (contrast, east, north) as contrast, along and across the direction of a companion."""
    outwards = companion[1:] / torch.linalg.vector_norm(companion[1:])
    across = torch.stack([outwards[1], -outwards[0]])
    return torch.stack([change[0], change[1:] @ outwards, change[1:] @ across])


def floor_by_injection(
    model: CompanionModel, exposures: Exposures, star: Fit, like: Tensor, n: int, step: float, callback: Callback
) -> tuple[Tensor, list[dict[str, float]]]:
    """Errors (n, 3) [contrast, along and across the separation [rad]] with which such a companion is found.

    The same contrast and separation at n position angles beside the calibrator, each fitted from the nearest point
    of the search grid.
    """
    radius, errors, rows = float(torch.linalg.vector_norm(like[1:])), [], []
    for i in range(n):
        angle = 2 * math.pi * (i + 0.5) / n
        outwards = torch.tensor([math.sin(angle), math.cos(angle)], dtype=torch.float64)
        truth = torch.cat([like[:1], radius * outwards])
        start = torch.cat([like[:1], (truth[1:] / (step * ARCSEC)).round() * step * ARCSEC])
        found = model.fit(inject(exposures, star, truth), start, star, steps=3).companion
        wrong = found - truth
        errors.append(turned(wrong, truth))
        rows.append({"true_position_angle": math.degrees(angle)} | polar(found))
        callback(Record("injection", i + 1, n, {"contrast_error": float(wrong[0] / like[0])}))
    return torch.stack(errors), rows


def measure(
    config: Config, model: CompanionModel, target: Exposures, star: Fit, start: Tensor, floor: Tensor
) -> tuple[Fit, dict[str, Any]]:
    """The companion with errors: from the exposures (jackknife, or the noise if that is more), and `floor`."""
    fit = model.fit(target, start, star)
    n = len(target.frames)
    scatter = fit.jackknife - fit.jackknife.mean(0)
    jackknife = (n - 1) / n * (scatter**2).sum(0)
    statistical = torch.maximum(jackknife, fit.covariance.diagonal()).sqrt()
    position = fit.companion[1:]
    outwards = position / torch.linalg.vector_norm(position)
    across = torch.stack([outwards[1], -outwards[0]])
    radius = torch.linalg.vector_norm(position)

    def spread(cartesian: Tensor, systematic: Tensor) -> dict[str, float]:
        along = math.hypot(float((cartesian[1:] * outwards).norm()), float(systematic[1]))
        turned = math.hypot(float((cartesian[1:] * across).norm()), float(systematic[2]))
        share = math.hypot(float(cartesian[0]), float(systematic[0])) / abs(float(fit.companion[0]))
        return {
            "separation": along / MAS,
            "position_angle": math.degrees(turned / float(radius)),
            "magnitude_difference": 2.5 / math.log(10) * share,
        }

    none = torch.zeros(3, dtype=torch.float64)
    errors = spread(statistical, none), spread(none, floor), spread(statistical, floor)
    return fit, {
        "contrast": float(fit.companion[0]),
        **polar(fit.companion),
        **{f"{kind}_error": error for kind, error in zip(("statistical", "systematic", "total"), errors, strict=True)},
        "chi_square": fit.chi_square.tolist(),
        "exposures": n,
    }


def agreement(one: dict[str, Any], other: dict[str, Any]) -> dict[str, float]:
    """Differences of two measurements over their errors, those of the exposures alone."""
    found = {}
    for name in ("separation", "position_angle", "magnitude_difference"):
        error = math.hypot(one["statistical_error"][name], other["statistical_error"][name])
        difference = one[name] - other[name]
        difference = (difference + 180) % 360 - 180 if name == "position_angle" else difference
        found[name] = difference / error
    return found


def restore(
    config: Config, pose: Pose, grid: Grid, exposures: Exposures, stage: str, callback: Callback
) -> RestorationResult:
    """The image, without being told that there is a star or a companion."""
    # Its coarser pupil samples narrow the image of a hole, as larger holes would: the nominal size fits.
    pose = dataclasses.replace(pose, hole=Pose.hole)
    aperture, wavelengths = optics(config, pose, grid, exposures.to_pixels)

    def named(record: Record) -> None:
        callback(dataclasses.replace(record, stage=stage))

    method = MyopicDeconvolution(
        aperture,
        grid,
        n_modes=3,
        r0=config.r0,
        wavelengths=wavelengths,
        static_modes=config.static_modes,
        max_iterations=config.max_iterations,
    )
    return method.restore(exposures.frames, valid=exposures.valid, callback=named)


def look(result: RestorationResult, to_pixels: Tensor) -> dict[str, Any]:
    """The brightest source beside the star in a restored image: light and centroid of 3 x 3 pixels."""
    image = result.object
    offsets = torch.arange(-1, 2, dtype=torch.float64)

    def centroid(row: int, column: int, reach: int = 1) -> tuple[float, Tensor]:
        box = image[row - reach : row + reach + 1, column - reach : column + reach + 1]
        place = torch.stack([(box.sum(1) * offsets).sum(), (box.sum(0) * offsets).sum()]) / box.sum().clamp(min=1e-30)
        return float(box.sum()), place + torch.tensor([row, column])

    row, column = divmod(int(image.argmax()), image.shape[1])
    flux, star = centroid(row, column)
    rest = image.clone()
    rest[row - 1 : row + 2, column - 1 : column + 2] = 0
    y, x = torch.meshgrid(*(torch.arange(n) for n in image.shape), indexing="ij")
    rest[
        torch.hypot((y - row).double(), (x - column).double()) > 0.7 * ARCSEC * float(to_pixels[0].norm()) / 2**0.5
    ] = 0
    light, place = centroid(*divmod(int(rest.argmax()), image.shape[1]))
    position = torch.linalg.inv(to_pixels.mean(0)) @ (place - star)
    return polar(torch.cat([torch.tensor([light / flux], dtype=torch.float64), position])) | {"star": star.tolist()}


def analyse(config: Config, log: RunLogger, callback: Callback) -> dict[str, Any]:
    """Everything, calibrator first; figures go to `log`."""
    target, grid = read(config.data, config.target, config.crop)
    single, single_grid = read(config.data, config.calibrator, config.crop)
    if config.smoke:
        target, single = target[:3], single[:2]
    pose, tried = find_pose(config, single_grid, single, callback)
    log.table("orientation", tried)

    model = make_model(config, pose, single_grid, single, 0.02)
    star = model.fit(single)
    model.flux_error = model.flux_error_of(single, star)
    star = model.fit(single, start=star, steps=2)
    offsets = places(config.step)
    empty, _ = model.search(single, star, offsets)
    limits = detection_limits(offsets, empty)

    alone = model.fit(target)
    contrast, noise = model.search(target, alone, offsets)
    ratio = contrast / limits(offsets)
    best = int(ratio.argmax())
    ring = (limits.separation.tolist(), (-2.5 * np.log10(limits.contrast)).tolist())
    calibrator_best = int((empty / limits(offsets)).argmax())
    results: dict[str, Any] = {
        "pose": pose,
        "orientations_tried": tried,
        "flux_error": model.flux_error,
        "calibrator": {
            "chi_square": star.chi_square.tolist(),
            "limits": {"separation": ring[0], "magnitude_difference": ring[1]},
            "highest_over_limit": float((empty / limits(offsets))[calibrator_best]),
            "highest_at": polar(torch.cat([empty[calibrator_best, None], offsets[calibrator_best]])),
        },
        "found": bool(ratio[best] > 1),
        "highest_over_limit": float(ratio[best]),
        "highest_significance": float(contrast[best] / noise[best]),
        "companion": None,
    }
    maps = {config.target: contrast, config.calibrator: empty}
    marks: list[dict[str, float]] = []
    shown = alone
    if results["found"]:
        start = torch.cat([contrast[best, None], offsets[best]])
        like = model.fit(target, start, alone).companion
        errors, recovered = floor_by_injection(model, single, star, like, config.n_injections, config.step, callback)
        fewer = dataclasses.replace(config, static_modes=max(3, config.static_modes - 4))
        simpler = make_model(fewer, pose, grid, target, model.flux_error)
        change = simpler.fit(target, start, simpler.fit(target)).companion - like
        # What the calibrator shows, and what a choice of ours changes.
        floor = torch.hypot(errors.square().mean(0).sqrt(), turned(change, like))
        results["fewer_modes"] = polar(like + change)
        shown, results["companion"] = measure(config, model, target, alone, start, floor)
        results["injections"] = recovered
        halves = [list(range(first, len(target.frames), 2)) for first in (0, 1)]
        results["halves"] = [
            measure(config, model, target[half], model.fit(target[half]), start, floor)[1] for half in halves
        ]
        results["half_differences"] = agreement(*results["halves"])
        marks = [polar(shown.companion)]
        maps[f"{config.target}, companion taken out"] = rest = model.search(target, shown, offsets)[0]
        results["rest_over_limit"] = float((rest / limits(offsets)).max())
    log.figure("search", search_figure(offsets, maps, limits.separation, limits.contrast))
    log.figure("exposure", exposures_figure(target, shown, config.radius))

    images, results["restored"] = {}, {}
    for name, exposures, its_grid in ((config.target, target, grid), (config.calibrator, single, single_grid)):
        result = restore(config, pose, its_grid, exposures, f"restoration/{name}", callback)
        seen = look(result, exposures.to_pixels)
        images[name] = upright(result.object, seen["star"], exposures.to_pixels)
        results["restored"][name] = seen | {"summary": result.summary()}
        save_npz(log.directory / f"{name}.npz", {"object": result.object, "coefficients": result.coefficients})
    log.figure("restored", images_figure(images, marks))
    return results


def findings(config: Config, results: dict[str, Any]) -> list[str]:
    """What was found, in sentences."""
    pose, own, single = results["pose"], results["companion"], results["calibrator"]
    tried = results["orientations_tried"]
    same, other = (min(r["chi_square"] for r in tried if (r["mirrored"] == pose.mirrored) == s) for s in (True, False))
    lines = [
        f"Mask on the detector: {'mirrored in x' if pose.mirrored else 'as in the catalogue, not mirrored'} (or that "
        f"turned by 180 degrees, which makes the same image), rotated by {pose.rotation:+.2f} degrees from x to y, "
        f"magnified by {pose.magnification:.4f}, holes of {pose.hole:.3f} m: chi-square {same:.2f}, against at least "
        f"{other:.0f} if mirrored the other way.",
        f"Model and exposures of {config.calibrator} differ by {100 * results['flux_error']:.1f} % of a pixel's flux "
        "beyond the noise.",
    ]
    limits = single["limits"]
    line = ", ".join(f"{m:.1f} mag at {s:.2f}" for s, m in zip(*limits.values(), strict=True))
    lines.append(
        f"{config.calibrator}: no companion above {SIGNIFICANCE:g} times the scatter (the highest point of the search "
        f"reaches {single['highest_over_limit']:.2f} of that). Detection limit: {line} arcsec."
    )
    if own is None:
        lines.append(
            f"{config.target}: NO companion found; the highest point of the search reaches "
            f"{results['highest_over_limit']:.2f} of the limit."
        )
    else:
        total = own["total_error"]
        lines.append(
            f"{config.target}: a companion at {own['separation']:.1f} +- {total['separation']:.1f} mas, position angle "
            f"{own['position_angle']:.2f} +- {total['position_angle']:.2f} degrees, "
            f"{own['magnitude_difference']:.2f} +- {total['magnitude_difference']:.2f} mag fainter; it is "
            f"{results['highest_over_limit']:.1f} times above the limit. Without it the highest point of the search "
            f"reaches {results['rest_over_limit']:.2f} of the limit."
        )
        apart = max(abs(value) for value in results["half_differences"].values())
        lines.append(
            f"The two halves of the exposures {'agree' if apart < 3 else 'DISAGREE'}: they differ by at most "
            f"{apart:.1f} of their errors from the exposures alone."
        )
    for name, seen in results["restored"].items():
        lines.append(
            f"Restored image of {name}: brightest beside the star at {seen['separation']:.0f} mas, position angle "
            f"{seen['position_angle']:.0f} degrees, {seen['magnitude_difference']:.1f} mag fainter."
        )
    return lines


def table(results: dict[str, Any]) -> Table:
    """The companion from all exposures and from each half."""
    sheet = Table("exposures", "separation [mas]", "position angle [deg]", "magnitude difference", "chi-square")
    for row in [results["companion"], *results["halves"]]:
        names = ("separation", "position_angle", "magnitude_difference")
        values = [
            f"{row[n]:.2f} +- {row['statistical_error'][n]:.2f} +- {row['systematic_error'][n]:.2f}" for n in names
        ]
        sheet.add_row(str(row["exposures"]), *values, f"{np.mean(row['chi_square']):.2f}")
    sheet.caption = "errors: from the exposures; from companions put beside the calibrator and fewer aberrations"
    return sheet


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
            lines = findings(config, results)
            log.text("findings", "\n\n".join(lines))
            write_json(directory / "results.json", results | {"findings": lines})
            if results["companion"] is not None:
                for name in ("separation", "position_angle", "magnitude_difference"):
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

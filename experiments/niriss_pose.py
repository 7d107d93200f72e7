"""How NIRISS's mask lies on the detector: mirrored, turned, magnified, and how large its holes are."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchmask.grid import Grid
from torchmask.interferometry.companion import CompanionModel, Exposures
from torchmask.interferometry.companion_fit import fit_companion
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.band import FILTERS
from torchmask.record import Callback, Record

MASK, FILTER = "jwst_niriss_ami_7", FILTERS[("NIRISS", "F480M")]


@dataclass(frozen=True)
class Pose:
    """How the mask lies on the detector."""

    mirrored: bool = False
    rotation: float = 0.0  # [deg], from x to y of the detector
    magnification: float = 1.0  # of the pupil in units of the wavelength: stands for the effective wavelength
    hole: float = 0.80  # [m] flat to flat


def placed_mask(pose: Pose, grid: Grid, to_pixels: Tensor) -> SparseAperture:
    """Return the mask on the detector's axes, whose pixels are a little oblong."""
    mask = SparseAperture.from_catalog(MASK, mirrored=pose.mirrored)
    angle = math.radians(pose.rotation)
    turn = torch.tensor([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]], dtype=torch.float64)
    pixel = torch.linalg.vector_norm(torch.linalg.inv(to_pixels[0]), dim=0).flip(0)  # sides along x and y [rad]
    centers = mask.centers @ turn.T * (pixel / grid.pixel_scale)
    return mask.replace(centers, pose.hole, shape=mask.shape.turned(angle))


def effective_wavelengths(pose: Pose, n: int) -> list[float]:
    """n wavelengths across the filter [m]."""
    places = [(i + 0.5) / n - 0.5 for i in range(n)]
    return [(FILTER.wavelength + FILTER.width * place) / pose.magnification for place in places]


def find_pose(
    make_model: Callable[[Pose, Exposures], CompanionModel], exposures: Exposures, callback: Callback
) -> tuple[Pose, list[dict[str, Any]]]:
    """Return the pose of lowest chi-square, and all that were tried.

    On two exposures of a single star on different pixels. A mask turned by 180 degrees makes the same image with
    aberrations of opposite parity, so x mirrored and y mirrored are the same to these data.
    """
    some = exposures[[0, min(1, len(exposures.frames) - 1)]]
    rows: list[dict[str, Any]] = []

    def chi_square(pose: Pose) -> float:
        fit = fit_companion(make_model(pose, some), some, steps=3)
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
    """Return where the parabola through the lowest point and its neighbours is lowest, within them."""
    x, y = np.array(sorted(points)).T
    low = min(max(int(y.argmin()), 1), len(x) - 2)
    a, b, _ = np.polyfit(x[low - 1 : low + 2], y[low - 1 : low + 2], 2)
    return float(np.clip(-b / (2 * a), x[low - 1], x[low + 1])) if a > 0 else float(x[y.argmin()])

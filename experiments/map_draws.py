"""What the maps of success, of smearing and of the bound draw: pupils, scenes and light."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import torch
from mask_vs_full_options import DIAMETER
from observing import SIZE
from searched_masks import search_masks
from torch import Tensor
from trade import criterion_of

from torchmask.cli.options import SweepOptions
from torchmask.metrics import relative_error
from torchmask.observation import Observation
from torchmask.optics.aperture import FullAperture, SparseAperture
from torchmask.optics.pupil import Aperture
from torchmask.record import Callback
from torchmask.simulation.scene import SceneOptions, make_scene

FILL_FACTOR, OUTER_SCALE, READOUT_NOISE = 0.15, 20.0, 1.5  # the second in m, the third in electrons per pixel
HOLES = (10, 6, 14, 8, 12)  # of the masks, draw by draw


def choose_pupils(
    pupil: Literal["mask", "full"], n_draws: int, options: SweepOptions, callback: Callback
) -> Sequence[Aperture]:
    """Return a searched mask for each draw, or the full pupil for all."""
    if pupil == "full":
        return [FullAperture(DIAMETER)] * n_draws
    holes = [HOLES[draw % len(HOLES)] for draw in range(n_draws)]
    masks = search_masks(holes, FILL_FACTOR, options, callback)
    return [masks[n] for n in holes]


def of_pupil(aperture: Aperture) -> dict[str, Any]:
    """Return what a task says of its mask, or of the full pupil."""
    if aperture.is_full:
        return {"pupil": "full"}
    return {
        "pupil": "mask",
        "centers": aperture.centers.tolist(),
        "subaperture_diameter": aperture.subaperture_diameter,
    }


def aperture_of(task: Mapping[str, Any]) -> Aperture:
    """Return the mask of a task, or the full pupil."""
    if task["pupil"] == "full":
        return FullAperture(DIAMETER)
    return SparseAperture(task["centers"], task["subaperture_diameter"], DIAMETER)


def scene_of(draw: int, shape: tuple[int, int], n_photons: float) -> Tensor:
    """Return the packaged satellite in a random attitude (even draws), or a spotted ball (odd draws)."""
    generator = torch.Generator().manual_seed(1000 + draw)
    if draw % 2 == 0:
        pitch, yaw, roll = (360 * torch.rand(3, generator=generator) - 180).tolist()
        return make_scene(shape, n_photons, SceneOptions(attitude=(pitch, yaw, roll), size=SIZE))
    rows, columns = shape
    y, x = torch.meshgrid(torch.arange(rows) - rows / 2, torch.arange(columns) - columns / 2, indexing="ij")
    radius = SIZE * min(shape) / 2
    height = (1 - (x / (0.8 * radius)) ** 2 - (y / radius) ** 2).clamp(min=0).sqrt().double()  # limb darkening
    ball = height.clone()
    for _ in range(12):
        place, width, depth = torch.rand(2, generator=generator), torch.rand(1, generator=generator), 0.9
        spot = (x - radius * (2 * place[0] - 1)) ** 2 + (y - radius * (2 * place[1] - 1)) ** 2
        ball *= 1 - depth * torch.exp(-spot / (2 * (1 + 2 * width) ** 2))
    return ball * (n_photons / ball.sum())


def score(observation: Observation, image: Tensor) -> float:
    """Relative error up to the diffraction limit."""
    assert observation.object is not None
    return relative_error(image, observation.object, observation.grid.cutoff(DIAMETER))


def predict(task: Mapping[str, Any]) -> dict[str, Any]:
    """Return the score that the criterion predicts for instants in narrow light and known PSFs, at each flux."""
    aperture, kept, scores = aperture_of(task), None, []
    told = {"readout_noise": READOUT_NOISE, "outer_scale": OUTER_SCALE / DIAMETER}
    for photons in task["photons"]:
        lit = criterion_of({**task, **told}, photons)
        kept = kept or lit  # whose tables of turbulence hold at any flux
        kept.load_state_dict(lit.state_dict())
        scores.append(math.sqrt(float(kept.relative(aperture))))
    return {"scores": scores}

"""Where the light of each frame stands, around which its fringes are fitted."""

from __future__ import annotations

import math
import warnings

import torch
from torch import Tensor

from torchmask.interferometry.fringe_fit import FringeModel, PixelNoise

_ACCURATE = 0.02  # of wavelength / (hole diameter): error of a place by noise, up to which a frame has its own
_WANDERS = 0.05  # rms motion of the light in the same unit, above which frames have places of their own
_STEP = 0.1  # distance in the same unit of places that are told apart: |V|^2 changes by 2e-3 at most
_DRIFTS = 0.1  # motion in the same unit, of which a warning tells where frames cannot have places of their own
_CERTAIN = 5.0  # errors of that motion, which noise does not reach
_ROUNDS = 3  # of fitting the fringes and taking them off


def find_places(frames: Tensor, valid: Tensor, noise: PixelNoise, model: FringeModel, stacklevel: int) -> Tensor:
    """Return the places (T, 2) of the light in frames (T, H, W), (x, y) relative to [H // 2, W // 2] [pixel].

    They are those of the light of each frame by itself where noise moves them by less than a fiftieth of wavelength /
    (hole diameter), if they wander by more than a twentieth, in steps of a tenth. Elsewhere they are that of the mean
    frame. If that is so for half of the light or more, a warning, as if raised `stacklevel` calls above, tells of a
    drift of more than a tenth from the first half of the frames to the second.
    """
    common = torch.tensor(model.centre(frames, valid), dtype=torch.float64)
    unit = model.grid.period / model.aperture.subaperture_diameter
    places = common.repeat(len(frames), 1)
    points = model.points
    light, errors = _light_and_errors(frames, valid, noise, points, common)
    sharp = errors < _ACCURATE * unit
    if 2 * float(light[sharp].sum()) <= float(light.sum()):
        _warn_of_drift(frames, valid, points, float((errors**-2).sum().rsqrt()), stacklevel + 1)
        return places
    step = _STEP * unit
    for _ in range(_ROUNDS):
        found = _own_places(frames[sharp], valid[sharp], points, places[sharp])
        wander = float((found - found.mean(0)).square().sum(1).mean().sqrt())
        if wander <= _WANDERS * unit:
            return common.repeat(len(frames), 1)
        before, places[sharp] = places.clone(), common + ((found - common) / step).round() * step
        if torch.equal(places, before):
            break
    return places


def _light_and_errors(
    frames: Tensor, valid: Tensor, noise: PixelNoise, model: FringeModel, place: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the light (T,) of the envelope e at a `place` (2,), and the errors (T,) of places by noise [pixel].

    The place where e explains most of a frame of light L has the variance sum(e'^2 variance) / (L sum(e'^2))^2, with
    the slope e' of e; the larger one of x and y counts.
    """
    moves = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]], dtype=torch.float64)
    near = [model.columns(*(place + move).tolist())[0].view(model.grid.shape) for move in moves]
    seen = valid.double()
    light = (seen * frames.nan_to_num() * near[0]).sum((1, 2)) / (seen * near[0] ** 2).sum((1, 2))
    variance = torch.where(valid, noise.variance, 0.0).clamp(min=0)
    slopes = [seen * (moved - near[0]) ** 2 for moved in near[1:]]
    errors = [(slope * variance).sum((1, 2)).sqrt() / slope.sum((1, 2)) for slope in slopes]
    return light.clamp(min=0), torch.stack(errors).amax(0) / light.clamp(min=torch.finfo(torch.float64).tiny)


def _own_places(frames: Tensor, valid: Tensor, model: FringeModel, places: Tensor) -> Tensor:
    """Return the place (T, 2) of the light in each of frames (T, H, W), without its fringes around `places` (T, 2)."""
    found = torch.empty_like(places)
    same, group = torch.unique(places, dim=0, return_inverse=True)
    for number, place in enumerate(same):
        columns = model.columns(*place.tolist())
        for frame in (group == number).nonzero().flatten().tolist():
            light, counted = torch.where(valid[frame], frames[frame], 0.0), valid[frame].double()
            found[frame] = torch.tensor(model.place_beside_fringes(light, counted, model.norm(counted), columns))
    return found


def _warn_of_drift(frames: Tensor, valid: Tensor, model: FringeModel, error: float, stacklevel: int) -> None:
    """Warn of places in both halves of the frames that differ, `error` being that of all frames together [pixel]."""
    half, unit = len(frames) // 2, model.grid.period / model.aperture.subaperture_diameter
    if not half:
        return
    one, other = (model.centre(frames[part], valid[part]) for part in (slice(0, half), slice(half, None)))
    moved = math.dist(one, other)
    if moved > max(_DRIFTS * unit, _CERTAIN * 2 * error):  # either half has sqrt(2) times the error
        warnings.warn(
            f"the light of the second half of the frames stands {moved:.2g} pixels from that of the first, "
            f"{moved / unit:.2g} of wavelength / (hole diameter), and they are too faint to be fitted each around its "
            "own light, so |V|^2 is too low: register the frames, or observe each part by itself",
            stacklevel=stacklevel + 1,
        )

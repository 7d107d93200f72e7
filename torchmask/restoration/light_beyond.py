"""The light of an object that the optics spread beyond the field of a model, which the object's brightness includes.

The PSFs of a model have unit sum on its field, which is a quarter wider than the frames. The light around the image of
a hole falls off as slowly as one over the distance, so that several per cent of it lie beyond, and turbulence adds to
it. An object that explains the frames with such PSFs is too faint by as much.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchmask.optics.pupil import sample_holes
from torchmask.restoration.forward import ExposureModel

_MARGINS = (1.0, 3.0)  # of the fields from which the endless one is extrapolated
_FULL_MARGINS = (0.5, 1.0)  # the same for a full pupil, which spreads less; its many modes would take gigabytes
_FRAMES = 16  # whose mean is taken


@torch.no_grad()
def light_beyond(model: ExposureModel, image: Tensor, z: Tensor) -> float:
    """Return the share of the light of an object that its model should lose, and keeps, as its field is finite.

    Frames hold a share of the light of the object `image` (H', W') for the aberrations z (T, K): too large a one in the
    model. That of endless fields follows from two wider ones, whose PSFs are true but for the cells of their pupil
    samples, which attenuate them by a square of the distance over the width of the field (Richardson 1911, Phil. Trans.
    R. Soc. A 210, 307). Modes that the model lacks spread light too, which is not known. An object without light loses
    nothing.
    """
    if not float(image.sum()) > 0:
        return 0.0
    if len(z) > _FRAMES:
        z = z[torch.linspace(0, len(z) - 1, _FRAMES).round().long()]
    margins = _FULL_MARGINS if model.pupil.aperture.is_full else _MARGINS
    near, far = (_widened(model, margin) for margin in margins)
    ratio = math.prod(far.window.field.shape) / math.prod(near.window.field.shape)
    shares = [_open_share(wide) * _share_in_frames(wide, _moved(image, model, wide), z) for wide in (near, far)]
    endless = shares[1] + (shares[1] - shares[0]) / (ratio - 1)
    return 1 - endless / _share_in_frames(model, image, z)


def _widened(model: ExposureModel, margin: float) -> ExposureModel:
    """Return the model without pixels, which move little light, in another field."""
    aperture, kwargs = model.pupil.aperture, {"dtype": model.dtype, "device": model.device}
    return ExposureModel(aperture, model.window.grid, model.aberrations, model.band, margin, **kwargs)


def _share_in_frames(model: ExposureModel, image: Tensor, z: Tensor) -> float:
    image = image.to(model.dtype)
    light = sum(float(model(image, z[part]).double().sum()) for part in model.chunks(len(z)))
    return light / (len(z) * float(image.double().sum()))


def _open_share(model: ExposureModel) -> float:
    """Return the sum of a PSF whose peak is true, by Parseval's theorem: cells at the edge of a hole open in part."""
    aperture = model.pupil.aperture
    samples = sample_holes(aperture.centers.detach(), aperture.shape, aperture.subaperture_diameter, model.window.field)
    raster = samples.weights.new_zeros(math.prod(samples.raster))
    raster.index_add_(0, samples.index.flatten(), samples.weights.flatten())
    return float(raster.square().sum() / raster.sum())


def _moved(image: Tensor, model: ExposureModel, wide: ExposureModel) -> Tensor:
    """Return the object (H', W') on a wider field; its margin lies half after the frames, and half before them."""
    moved = image.new_zeros(wide.window.field.shape)
    places = []
    for own, field, frame in zip(image.shape, moved.shape, model.window.grid.shape, strict=True):
        place = torch.arange(own, device=image.device)
        places.append(torch.where(place < (own + frame + 1) // 2, place, place + field - own))
    moved[places[0][:, None], places[1]] = image
    return moved

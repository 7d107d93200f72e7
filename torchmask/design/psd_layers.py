"""What the sum over half the frequency plane needs of the power spectra, kept for as long as they stay the same."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from torchmask.optics.pupil import can_be_read

Layers = tuple[Tensor, Tensor]
"""Weight and ratio (layers, H // 2 + 1, W): MSE_a is the sum of weight / (transfer + ratio) over half the plane."""


def psd_layers(object_psd: Tensor, noise_psd: Tensor, n_frames: int) -> Layers:
    """Return weight and ratio of PSDs (H, W).

    A frequency and its negative have the same transfer. If the PSDs differ there, they are kept in two layers.
    """
    rows, columns = noise_psd.shape
    height = rows // 2 + 1
    double = torch.full((height, 1), 2.0, dtype=noise_psd.dtype, device=noise_psd.device)
    double[0] = 1.0
    if rows % 2 == 0:
        double[-1] = 1.0
    weight = noise_psd / (n_frames * rows * columns)
    ratio = noise_psd / (n_frames * object_psd)
    if _are_even(object_psd, noise_psd):
        weights, ratios = [weight[:height] * double], [ratio[:height]]
    else:
        weights = [weight[:height], _reflect(weight)[:height] * (double - 1)]
        ratios = [ratio[:height], _reflect(ratio)[:height]]
    return torch.stack(weights), torch.stack(ratios)


class _Kept(NamedTuple):
    layers: Layers
    object_psd: Tensor
    noise_psd: Tensor
    state: tuple[object, ...]


class KeptLayers:
    """Layers that are made again where a PSD or the number of frames has changed. A copy begins with none."""

    def __init__(self) -> None:
        self._kept: _Kept | None = None

    def __reduce__(self) -> tuple[type[KeptLayers], tuple[()]]:
        return type(self), ()  # tensors of a copy count their changes anew

    def of(
        self, object_psd: Tensor, noise_psd: Tensor, n_frames: int, make: Callable[[Tensor, Tensor, int], Layers]
    ) -> Layers:
        """Return what `make` returns for the PSDs and the number of frames.

        Raises ValueError if a PSD requires a gradient, or is mapped over by `torch.func.vmap`.
        """
        if torch.compiler.is_compiling():  # it cannot see whether a tensor has changed
            return make(object_psd, noise_psd, n_frames)
        kept, state = self._kept, (n_frames, _version(object_psd), _version(noise_psd))
        same = kept is not None and kept.object_psd is object_psd and kept.noise_psd is noise_psd
        if kept is None or not same or kept.state != state:
            _require_numbers(object_psd, noise_psd)
            with torch.inference_mode(False), torch.no_grad():
                kept = self._kept = _Kept(make(object_psd, noise_psd, n_frames), object_psd, noise_psd, state)
        return kept.layers


def _require_numbers(*psds: Tensor) -> None:
    """Raise ValueError for PSDs that `torch.func.vmap` maps over, or that require a gradient."""
    if torch.is_grad_enabled() and any(psd.requires_grad for psd in psds):
        raise ValueError("a PSD requires a gradient, which a criterion has in the centres only: detach the PSD")
    if not all(can_be_read(psd) or psd.is_meta for psd in psds):
        raise ValueError("torch.func.vmap over a criterion runs over the centres: the PSDs must be the same for all")


def _version(psd: Tensor) -> object:
    """Return what differs once a tensor was changed in place; in inference mode, where torch does not tell, always."""
    return object() if psd.is_inference() else psd._version


def _are_even(*psds: Tensor) -> bool:
    """Return whether PSDs are known to be the same at opposite frequencies, which needs numbers."""
    has_numbers = not (torch.compiler.is_compiling() or any(psd.is_meta for psd in psds))
    return has_numbers and all(bool((psd == _reflect(psd)).all()) for psd in psds)


def _reflect(image: Tensor) -> Tensor:
    """Return the image (H, W) at the negative frequencies."""
    return image.flip(-2, -1).roll((1, 1), (-2, -1))

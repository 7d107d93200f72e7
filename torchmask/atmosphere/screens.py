"""Random phase screens of von Karman turbulence."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from torchmask.atmosphere.endless import Screen, ScreenWindow
from torchmask.atmosphere.random_field import COMPLEX, RandomField, split_spectrum
from torchmask.atmosphere.von_karman import require_turbulence
from torchmask.numbers import whole_number


def phase_screens(
    shape: tuple[int, int],
    step: float | tuple[float, float],
    r0: float,
    outer_scale: float,
    n_screens: int,
    generator: torch.Generator | None = None,
    dtype: torch.dtype | None = None,
    device: torch.device | str | None = None,
) -> Tensor:
    """Draw independent von Karman phase screens (n_screens, rows, columns) [rad].

    Parameters
    ----------
    shape : (rows, columns)
        Number of samples of a screen.
    step : float or (dy, dx)
        Spacing of the samples [m].
    r0 : float
        Fried parameter [m].
    outer_scale : float
        Outer scale of the turbulence [m].
    n_screens : int
        Number of screens. The first ones are the same however many are drawn.
    generator : torch.Generator, optional
        Source of randomness, on the CPU or on `device`.
    dtype : torch.dtype, optional
        float32 or float64; torch's default dtype by default.
    device : torch.device, optional
        Device of the screens, the CPU by default.

    Raises
    ------
    ValueError
        If a length is not finite and positive, or a count is not a whole number of at least 1.
    TypeError
        If `dtype` is neither float32 nor float64.

    Examples
    --------
    >>> generator = torch.Generator().manual_seed(0)
    >>> screens = phase_screens((64, 64), 0.02, r0=0.15, outer_scale=20.0, n_screens=3, generator=generator)
    >>> screens.shape
    torch.Size([3, 64, 64])
    """
    shape, step, dtype, device = _resolve(shape, step, dtype, device)
    n_screens = whole_number("n_screens", n_screens)
    require_turbulence(r0, outer_scale)
    extent = (shape[0] * step[0], shape[1] * step[1])
    field = RandomField(
        split_spectrum(extent, _margin(extent, step), step, r0, outer_scale), shape, step, dtype, device
    )
    screens = torch.empty(n_screens, *shape, dtype=dtype, device=device)
    for first in range(0, n_screens, 2):
        pair = torch.view_as_real(field.sum(field.draw(generator))).movedim(-1, 0)
        screens[first : first + 2] = pair[: n_screens - first]
    return screens


def frozen_flow(
    shape: tuple[int, int],
    step: float | tuple[float, float],
    r0: float,
    outer_scale: float,
    displacements: Tensor,
    generator: torch.Generator | None = None,
    dtype: torch.dtype | None = None,
    device: torch.device | str | None = None,
) -> Tensor:
    """Return one random screen displaced as a whole (n_frames, rows, columns) [rad].

    Frame t is screen(x - displacements[t]). `displacements` (n_frames, 2) [m], (x, y), may be of any size, fractions
    of a sample included (see `torchmask.atmosphere.endless`). Other arguments and errors are those of `phase_screens`;
    ValueError also for displacements of another shape, or of no frame.
    """
    shape, step, dtype, device = _resolve(shape, step, dtype, device)
    require_turbulence(r0, outer_scale)
    if displacements.ndim != 2 or displacements.shape[1] != 2 or not len(displacements):
        raise ValueError(
            f"displacements has shape {tuple(displacements.shape)}: it must be (n_frames, 2), (x, y) in m for each of "
            "at least one frame"
        )
    screen = Screen(ScreenWindow(shape, step, outer_scale, dtype, device), r0, draw_seed(generator))
    return torch.stack([screen.at((-dx, -dy)) for dx, dy in displacements.detach().cpu().double().tolist()])


def draw_seed(generator: torch.Generator | None) -> int:
    """Draw a seed for generators of another kind, such as NumPy's."""
    device = "cpu" if generator is None else generator.device
    return int(torch.randint(2**62, (1,), generator=generator, device=device))


def _margin(extent: tuple[float, float], step: tuple[float, float]) -> float:
    """Return the distance [m] over which the first band loses its correlation."""
    return max(0.25 * max(extent), 16 * max(step))


def _resolve(
    shape: tuple[int, int],
    step: float | tuple[float, float],
    dtype: torch.dtype | None,
    device: torch.device | str | None,
) -> tuple[tuple[int, int], tuple[float, float], torch.dtype, torch.device]:
    rows, columns = (whole_number("a side of shape", side) for side in shape)
    steps = np.asarray(step, dtype=float)
    if steps.shape not in ((), (2,)) or not (np.isfinite(steps) & (steps > 0)).all():
        raise ValueError(f"step is {step}: it must be finite and positive, in m, one number or two (dy, dx)")
    dy, dx = np.broadcast_to(steps, 2).tolist()
    dtype = dtype or torch.get_default_dtype()
    if dtype not in COMPLEX:
        raise TypeError(f"dtype is {dtype}: it must be float32 or float64")
    return (rows, columns), (dy, dx), dtype, torch.device(device or "cpu")

"""Simple methods to compare a restoration with: the mean of registered frames, and its average PSF.

scikit-image's `richardson_lucy` and `unsupervised_wiener` accept both directly.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchmask.atmosphere.phase import TurbulencePhase
from torchmask.grid import Grid
from torchmask.io import extra
from torchmask.metrics import shift
from torchmask.observation import check_frames
from torchmask.optics.aperture import Aperture
from torchmask.optics.psf import PSF

_OVERSAMPLING = 4  # of the pupil, because phases change within the cells of the Nyquist raster


def shift_and_add(frames: Tensor) -> Tensor:
    """Return the mean of frames registered to a tenth of a pixel, first to the sharpest frame, then to their mean.

    Parameters
    ----------
    frames : (T, H, W) tensor
        Exposures in any unit.

    Returns
    -------
    Tensor
        (H, W) in the unit of the frames, float64 on the CPU.

    Raises
    ------
    ValueError
        If the shape is wrong, a value is not finite or a frame has no light.

    Examples
    --------
    A complete Richardson-Lucy restoration:

    >>> from skimage.restoration import richardson_lucy
    >>> from torchmask.optics.aperture import SparseAperture
    >>> mask, grid = SparseAperture.from_catalog("golay3", 1.0, 0.15), Grid.nyquist(1.0, 550e-9, 32)
    >>> frames = torch.full((4, 32, 32), 20.0); frames[:, 12:20, 12:20] = 1000.0
    >>> psf = average_psf(mask, grid, TurbulencePhase(0.3, 20.0), torch.Generator().manual_seed(0))
    >>> image = shift_and_add(frames).clamp(min=1.0)
    >>> richardson_lucy((image / image.max()).numpy(), psf.numpy(), num_iter=10).shape
    (32, 32)
    """
    with extra("data"):
        from skimage.registration import phase_cross_correlation

    shape = (int(frames.shape[-2]), int(frames.shape[-1])) if frames.ndim >= 2 else (0, 0)
    stack = check_frames(frames, None, Grid(shape, 1.0, 1.0))[0].cpu()
    options: dict[str, Any] = {"upsample_factor": 10, "normalization": None}
    mean = stack[stack.std((1, 2)).argmax()]
    for _ in range(2):
        offsets = [phase_cross_correlation(mean.numpy(), frame, **options)[0] for frame in stack.numpy()]
        mean = shift(stack, torch.from_numpy(np.stack(offsets))).mean(0)
    return mean


def average_psf(
    aperture: Aperture,
    grid: Grid,
    turbulence: TurbulencePhase,
    generator: torch.Generator | None = None,
    n_frames: int = 100,
) -> Tensor:
    """Return the PSF of `shift_and_add`, from a point source behind `n_frames` new screens of the same turbulence.

    The result (H', W') has unit sum and is float64 on the CPU, on the pixels of the grid. Its sides are odd, one pixel
    less than an even side of the grid, with the peak in the middle. Raises ValueError if the grid samples the aperture
    too coarsely.

    Examples
    --------
    >>> from torchmask.optics.aperture import SparseAperture
    >>> mask, grid = SparseAperture.from_catalog("golay3", 1.0, 0.15), Grid.nyquist(1.0, 550e-9, 32)
    >>> psf = average_psf(mask, grid, TurbulencePhase(0.3, 20.0), torch.Generator().manual_seed(0), n_frames=5)
    >>> psf.shape, divmod(int(psf.argmax()), 31)
    (torch.Size([31, 31]), (15, 15))
    """
    rows, columns = grid.shape
    with torch.no_grad():
        phase = turbulence(aperture.samples(grid, _OVERSAMPLING), n_frames, generator)
        stars = PSF(aperture, grid, _OVERSAMPLING)(phase)
    mean = shift_and_add(torch.fft.fftshift(stars, dim=(-2, -1))).clamp(min=0)
    row, column = divmod(int(mean.argmax()), columns)
    psf = mean.roll((rows // 2 - row, columns // 2 - column), (0, 1))
    psf = psf[1 - rows % 2 :, 1 - columns % 2 :]  # an even side has no middle pixel
    return psf / psf.sum()

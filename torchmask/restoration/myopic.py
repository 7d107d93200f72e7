"""Myopic deconvolution: the object and the aberrations of every frame, together."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from torchmask.grid import Grid
from torchmask.optics.aperture import Aperture
from torchmask.record import Callback
from torchmask.restoration.initialization import check_frames
from torchmask.restoration.model import ExposureModel
from torchmask.restoration.parallel import each_on_a_core
from torchmask.restoration.priors import root, whitening
from torchmask.restoration.result import RestorationResult
from torchmask.restoration.run import Restoration


class MyopicDeconvolution(nn.Module):
    """Restores an object from short exposures with unknown aberrations.

    Minimises, over an object o >= 0 and the whitened aberrations z of every frame (a = L z, L L^T the von Karman
    covariance of the Zernike modes of all sub-apertures), in units of the stack's mean pixel,

        1/2 sum_t || (g_t window(h_t(a_t) * o) - y_t) / sigma ||^2  +  mu TV(o)  +  1/2 ||z||^2

    by bounded L-BFGS in variables scaled by the diagonal of the Hessian, from zero aberrations and the clipped mean
    frame. It restarts every 100 iterations: then the scales, the transmission g_t of each frame and, if r0 is not
    given, the strength of the turbulence are brought up to date; sigma falls from what the mean frame leaves
    unexplained to the noise or to what the model cannot explain, if that is more; a mask's frames that fit badly start
    anew from random aberrations, and the object is moved between the pixels to where it fits best. When nothing moves
    any more, each frame has its own sigma, so that one which no aberrations explain does little harm: a frame whose
    chi-square is n times that of the best counts n times less, or n^2 times through a full pupil. A full pupil has
    many more minima: each of its frames begins with 16 random candidates, which share one object and of which the
    worse half is dropped after 30, 100 and 200 iterations, and all but the best after 300.

    Parameters
    ----------
    aperture : Aperture
    grid : Grid
        Of the frames.
    n_modes : int, optional
        Zernike modes per sub-aperture, Noll 1 to n_modes. None: 6, or 231 for a full pupil.
    r0, outer_scale : float, optional
        Of the turbulence [m]. None: r0 is estimated from the restored aberrations; 20 mask diameters.
    readout_noise : float, optional
        [electrons rms per pixel]. None: the noise is measured beyond the cut-off frequency.
    wavelengths, weights : sequence of float, optional
        A broad band as a few wavelengths [m], and the share of the light of each (any positive numbers; None: equal).
        Coefficients are rad at the wavelength of the grid, and path differences the same for all. None: only that.
    static_modes : int
        Zernike modes per sub-aperture, Noll 1 to static_modes, of aberrations common to all frames, such as those of
        the telescope, besides the `n_modes` of each frame. Their prior is turbulence as strong as a hole is wide,
        whatever `r0`. Coefficients then have max(n_modes, static_modes) modes, and are the sum of both.
    tv_weight : float
        mu.
    aberration_prior : bool
        False leaves out 1/2 ||z||^2; z are the Zernike coefficients then.
    max_iterations : int
        Of a start. A restoration that leaves 0.13 % of the change from frame to frame unexplained, and more than the
        noise can leave, may have missed the object: it starts again from random aberrations, up to three times as long
        as that is so and no two end alike, and the best is kept.
    tolerance : float
        Converged when 100 iterations lower the cost by less than this fraction.
    dtype : torch.dtype
        Of the model; float32 takes half the time. Object, aberrations and cost are always kept in float64.

    Raises
    ------
    ValueError
        For numbers out of range, and for a grid that the aperture cannot be sampled on.

    Examples
    --------
    The method as first published is `MyopicDeconvolution(mask, grid, n_modes=3, aberration_prior=False)`.

    >>> from torchmask.optics.aperture import SparseAperture
    >>> mask = SparseAperture([[0.0, 0.3], [-0.3, -0.2], [0.3, -0.2]], 0.2, 1.0)
    >>> method = MyopicDeconvolution(mask, Grid.nyquist(1.0, 550e-9, 32), n_modes=3, r0=0.2, max_iterations=5)
    >>> frames = torch.full((4, 32, 32), 20.0); frames[:, 12:20, 12:20] = 1000.0
    >>> result = method.restore(torch.poisson(frames, generator=torch.Generator().manual_seed(0)))
    >>> result.object.shape, result.coefficients.shape
    (torch.Size([32, 32]), torch.Size([4, 3, 3]))
    """

    def __init__(
        self,
        aperture: Aperture,
        grid: Grid,
        n_modes: int | None = None,
        r0: float | None = None,
        outer_scale: float | None = None,
        readout_noise: float | None = None,
        *,
        wavelengths: Sequence[float] | None = None,
        weights: Sequence[float] | None = None,
        static_modes: int = 0,
        tv_weight: float = 1.0,
        aberration_prior: bool = True,
        max_iterations: int = 1000,
        tolerance: float = 1e-4,
        dtype: torch.dtype = torch.float64,
        device: torch.device | str | None = None,
    ) -> None:
        super().__init__()
        if aperture.centers.ndim != 2:
            raise ValueError(
                f"centers has shape {tuple(aperture.centers.shape)}: one mask (n_subapertures, 2) is needed"
            )
        for name, value in (("r0", r0), ("outer_scale", outer_scale), ("tv_weight", tv_weight)):
            if value is not None and not (math.isfinite(value) and value > 0):
                raise ValueError(f"{name} is {value}: it must be finite and positive")
        if readout_noise is not None and not (math.isfinite(readout_noise) and readout_noise >= 0):
            raise ValueError(f"readout_noise is {readout_noise}: it must be finite and at least 0, in electrons rms")
        if max_iterations < 1 or not tolerance >= 0:
            raise ValueError(
                f"max_iterations is {max_iterations} and tolerance {tolerance}: they must be at least 1 and at least 0"
            )
        if static_modes < 0:
            raise ValueError(f"static_modes is {static_modes}: it must be at least 0")
        if n_modes is not None and n_modes < 1:
            raise ValueError(f"n_modes is {n_modes}: it must be a whole number of at least 1, or None for the default")
        symmetric = aperture.n_subapertures == 1
        n_modes = n_modes or (231 if symmetric else 6)
        self.known_r0: bool = r0 is not None
        # Masks are made for holes of about r0; a full pupil that needs a restoration spans several.
        self.r0: float = r0 or aperture.subaperture_diameter / (7 if symmetric else 1)
        self.outer_scale: float = outer_scale or 20 * aperture.mask_diameter
        self.readout_noise: float | None = readout_noise
        self.tv_weight: float = tv_weight
        self.aberration_prior: bool = aberration_prior
        self.max_iterations: int = max_iterations
        self.tolerance: float = tolerance
        self.aperture: Aperture = aperture
        self.grid: Grid = grid
        self.n_modes: int = max(n_modes, static_modes)

        def mixing(modes: int, r0: float) -> Tensor:
            """Coefficients (N J) of the modes 1 to `modes` from their parameters."""
            n_sub = aperture.n_subapertures
            columns = (
                whitening(aperture, modes, r0, self.outer_scale)
                if aberration_prior
                else torch.eye(n_sub * modes, device="cpu")
            )
            rows = columns.unflatten(0, (n_sub, modes))
            return nn.functional.pad(rows, (0, 0, 0, self.n_modes - modes)).flatten(0, 1)

        columns = mixing(n_modes, self.r0)
        static = mixing(static_modes, aperture.subaperture_diameter) if static_modes else columns[:, :0]
        self._build = partial(ExposureModel, aperture, grid, self.n_modes, wavelengths=wavelengths, weights=weights)
        mixed = torch.cat([columns, static.to(columns)], dim=1)
        self.model: ExposureModel = self._build(mixed, n_static=static.shape[1], dtype=dtype, device=device)

    def model_of_errors(self, covariance: Tensor) -> ExposureModel:
        """The model in which the errors of estimated coefficients, of `covariance` (N J, N J) [rad^2], are white."""
        size = self.aperture.n_subapertures * self.n_modes
        if tuple(covariance.shape) != (size, size):
            raise ValueError(
                f"covariance has shape {tuple(covariance.shape)}: it must be ({size}, {size}), sub-aperture by "
                f"sub-aperture, of {self.aperture.n_subapertures} x {self.n_modes} coefficients"
            )
        if self.model.n_static:
            raise ValueError("covariance is given with static_modes: what is common to all frames is in the estimate")
        basis = self.model.basis
        return self._build(root(covariance.to(basis.device, torch.float64)), dtype=basis.dtype, device=basis.device)

    def restore(
        self,
        frames: Tensor | np.ndarray,
        *,
        valid: Tensor | np.ndarray | None = None,
        coefficients: Tensor | None = None,
        covariance: Tensor | None = None,
        known_object: Tensor | None = None,
        start: RestorationResult | None = None,
        n_samples: int = 0,
        checkpoint: str | Path | None = None,
        callback: Callback | None = None,
    ) -> RestorationResult:
        """Restore the object behind `frames` (T, H, W) [electrons].

        Parameters
        ----------
        frames : (T, H, W) tensor or array
            Single pixels may be negative (read-out noise).
        valid : (H, W) or (T, H, W) boolean tensor or array, optional
            False where a pixel is dead or saturated; it is left out, whatever its value.
        coefficients : (T, N, J) tensor, optional
            Known aberrations [rad rms], which stay as they are: non-blind deconvolution.
        covariance : (N J, N J) tensor, optional
            Of the errors of `coefficients` [rad^2], sub-aperture by sub-aperture, the same for all frames, such as a
            wave-front sensor has: they are refined then, with these errors as their prior in place of turbulence.
            Errors below 1 mrad count as 1 mrad.
        known_object : (H, W) tensor, optional
            Known object, up to its flux, which stays as it is: only the aberrations are restored.
        start : RestorationResult, optional
            Goes on from there (warm start). It may come from the first T' <= T of these frames: the aberrations of the
            new frames are then fitted to its object before everything is refined together.
        n_samples : int
            Drawn from the posterior for the standard deviations of object and coefficients, which cost about as much
            as 50 iterations each; 8 are enough. 0: no standard deviations.
        checkpoint : path, optional
            An .npz file, written every 100 iterations. If it exists, the restoration goes on from it, and ends in the
            same result as if it had never been interrupted.
        callback : callable, optional
            Gets a `Record` after every iteration; every tenth holds the object and the coefficients.

        Raises
        ------
        ValueError
            If a shape is wrong, a valid pixel or what is known is not finite, a frame or the known object holds no
            light, both object and aberrations are known, `covariance` is not one or stands without coefficients or
            beside static modes, or the checkpoint is damaged or belongs to other frames, settings or known values.

        Warns
        -----
        UserWarning
            If the noise of the frames disagrees with `readout_noise`, or the object seems to reach the border.
        """
        started = time.perf_counter()
        frames, valid = check_frames(frames, valid, self.grid)
        if n_samples < 0 or n_samples == 1:
            raise ValueError(f"n_samples is {n_samples}: 0 for no standard deviations, or at least 2")
        if covariance is not None and coefficients is None:
            raise ValueError("covariance is given without coefficients: it is that of their errors, give both")
        if coefficients is not None and known_object is not None and covariance is None:
            raise ValueError("coefficients and known_object are both given: nothing is left to restore")
        with each_on_a_core(self.model.basis.device) as parallel:
            run = Restoration(self, frames, valid, covariance, callback, parallel)
            return run(coefficients, known_object, start, n_samples, checkpoint, started)

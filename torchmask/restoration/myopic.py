"""Myopic deconvolution: the object and the aberrations of every frame, together."""

from __future__ import annotations

import math
import time
import warnings
from dataclasses import dataclass

import numpy as np
import torch
from scipy.optimize import Bounds, minimize
from torch import Tensor, nn

from torchmask.grid import Grid
from torchmask.optics.aperture import Aperture
from torchmask.record import Callback, Record
from torchmask.restoration.initialization import mean_frame, noise_variance
from torchmask.restoration.model import ExposureModel
from torchmask.restoration.priors import total_variation, total_variation_curvature, whitening
from torchmask.restoration.result import RestorationResult

SEGMENT = 100  # iterations between restarts of L-BFGS-B, at which scales, gains and r0 are brought up to date
_CORRECTIONS = 20
_OBJECT_STEP = 0.3  # of the object's scale against that of the aberrations
_SEED = 0  # of the probes that measure curvature; the result hardly depends on it


@dataclass
class _State:
    """Everything that goes on from one segment to the next."""

    image: Tensor  # (H', W') in units of the stack's mean pixel
    z: Tensor  # (T, K)
    gains: Tensor  # (T,)


class MyopicDeconvolution(nn.Module):
    """Restores an object from short exposures with unknown aberrations.

    Minimises, over an object o >= 0 and whitened aberrations z of every frame (a = L z, L L^T the von Karman
    covariance of the Zernike modes of all sub-apertures), in units of the stack's mean pixel,

        1/2 sum_t || (g_t window(h_t(a_t) * o) - y_t) / sigma ||^2  +  mu TV(o)  +  1/2 ||z||^2

    by L-BFGS-B in variables scaled by the diagonal of the Hessian, starting from zero aberrations and the clipped mean
    frame.

    Parameters
    ----------
    aperture : Aperture
    grid : Grid
        Of the frames.
    n_modes : int, optional
        Zernike modes per sub-aperture, Noll 1 to n_modes. None: 10, or 136 for a full pupil.
    r0, outer_scale : float, optional
        Of the turbulence [m]. None: r0 from the restored tilts, and 20 mask diameters.
    readout_noise : float, optional
        [electrons rms per pixel]. None: the noise is measured beyond the cut-off frequency.
    tv_weight : float
        mu.
    aberration_prior : bool
        False leaves out 1/2 ||z||^2; z are the Zernike coefficients then.
    max_iterations : int
    tolerance : float
        Converged when 100 iterations lower the cost by less than this fraction.

    Raises
    ------
    ValueError
        For numbers out of range, and for a grid that the aperture cannot be sampled on.

    Examples
    --------
    The method as first published is `MyopicDeconvolution(mask, grid, n_modes=3, aberration_prior=False)`.
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
        tv_weight: float = 1.0,
        aberration_prior: bool = True,
        max_iterations: int = 700,
        tolerance: float = 1e-3,
        dtype: torch.dtype = torch.float64,
    ) -> None:
        super().__init__()
        if aperture.centers.ndim != 2:
            raise ValueError(f"centers has shape {tuple(aperture.centers.shape)}: one mask (n_subapertures, 2) is needed")
        for name, value in (("r0", r0), ("outer_scale", outer_scale), ("tv_weight", tv_weight)):
            if value is not None and not (math.isfinite(value) and value > 0):
                raise ValueError(f"{name} is {value}: it must be finite and positive")
        if readout_noise is not None and not (math.isfinite(readout_noise) and readout_noise >= 0):
            raise ValueError(f"readout_noise is {readout_noise}: it must be finite and at least 0, in electrons rms")
        if max_iterations < 1:
            raise ValueError(f"max_iterations is {max_iterations}: it must be at least 1")
        self.n_modes = n_modes or (136 if aperture.n_subapertures == 1 else 10)
        self.r0 = r0
        self.outer_scale = outer_scale or 20 * aperture.mask_diameter
        self.readout_noise = readout_noise
        self.tv_weight = tv_weight
        self.aberration_prior = aberration_prior
        self.max_iterations = max_iterations
        self.tolerance = tolerance
        self.aperture = aperture
        self.grid = grid
        # One sub-aperture's size is the scale that masks are made for; a full pupil sees some speckles across.
        guess = aperture.subaperture_diameter / (1 if aperture.n_subapertures > 1 else 7)
        mixing = whitening(aperture, self.n_modes, r0 or guess, self.outer_scale) if aberration_prior else None
        self.prior_r0 = r0 or guess
        self.model = ExposureModel(aperture, grid, self.n_modes, mixing, dtype=dtype)

    def restore(self, frames: Tensor, callback: Callback | None = None) -> RestorationResult:
        """Restore the object behind `frames` (T, H, W) [electrons].

        Parameters
        ----------
        frames : (T, H, W) tensor
            Single pixels may be negative (read-out noise).
        callback : callable, optional
            Gets a `Record` after every iteration; every tenth holds the object and the coefficients.

        Raises
        ------
        ValueError
            If the shape is wrong, a value is not finite, or a frame holds no light.
        """
        started = time.perf_counter()
        frames = self._checked(frames)
        return _Restoration(self, frames, callback).run(started)

    def _checked(self, frames: Tensor) -> Tensor:
        frames = torch.as_tensor(frames)
        if frames.ndim != 3 or frames.shape[1:] != self.grid.shape or not len(frames):
            raise ValueError(
                f"frames has shape {tuple(frames.shape)}: it must be (n_frames, {self.grid.shape[0]}, "
                f"{self.grid.shape[1]}), as the grid says"
            )
        frames = frames.to(self.model.basis)
        bad = ~torch.isfinite(frames).flatten(1).all(1)
        if bool(bad.any()):
            raise ValueError(f"frames {bad.nonzero().flatten().tolist()} hold values that are not finite")
        dark = frames.mean((1, 2)) <= 0
        if bool(dark.any()):
            raise ValueError(f"frames {dark.nonzero().flatten().tolist()} hold no light: leave them out")
        return frames


class _Restoration:
    """One run: frames in units of their mean pixel, and the problem as L-BFGS-B sees it."""

    def __init__(self, method: MyopicDeconvolution, frames: Tensor, callback: Callback | None) -> None:
        self.method = method
        self.model = method.model
        self.callback = callback
        self.unit = float(frames.mean())
        self.frames = frames / self.unit
        measured = noise_variance(frames, method.grid, method.aperture)
        if method.readout_noise is None:
            self.variance = measured
        else:
            self.variance = float(frames.mean()) + method.readout_noise**2
            if not 1 / 1.5 < measured / self.variance < 1.5:
                warnings.warn(
                    f"the frames' noise is {measured**0.5:.3g} electrons rms, but photon noise and readout_noise "
                    f"make {self.variance**0.5:.3g}: check the gain and readout_noise",
                    stacklevel=4,
                )
        self.precision = torch.full_like(self.frames[:1, :1, :1], self.unit**2 / self.variance)
        self.costs: list[float] = []
        self.n_evaluations = 0

    def run(self, started: float) -> RestorationResult:
        method = self.method
        image = mean_frame(self.frames, self.model.field).double()
        z = torch.zeros(len(self.frames), self.model.n_parameters, dtype=torch.float64)
        state = _State(image, z, self.frames.mean((1, 2)).double())
        message, converged = "iterations exhausted", False
        while len(self.costs) < method.max_iterations:
            before = self.costs[-1] if self.costs else math.inf
            state = self._segment(state, min(SEGMENT, method.max_iterations - len(self.costs)))
            if before - self.costs[-1] < method.tolerance * self.costs[-1]:
                message, converged = f"converged: {SEGMENT} iterations changed the cost by less than {method.tolerance:g}", True
                break
        return self._result(state, message, converged, time.perf_counter() - started)

    def _segment(self, state: _State, n_iterations: int) -> _State:
        """L-BFGS-B from `state`, in variables scaled anew."""
        model, method = self.model, self.method
        generator = torch.Generator().manual_seed(_SEED)
        precision = self.precision * state.gains[:, None, None].to(self.precision) ** 2
        data = self.frames / state.gains[:, None, None].to(self.frames)
        curvature, pixel = model.curvature(state.image, state.z, precision, generator)
        z_scale = (curvature + 1).rsqrt()
        image_scale = _OBJECT_STEP * (pixel + method.tv_weight * total_variation_curvature(state.image)).rsqrt()
        n = state.image.numel()

        def split(x: np.ndarray) -> tuple[Tensor, Tensor]:
            flat = torch.from_numpy(x)
            return flat[:n].view_as(state.image) * image_scale, flat[n:].view_as(state.z) * z_scale

        def cost(x: np.ndarray) -> tuple[float, np.ndarray]:
            self.n_evaluations += 1
            image, z = split(x)
            misfit = model.misfit(image, z, data, precision)
            variation, variation_gradient = total_variation(image)
            value = misfit.value.sum() + method.tv_weight * variation
            image_gradient = misfit.object_gradient + method.tv_weight * variation_gradient
            z_gradient = misfit.aberration_gradient
            if method.aberration_prior:
                value, z_gradient = value + 0.5 * (z**2).sum(), z_gradient + z
            gradient = torch.cat([(image_gradient * image_scale).flatten(), (z_gradient * z_scale).flatten()])
            return float(value), gradient.numpy()

        def progress(intermediate_result: object) -> None:
            self._record(float(intermediate_result.fun), lambda: split(intermediate_result.x))  # type: ignore[attr-defined]

        start = torch.cat([(state.image / image_scale).flatten(), (state.z / z_scale).flatten()]).numpy()
        lower = np.full(len(start), -np.inf)
        lower[:n] = 0
        options = {"maxiter": n_iterations, "maxfun": 4 * n_iterations, "maxcor": _CORRECTIONS, "ftol": 1e-12, "gtol": 0}
        result = minimize(
            cost, start, jac=True, method="L-BFGS-B", bounds=Bounds(lower, np.inf), options=options, callback=progress
        )
        if not self.costs:
            self.costs.append(float(result.fun))
        image, z = split(result.x)
        return _State(image, z, self._gains(image, z))

    def _gains(self, image: Tensor, z: Tensor) -> Tensor:
        """Best transmission of each frame, 1 on average."""
        gains = []
        for part in self.model.chunks(len(z)):
            frames = self.model(image, z[part])
            gains.append((frames * self.frames[part]).sum((1, 2)) / (frames**2).sum((1, 2)))
        gain = torch.cat(gains).double()
        return gain / gain.mean()

    def _record(self, cost: float, state: object) -> None:
        self.costs.append(cost)
        if self.callback is None:
            return
        step, arrays = len(self.costs), {}
        if step == 1 or step % 10 == 0:
            image, z = state()  # type: ignore[operator]
            rows, columns = self.method.grid.shape
            arrays = {"object": image[:rows, :columns] * self.unit, "coefficients": self._coefficients(z)}
        self.callback(Record("restoration", step, self.method.max_iterations, {"cost": cost}, arrays))

    def _coefficients(self, z: Tensor) -> Tensor:
        flat = z @ self.model.mixing.to(z).T
        return flat.unflatten(1, (self.method.aperture.n_subapertures, self.method.n_modes))

    def _result(self, state: _State, message: str, converged: bool, seconds: float) -> RestorationResult:
        rows, columns = self.method.grid.shape
        gains = state.gains[:, None, None].to(self.frames)
        frames = torch.cat([self.model(state.image, state.z[part]) for part in self.model.chunks(len(state.z))]) * gains
        residuals = (self.frames - frames) * self.precision.sqrt()
        image = state.image * self.unit
        return RestorationResult(
            object=image[:rows, :columns].clone(),
            extended_object=image,
            coefficients=self._coefficients(state.z),
            gains=state.gains,
            model=frames * self.unit,
            residuals=residuals,
            chi_square=(residuals**2).mean((1, 2)),
            tv_weight=self.method.tv_weight,
            r0=self.method.prior_r0 if self.method.aberration_prior else math.nan,
            noise=self.variance**0.5,
            cost=torch.tensor(self.costs, dtype=torch.float64),
            converged=converged,
            message=message,
            n_evaluations=self.n_evaluations,
            seconds=seconds,
        )

"""torchmask's exposures as deepinv physics, and deepinv's priors in torchmask's restoration.

Needs the extra `deepinv`. Nothing else in torchmask imports this module.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchmask.io import extra
from torchmask.observation import Observation
from torchmask.optics.detector import image_formation, image_formation_adjoint
from torchmask.restoration.priors import ObjectPrior

with extra("deepinv"):
    from deepinv.optim import Prior  # pyright: ignore[reportMissingImports] -- an extra
    from deepinv.physics import LinearPhysics, PoissonGaussianNoise  # pyright: ignore[reportMissingImports] -- an extra


class StackPhysics(LinearPhysics):
    """A stack of short exposures with known point-spread functions: y = noise(A x), with A x the T blurred images.

    Parameters
    ----------
    psfs : (T, rows, columns) or (B, T, rows, columns) tensor
        Unfolded PSFs with their origin at [0, 0] (FFT order), at least 2 H - 1 by 2 W - 1 for images of H x W, as
        `psf_from_samples` returns them for a field twice as wide. They become a buffer; images must have the same dtype
        and device.
    unit : float
        Electrons per pixel that correspond to 1 in images and frames. deepinv's denoisers expect images up to about 1.
    readout_noise : float
        Read-out noise [electrons rms per pixel and frame].
    generator : torch.Generator, optional
        Source of the random noise.
    sky : float
        Light that does not come from the object [electrons per pixel and frame]. `measured` takes it off, and its
        photon noise is part of the read-out noise.

    Raises
    ------
    ValueError
        If `psfs` has neither 3 nor 4 axes, `unit` is not finite and positive, `readout_noise` or `sky` is negative
        or not finite, or an image or a stack does not have the axes below.

    Notes
    -----
    Images are (B, 1, H, W) and frames (B, T, H, W), with the exposures in deepinv's channel axis. The convolution is
    linear, as in `image_formation`: light that leaves the field is lost. For non-negative PSFs of unit sum the norm of
    A is at most sqrt(T). The noise is `PoissonGaussianNoise(gain=1 / unit, sigma=readout_noise / unit)`; negative
    rounding errors of the FFTs are clipped.

    Examples
    --------
    >>> observation = Observation.load("stack.npz")  # doctest: +SKIP
    >>> physics, frames = StackPhysics.from_observation(observation)  # doctest: +SKIP
    >>> restored = deepinv.optim.FISTA(  # doctest: +SKIP
    ...     deepinv.optim.L2(), deepinv.optim.TVPrior(), lambda_reg=1e-3, stepsize=1 / len(observation.frames)
    ... )(frames, physics)
    """

    psfs: Tensor

    def __init__(
        self,
        psfs: Tensor,
        unit: float = 1.0,
        readout_noise: float = 0.0,
        generator: torch.Generator | None = None,
        sky: float = 0.0,
    ) -> None:
        if psfs.ndim not in (3, 4):
            raise ValueError(f"psfs has shape {tuple(psfs.shape)}: it must be (T, rows, columns), or that for a batch")
        if not (math.isfinite(unit) and unit > 0):
            raise ValueError(f"unit is {unit}: it must be finite and positive, in electrons per pixel")
        if not (math.isfinite(readout_noise) and readout_noise >= 0):
            raise ValueError(f"readout_noise is {readout_noise}: it must be finite and not negative, in electrons rms")
        if not (math.isfinite(sky) and sky >= 0):
            raise ValueError(f"sky is {sky}: it must be finite and not negative, in electrons per pixel and frame")
        even = math.sqrt(readout_noise**2 + sky)
        noise = PoissonGaussianNoise(1 / unit, even / unit, clip_positive=True, rng=generator)
        super().__init__(noise_model=noise.to(psfs.dtype), device=psfs.device)  # type: ignore[arg-type]
        self.unit: float = float(unit)
        self.sky: float = float(sky)
        self.register_buffer("psfs", psfs)

    @classmethod
    def from_observation(
        cls, observation: Observation, unit: float | None = None, generator: torch.Generator | None = None
    ) -> tuple[StackPhysics, Tensor]:
        """Return the physics of a simulated observation with its true PSFs, and its frames (1, T, H, W) in `unit`.

        Its true transmissions are part of the PSFs, and its true sky is `sky`. Light beyond the stored PSFs is treated
        as lost, and unknown read-out noise as zero. By default `unit` is the
        99.9th percentile of the mean frame, which the peak of a restored object exceeds a few times. Raises ValueError
        if the observation has no PSFs.
        """
        if observation.psfs is None:
            raise ValueError("the observation has no psfs: create a StackPhysics from restored or calibrated ones")
        height, width = observation.grid.shape
        psfs = observation.frames.new_zeros(len(observation.frames), 2 * height, 2 * width)
        psfs[..., :height, :width] = observation.psfs
        psfs = psfs.roll((-(height // 2), -(width // 2)), dims=(-2, -1))
        if observation.transmission is not None:
            psfs = psfs * observation.transmission.to(psfs)[:, None, None]
        sky = observation.background or 0.0
        if unit is None:
            unit = float(torch.quantile(observation.frames.mean(0) - sky, 0.999))
        physics = cls(psfs, unit, observation.readout_noise or 0.0, generator, sky)
        return physics, physics.measured(observation.frames)

    def measured(self, frames: Tensor) -> Tensor:
        """Convert frames (T, H, W) or (B, T, H, W) [electrons] to measurements (B, T, H, W) without sky."""
        return ((frames if frames.ndim == 4 else frames[None]).to(self.psfs) - self.sky) / self.unit

    def A(self, x: Tensor, **kwargs: object) -> Tensor:
        """Return the expected frames (B, T, H, W) of images (B, 1, H, W)."""
        if x.ndim != 4 or x.shape[1] != 1:
            raise ValueError(f"the image has shape {tuple(x.shape)}: it must be (batch, 1, rows, columns)")
        return image_formation(x, self.psfs)

    def A_adjoint(self, y: Tensor, **kwargs: object) -> Tensor:
        """Apply the adjoint of `A` to frames (B, T, H, W); returns images (B, 1, H, W)."""
        n_frames = self.psfs.shape[-3]
        if y.ndim != 4 or y.shape[1] != n_frames:
            raise ValueError(f"the stack has shape {tuple(y.shape)}: it must be (batch, {n_frames}, rows, columns)")
        return image_formation_adjoint(y, self.psfs).sum(1, keepdim=True)


class DeepinvPrior(ObjectPrior):
    """A deepinv prior on the object of a `MyopicDeconvolution`: weight * prior(image / unit).

    Parameters
    ----------
    prior : deepinv.optim.Prior
        An explicit prior, which has a value, such as `TVPrior`; plug-and-play denoisers have none.
    weight : float
        Weight of the prior.
    unit : float
        Pixel value that corresponds to 1 in the prior, in units of the mean pixel of the stack.

    Raises
    ------
    ValueError
        If the prior has no value, or a number is not finite and positive.

    Examples
    --------
    >>> prior = DeepinvPrior(deepinv.optim.SmoothedTVPrior(), weight=1.0)  # doctest: +SKIP
    >>> method = MyopicDeconvolution(mask, grid, prior=prior)  # doctest: +SKIP
    """

    def __init__(self, prior: Prior, weight: float = 1.0, unit: float = 1.0) -> None:
        super().__init__()
        if not prior.explicit_prior:
            raise ValueError(f"{type(prior).__name__} has no value to minimise: give an explicit prior such as TVPrior")
        for name, value in (("weight", weight), ("unit", unit)):
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"{name} is {value}: it must be finite and positive")
        self.prior = prior
        self.weight: float = float(weight)
        self.unit: float = float(unit)

    def forward(self, image: Tensor) -> Tensor:
        return self.weight * self.prior(image[None, None] / self.unit).sum()

    def value_and_gradient(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """Return value and gradient, by deepinv's own gradient, which handles kinks of the penalty."""
        with torch.no_grad():
            value = self(image)
        slope = self.prior.grad(image.detach()[None, None] / self.unit)[0, 0]
        return value, (self.weight / self.unit) * slope.detach()

    def extra_repr(self) -> str:
        return f"weight={self.weight:g}, unit={self.unit:g}"

"""The cost that a restoration minimises over the object and the aberrations of every frame."""

from __future__ import annotations

from collections.abc import Callable
from enum import Flag, auto
from typing import NamedTuple

import torch
from torch import Tensor, nn

from torchmask.restoration.adjoint import data_fidelity
from torchmask.restoration.forward import ExposureModel
from torchmask.restoration.parallel import Map
from torchmask.restoration.placed import PlacedSamples, centers_of
from torchmask.restoration.priors import ObjectPrior
from torchmask.restoration.state import LEAST_TRANSMISSION, Calibration


class Free(Flag):
    """Unknowns of an objective that may change; the others are known."""

    OBJECT = auto()
    ABERRATIONS = auto()
    """Aberrations of each frame."""
    COMMON = auto()
    """Aberrations common to all frames."""
    PLACE = auto()
    """Geometry of the mask: a rotation and a magnification."""


class CostAndGradients(NamedTuple):
    """The cost and its gradients, which are zero in what is not free.

    value : scalar cost
    object_gradient : (H', W') gradient in the object
    aberration_gradient : (T, K) gradient in the parameters of the aberrations
    place_gradient : (2,) gradient in a step of the mask; None if no step is given
    """

    value: Tensor
    object_gradient: Tensor
    aberration_gradient: Tensor
    place_gradient: Tensor | None = None


class ScaledData(NamedTuple):
    """Frames as at unit transmission.

    frames : (T, H, W) frames divided by their transmission g
    precision : (T, H, W) inverse noise variance, times g^2 and divided by the noise inflation
    unit : (T, 1, 1) what a background of 1 amounts to, 1 / g
    """

    frames: Tensor
    precision: Tensor
    unit: Tensor


class MyopicObjective(nn.Module):
    """Negative log-posterior of an object and of the aberrations of every frame.

        1/2 sum precision / inflation (transmission * model + background - frames)^2 + prior(image)
        + weight/2 |z - centre|^2

    A free background, of each frame or of all, is always the best-fitting one, with a small penalty on the object's
    light (`Background`).

    `forward(image, z)` returns the cost as a scalar that autograd differentiates, to any order, in the image, in z and
    in the centres of the model's aperture; the matrix of the aberration basis stays fixed when the centres change.
    `value_and_gradients` gives the same value and its first gradients in image and z at a fraction of the time and
    memory, by the adjoint.

    Parameters
    ----------
    model : ExposureModel
        Model of the exposures.
    frames : (T, H, W) tensor
        Exposures in units of their mean.
    precision : tensor that broadcasts to the frames' shape, with its first axis of length T or 1
        Inverse noise variance of each pixel in those units, 0 where it is not valid.
    prior : ObjectPrior
        Prior on the object.
    centre : (T, K) tensor, optional
        Expected aberrations. None: zero.
    free : Free
        Unknowns to optimise.
    prior_copies : int
        Factor on the object's prior, for `frames` that contain every frame so many times.
    parallel : callable
        Function like `map`, which is applied to a few frames, or positions of the object, at a time.

    Examples
    --------
    >>> from torchmask.grid import Grid
    >>> from torchmask.optics.aperture import SparseAperture
    >>> from torchmask.restoration.variation import TotalVariation
    >>> mask = SparseAperture([[0.0, 0.3], [-0.3, -0.2], [0.3, -0.2]], 0.2, 1.0)
    >>> model = ExposureModel(mask, Grid.nyquist(1.0, 550e-9, 32), 3)
    >>> frames = torch.rand(4, 32, 32, dtype=torch.float64)
    >>> objective = MyopicObjective(model, frames, torch.tensor([[[1e4]]]).double(), TotalVariation())
    >>> image = torch.rand(model.window.field.shape, dtype=torch.float64, requires_grad=True)
    >>> z = torch.zeros(4, 9, dtype=torch.float64, requires_grad=True)
    >>> objective(image, z).backward()
    >>> torch.allclose(image.grad, objective.value_and_gradients(image.detach(), z.detach()).object_gradient)
    True
    """

    frames: Tensor
    precision: Tensor
    centre: Tensor

    def __init__(
        self,
        model: ExposureModel,
        frames: Tensor,
        precision: Tensor,
        prior: ObjectPrior,
        *,
        centre: Tensor | None = None,
        free: Free = Free.OBJECT | Free.ABERRATIONS | Free.COMMON,
        prior_copies: int = 1,
        parallel: Map = map,
    ) -> None:
        super().__init__()
        if centre is None:
            shape = (len(frames), model.aberrations.n_parameters)
            centre = torch.zeros(shape, dtype=torch.float64, device=frames.device)
        self.model: ExposureModel = model
        self.prior: ObjectPrior = prior
        self.register_buffer("frames", frames, persistent=False)
        self.register_buffer("precision", precision, persistent=False)
        self.register_buffer("centre", centre, persistent=False)
        self.free: Free = free
        self.prior_copies: int = prior_copies
        self.parallel: Map = parallel

    def with_changes(
        self,
        *,
        model: ExposureModel | None = None,
        centre: Tensor | None = None,
        free: Free | None = None,
        prior: ObjectPrior | None = None,
    ) -> MyopicObjective:
        """Return the objective with another model, other expected aberrations, other unknowns free or another prior."""
        return MyopicObjective(
            model or self.model,
            self.frames,
            self.precision,
            prior or self.prior,
            centre=self.centre if centre is None else centre,
            free=self.free if free is None else free,
            prior_copies=self.prior_copies,
            parallel=self.parallel,
        )

    def of_frames(self, part: slice | Tensor, *, free: Free | None = None, prior_copies: int = 1) -> MyopicObjective:
        """Return the objective of some of the frames, which may be repeated."""
        return MyopicObjective(
            self.model,
            self.frames[part],
            self.precision[part] if len(self.precision) > 1 else self.precision,
            self.prior,
            centre=self.centre[part],
            free=self.free if free is None else free,
            prior_copies=prior_copies,
            parallel=self.parallel,
        )

    def neutral_calibration(self) -> Calibration:
        """Return the calibration with transmissions from the frames' mean light, and noise and priors as given.

        A frame that shows only background, or by its noise even less, has the least transmission.
        """
        light = (self.frames - self.model.background.first_guess(self.frames)).mean((1, 2)).double()
        transmission = (light / light.mean()).clamp(min=LEAST_TRANSMISSION)
        return Calibration(transmission, torch.ones_like(transmission), 1.0)

    def forward(self, image: Tensor, z: Tensor, calibration: Calibration | None = None) -> Tensor:
        calibration = calibration or self.neutral_calibration()
        frames, precision, unit = self.scaled_data(calibration)
        if len(z) != len(frames):
            raise ValueError(f"z has shape {tuple(z.shape)} for {len(frames)} frames: it must have a row for each")
        residual = self.model.background.residual(frames - self.model(image, z), precision, unit)
        misfit = 0.5 * (precision * residual**2).sum().to(image.dtype)
        hold = 0.5 * (self.aberration_weight(calibration, z) * (z - self.centre) ** 2).sum()
        return misfit + self.prior_copies * (self.prior(image) + self.model.background.price * image.sum()) + hold

    def value_and_gradients(self, image: Tensor, z: Tensor, calibration: Calibration | None = None) -> CostAndGradients:
        """Return the cost and its gradients in `image` (H', W') and `z` (T, K), by the adjoint."""
        return self.evaluator(calibration or self.neutral_calibration())(image, z)

    def evaluator(self, calibration: Calibration) -> Callable[..., CostAndGradients]:
        """Return `value_and_gradients` as a function for one calibration, for which the frames are scaled only once.

        Its third argument is a step (2,) that rotates [rad] and shrinks the mask (`placed.PlacedSamples`).
        """
        frames, precision, unit = self.scaled_data(calibration)
        with torch.no_grad():
            samples = self.model.pupil.samples()  # once: whether they are up to date is asked of the device
        centers = centers_of(self.model.pupil)
        by_object = Free.OBJECT in self.free
        by_aberrations = bool(self.free & (Free.ABERRATIONS | Free.COMMON))

        @torch.no_grad()
        def evaluate(image: Tensor, z: Tensor, step: Tensor | None = None) -> CostAndGradients:
            placed = None if step is None else PlacedSamples(self.model.pupil, centers, step)
            misfit = data_fidelity(
                self.model,
                image,
                z,
                frames,
                precision,
                want_object=by_object,
                want_aberrations=by_aberrations or placed is not None,
                unit=unit,
                samples=samples if placed is None else placed.samples,
                want_samples=placed is not None,
                parallel=self.parallel,
            )
            penalty, slope = self._penalty_and_slope(image)
            weight, away = self.aberration_weight(calibration, z), z - self.centre
            value = misfit.value.sum() + self.prior_copies * penalty + 0.5 * (weight * away**2).sum()
            image_gradient, z_gradient = torch.zeros_like(image), torch.zeros_like(z)
            if misfit.object_gradient is not None:
                image_gradient = misfit.object_gradient + self.prior_copies * slope
            if by_aberrations and misfit.aberration_gradient is not None:
                z_gradient = self._within_free(misfit.aberration_gradient + weight * away)
            by_place = None
            if placed is not None:
                assert misfit.weight_gradient is not None
                assert misfit.basis_gradient is not None
                by_place = placed.pull_back(misfit.weight_gradient, misfit.basis_gradient)
            return CostAndGradients(value, image_gradient, z_gradient, by_place)

        return evaluate

    def _penalty_and_slope(self, image: Tensor) -> tuple[Tensor, Tensor]:
        value, slope = self.prior.value_and_gradient(image)
        price = self.model.background.price
        return value + price * image.sum(), slope + price

    def _within_free(self, gradient: Tensor) -> Tensor:
        """Return the gradient (T, K), zero in what is not free and equal in all frames for common aberrations."""
        basis = self.model.aberrations
        if Free.ABERRATIONS not in self.free:
            gradient = basis.with_common_of(torch.zeros_like(gradient), gradient)
        if not basis.n_common:
            return gradient
        if Free.COMMON in self.free:
            return basis.mean_common(gradient)
        return basis.with_common_of(gradient, torch.zeros_like(gradient[:1]))

    def scaled_data(self, calibration: Calibration) -> ScaledData:
        """Return the frames as at unit transmission."""
        transmission = calibration.transmission[:, None, None].to(self.frames)
        inflation = calibration.noise_inflation[:, None, None].to(transmission)
        scaled = self.precision * (transmission**2 / inflation)
        return ScaledData(self.frames / transmission, scaled, 1 / transmission)

    def aberration_weight(self, calibration: Calibration, z: Tensor) -> float | Tensor:
        """Return the weight of a frame's (z - centre)^2 / 2.

        Common aberrations count once in all frames, and their weight does not follow the turbulence.
        """
        n_common, value = self.model.aberrations.n_common, calibration.aberration_weight
        if not n_common:
            return value
        weight = torch.full_like(z[0], value)
        weight[-n_common:] = self.prior_copies / len(z) if value else 0.0
        return weight

    def frame_costs(self, image: Tensor, z: Tensor, calibration: Calibration) -> Tensor:
        """Return misfit plus prior of the aberrations for each frame (T,)."""
        frames, precision, unit = self.scaled_data(calibration)
        misfit = data_fidelity(
            self.model, image, z, frames, precision, want_object=False, want_aberrations=False, unit=unit
        )
        return misfit.value.to(z) + 0.5 * (self.aberration_weight(calibration, z) * (z - self.centre) ** 2).sum(1)

    @torch.no_grad()
    def object_quadratic(self, image: Tensor, z: Tensor, calibration: Calibration) -> tuple[Tensor, Tensor]:
        """Return gradient (H', W') and Hessian (H', W'/2 + 1) of the misfit in the object, for known aberrations.

        The gradient is exact; the Hessian is that of frames as large as the field, which is diagonal in frequency.
        """
        frames, precision, unit = self.scaled_data(calibration)
        slope = data_fidelity(
            self.model, image, z, frames, precision, want_aberrations=False, unit=unit, parallel=self.parallel
        ).object_gradient
        assert slope is not None
        power = torch.zeros_like(torch.fft.rfft2(image).real)
        for part in self.model.chunks(len(z)):
            transfer = torch.fft.rfft2(self.model.psf(z[part]))
            weight = precision[part].mean((1, 2), keepdim=True)
            power += ((transfer.real**2 + transfer.imag**2) * weight).sum(0).to(power)
        if self.model.response is not None:
            power *= self.model.response.abs().to(power) ** 2
        return slope, power

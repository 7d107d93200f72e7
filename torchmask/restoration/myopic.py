"""Myopic deconvolution: the object and the aberrations of every frame, together."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from torchmask.grid import Grid
from torchmask.interferometry.orientation import warn_of_orientation
from torchmask.optics.aperture import Aperture
from torchmask.optics.band import Band
from torchmask.optics.pixel import PixelResponse
from torchmask.record import Callback
from torchmask.restoration.assembly import add_deviations, assemble_result
from torchmask.restoration.background import Background
from torchmask.restoration.checkpoint import Checkpoint
from torchmask.restoration.forward import ExposureModel
from torchmask.restoration.frames import Array, FrameStack
from torchmask.restoration.given_prior import as_prior, check_prior
from torchmask.restoration.memory import keep_freed_memory
from torchmask.restoration.objective import MyopicObjective
from torchmask.restoration.parallel import each_on_a_core
from torchmask.restoration.priors import ObjectPrior, TotalVariation
from torchmask.restoration.projected_lbfgs import Minimizer, ProjectedLBFGS
from torchmask.restoration.recipe import ModelRecipe
from torchmask.restoration.result import RestorationResult
from torchmask.restoration.schedule import Schedule
from torchmask.restoration.solver import Solver
from torchmask.restoration.starts import Known
from torchmask.restoration.traits import Refinement, Traits, check_numbers, check_samples


class MyopicDeconvolution:
    """Restores an object from short exposures with unknown aberrations.

    Minimises, over an object o >= 0 and the whitened aberrations z of every frame (a = L z, L L^T the von Karman
    covariance of the Zernike modes of all sub-apertures), in units of the stack's mean pixel,

        1/2 sum_t || (g_t window(h_t(a_t) * o) + b_t - y_t) / sigma ||^2  +  prior(o)  +  1/2 ||z||^2

    from the clipped mean frame on, with the background b_t that fits best. `torchmask.restoration.solver` tells the
    course of it: how the noise sigma and the transmissions g_t are brought up to date on the way, and how it leaves
    local minima. Through a mask and of faint frames, where this object is biased, it ends at the one that is likeliest
    whatever the aberrations (`torchmask.restoration.marginal`).

    Parameters
    ----------
    aperture : Aperture
        One that moves or trains is followed: a restoration takes it where it lies when it begins.
    grid : Grid
        Of the frames.
    n_modes : int, optional
        Zernike modes per sub-aperture, Noll 1 to n_modes. None: 6, or 231 for a full pupil.
    r0, outer_scale : float, optional
        Of the turbulence [m]. None: r0 is estimated from the restored aberrations, and the outer scale is taken as 20
        mask diameters.
    readout_noise : float, optional
        [electrons rms per pixel]. None: the noise is measured beyond the cut-off frequency.
    wavelengths, weights : sequence of float, optional
        A broad band as a few wavelengths [m] (None: that of the grid), and the light of each, any positive numbers
        (None: equal). Coefficients are rad at the wavelength of the grid, and path differences the same for all.
    static_modes : int
        Zernike modes per sub-aperture, Noll 1 to static_modes, of aberrations common to all frames, such as the
        telescope's, besides the `n_modes` of each. Their prior is turbulence with r0 as wide as a hole, whatever `r0`.
        Coefficients then have max(n_modes, static_modes) modes, and are the sum of both.
    background : Background, float or tensor
        Light on every pixel that is not the object's: with `Background.PER_FRAME` a constant of its own in each frame,
        which is found with the object, by default if the frames show a sky, with `Background.NONE` never; or what is
        known of it [electrons per pixel], a number or a tensor that broadcasts to the frames. Its noise always counts.
    pixel : PixelResponse, optional
        How the detector's pixels blur the image: `SquarePixel(fill_factor)`, or `MappedPixel` with a map of their
        sensitivity. The object is restored without it. None: pixels are points.
    exposure_tau0 : float
        How long a frame lasts, in units of tau0 = 0.314 r0 / wind. Piston, tip and tilt of every hole may then change
        evenly during a frame, and coefficients are those in its middle. 0: frames are snapshots.
    refine_geometry : bool, optional
        Whether a turn and an even magnification of the mask are found with the object. None: if the frames say clearly
        that it lies otherwise than told. Frames of a star tell it more precisely, and more of it: `calibrate_mask`.
    prior : callable
        Of the object: a function or module that maps an image (H', W'), in units of the stack's mean pixel and on a
        field somewhat wider than the frames, to a scalar that PyTorch differentiates. At hand are `TotalVariation` and
        `EdgePreserving`. If it has methods `gradient(image)` and `curvature(image)`, they are used.
    aberration_prior : bool
        False leaves out 1/2 ||z||^2; z are the Zernike coefficients then.
    max_iterations : int
        Of all starts together; one takes 1000 at most. A start whose verdict is that it does not explain the frames may
        have missed the object: up to three more begin at random aberrations, until one explains them or two end alike,
        and the best is kept.
    tolerance : float
        Converged when 100 iterations lower the cost by less than this fraction.
    minimizer : Minimizer
        What descends: `ProjectedLBFGS`, or an optimiser of PyTorch by `TorchMinimizer`.
    schedule : Schedule
        When the restoration does what.
    dtype : torch.dtype
        Of the model; float32 takes half the time. Object, aberrations and cost are always kept in float64.

    Raises
    ------
    ValueError
        For numbers out of range, and for a grid that the aperture cannot be sampled on.
    TypeError
        If the prior cannot be called.

    Examples
    --------
    The method as first published is `MyopicDeconvolution(mask, grid, n_modes=3, aberration_prior=False,
    background=Background.NONE, schedule=Schedule.plain())`.

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
        background: Background | float | Tensor = Background.IF_SEEN,
        pixel: PixelResponse | None = None,
        exposure_tau0: float = 0.0,
        refine_geometry: bool | None = None,
        prior: Callable[[Tensor], Tensor] | None = None,
        aberration_prior: bool = True,
        max_iterations: int = 4000,
        tolerance: float = 1e-4,
        minimizer: Minimizer | None = None,
        schedule: Schedule | None = None,
        dtype: torch.dtype = torch.float64,
        device: torch.device | str | None = None,
    ) -> None:
        check_numbers(readout_noise, max_iterations, tolerance)
        if wavelengths is None and weights is not None:
            raise ValueError("weights are given without wavelengths: give both")
        self.many_minima: bool = aperture.n_subapertures == 1
        self.known_r0: bool = r0 is not None
        self.recipe: ModelRecipe = ModelRecipe(
            aperture,
            grid,
            Band.of([grid.wavelength] if wavelengths is None else wavelengths, weights),
            frame_modes=(231 if self.many_minima else 6) if n_modes is None else n_modes,
            static_modes=static_modes,
            # Masks are made for holes of about r0; a full pupil that needs a restoration spans several.
            r0=aperture.subaperture_diameter / (7 if self.many_minima else 1) if r0 is None else r0,
            outer_scale=20 * aperture.mask_diameter if outer_scale is None else outer_scale,
            whitened=aberration_prior,
            pixel=pixel,
            exposure_tau0=exposure_tau0,
            dtype=dtype,
            device=device,
        )
        self.refinement: Refinement = Refinement.of(refine_geometry, aperture)
        self.readout_noise: float | None = readout_noise
        self.background: Background | float | Tensor = background
        self.max_iterations, self.tolerance = max_iterations, tolerance
        self.prior: ObjectPrior = as_prior(TotalVariation() if prior is None else prior)
        self.minimizer: Minimizer = minimizer or ProjectedLBFGS()
        self.schedule: Schedule = schedule or Schedule()
        self._model: ExposureModel = self.recipe.turbulent_model()

    @property
    def n_modes(self) -> int:
        """J, Zernike modes per sub-aperture of the coefficients that come back."""
        return self.recipe.n_modes

    @property
    def model(self) -> ExposureModel:
        """The model of the exposures, with the aperture where it lies now."""
        if not torch.equal(self._model.pupil.aperture.centers, self.recipe.aperture.centers.detach()):
            self._model = self.recipe.turbulent_model()
        return self._model

    def objective(self, frames: Array, *, valid: Array | None = None, errors: Array | None = None) -> MyopicObjective:
        """The cost of object and aberrations behind `frames` (T, H, W) [electrons], to minimise in a way of your own.

        It is differentiable in the centres of the aperture too. Arguments and errors as for `restore`.
        """
        stack = self._stack(frames, valid, errors)
        model = self.recipe.turbulent_model(follows_aperture=True).beside(stack.free)
        stack = stack.to(model.dtype, model.device)
        return MyopicObjective(model, stack.frames, stack.precision, self.prior)

    def restore(
        self,
        frames: Array,
        *,
        valid: Array | None = None,
        errors: Array | None = None,
        coefficients: Tensor | None = None,
        covariance: Tensor | None = None,
        known_object: Tensor | None = None,
        start: RestorationResult | None = None,
        n_samples: int = 0,
        seed: int = 0,
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
        errors : (H, W) or (T, H, W) tensor or array, optional
            Standard deviations of the pixels' noise [electrons] that were measured. None: the same for all pixels.
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
        seed : int
            Of the random starts and candidates, and of the samples of aberrations that are integrated out.
        checkpoint : path, optional
            An .npz file, written every 100 iterations. If it exists, the restoration goes on from it, and ends in the
            same result as if it had never been interrupted.
        callback : callable, optional
            Gets a `Record` after every iteration; every tenth holds the object and the coefficients.

        Raises
        ------
        ValueError
            If a shape is wrong, a valid pixel or what is known is not finite, one of `errors` not positive, a frame or
            the known object holds no light, both object and aberrations are known, `covariance` is not one or stands
            without coefficients or beside static modes, the prior is no finite and differentiable scalar, or the
            checkpoint is damaged or belongs to other frames, settings or known values.

        Warns
        -----
        UserWarning
            If noise, border or fringes of the frames do not fit `readout_noise`, the field or the mask's orientation.
        """
        started = time.perf_counter()
        check_samples(n_samples)
        keep_freed_memory()
        stack = self._stack(frames, valid, errors)
        warn_of_orientation(stack.frames, self.recipe.aperture, self.recipe.grid)
        (known := Known(coefficients, covariance, known_object)).check()
        model = (self.model if covariance is None else self.recipe.estimated_model(covariance)).beside(stack.free)
        stack = stack.to(model.dtype, model.device)
        with each_on_a_core(model.device) as parallel:
            objective = MyopicObjective(
                model, stack.frames, stack.precision, self.prior, free=known.free, parallel=parallel
            )
            traits, moving = self._traits(known, seed), self.recipe.moving_basis(model.aberrations)
            solver = Solver(objective, stack, traits, self.schedule, self.minimizer, callback, moving)
            settings = (replace(traits, max_iterations=0, tolerance=0.0), self.minimizer, self.schedule)
            check_prior(self.prior, model.window.embed(stack.frames.mean(0).clamp(min=0)).double())
            progress = solver.solve(known, start, Checkpoint.of(checkpoint, objective, settings, known.tensors))
            found = (progress, solver.prior_r0, solver.verdict(progress.ending))
            result = assemble_result(solver.objective, stack, *found)
            if n_samples:
                result = add_deviations(result, solver.objective, stack, progress, n_samples)
        return replace(result, seconds=time.perf_counter() - started)

    def _stack(self, frames: Array, valid: Array | None, errors: Array | None) -> FrameStack:
        grid, aperture = self.recipe.bluest_grid, self.recipe.aperture
        return FrameStack.of(frames, valid, grid, aperture, self.readout_noise, self.background, errors)

    def _traits(self, known: Known, seed: int) -> Traits:
        return Traits(
            many_minima=self.many_minima,
            estimated=known.estimated,
            prior_on_aberrations=self.recipe.whitened,
            r0_is_open=self.recipe.whitened and not self.known_r0 and not known.estimated,
            r0=self.recipe.r0,
            outer_scale=self.recipe.outer_scale,
            max_iterations=self.max_iterations,
            tolerance=self.tolerance,
            seed=seed,
            refinement=self.refinement.where(blind=known.nothing and self.recipe.whitened),
            exposure_tau0=self.recipe.exposure_tau0,
        )

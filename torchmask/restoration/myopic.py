"""Myopic deconvolution: joint estimation of the object and the aberrations of every frame."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from torchmask.grid import Grid
from torchmask.interferometry.which_mask import look_at_mask
from torchmask.memory import keep_freed_memory
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
from torchmask.restoration.objective import MyopicObjective
from torchmask.restoration.parallel import each_on_a_core
from torchmask.restoration.priors import ObjectPrior
from torchmask.restoration.projected_lbfgs import Minimizer, ProjectedLBFGS
from torchmask.restoration.recipe import FULL_MODES, MASK_MODES, ModelRecipe
from torchmask.restoration.result import RestorationResult
from torchmask.restoration.schedule import Schedule
from torchmask.restoration.solver import Solver
from torchmask.restoration.starts import Known, tensors_of
from torchmask.restoration.traits import Refinement, Traits, check_given, number_of_iterations, number_of_samples
from torchmask.restoration.variation import TotalVariation


class MyopicDeconvolution:
    """Restores an object from short exposures with unknown aberrations.

    Minimises, over an object o >= 0 and the whitened aberrations z of every frame (a = L z, L L^T the von Karman
    covariance of the Zernike modes of all sub-apertures), in units of the stack's mean pixel,

        1/2 sum_t || (g_t window(h_t(a_t) * o) + b_t - y_t) / sigma ||^2  +  prior(o)  +  1/2 ||z||^2

    starting from the clipped mean frame, with the best-fitting background b_t. `torchmask.restoration.solver` describes
    the algorithm, and `torchmask.restoration.finish` its end, which for a mask depends on how faint the frames are.

    Parameters
    ----------
    aperture : Aperture
        Mask or full pupil. If its centres change (a mask that trains), each restoration uses them as they are then.
    grid : Grid
        Grid of the frames.
    n_modes : int, optional
        Number of Zernike modes per sub-aperture, from Noll index 1. None: 231 for a full pupil, 6 for a mask; a last
        descent then has more (`Schedule.last_modes`). A mask's blind search has 6 at most, others enter after it.
    r0 : float, optional
        Fried parameter of the turbulence [m]. None: it is estimated from the restored aberrations.
    outer_scale : float, optional
        Outer scale of the turbulence [m]. None: 20 mask diameters.
    readout_noise : float, optional
        Read-out noise [electrons rms per pixel]. None: the noise is measured beyond the cut-off frequency.
    wavelengths : sequence of float, optional
        Wavelengths [m] that represent a broad band. None: that of the grid, at which coefficients are in rad anyway.
    weights : sequence of float, optional
        Relative flux at each wavelength, any positive numbers. None: equal.
    static_modes : int
        Number of Zernike modes per sub-aperture, Noll 1 to static_modes, of aberrations common to all frames, with r0
        the sub-aperture diameter in their prior. Coefficients are the sum, with max(n_modes, static_modes) modes.
    background : Background, float or tensor
        Uniform light that does not come from the object, see `Background`; or the known background [electrons per
        pixel], a number or a tensor that broadcasts to the frames. Its photon noise is taken into account.
    pixel : PixelResponse, optional
        Blur by the detector's pixels: `SquarePixel(fill_factor)`, or `MappedPixel` by a map. None: pixels are points.
    exposure_tau0 : float
        Exposure time of a frame in units of tau0 = 0.314 r0 / wind. Piston, tip and tilt of every hole then change
        linearly during a frame; coefficients are those at mid-exposure. 0: frames are snapshots.
    refine_geometry : bool, optional
        Whether to estimate the mask's rotation and magnification too. None: if the frames clearly show it misplaced.
    prior : callable
        Prior on the object: a function or module that maps an image (H', W'), in units of the stack's mean pixel and on
        a field somewhat wider than the frames, to a differentiable scalar, such as `TotalVariation` (the default; it
        suits the object at the end) or `EdgePreserving`. Its `gradient` and `curvature(image)` are used if any.
    aberration_prior : bool
        False: leave out 1/2 ||z||^2; z are then the Zernike coefficients themselves.
    max_iterations : int
        Maximum number over all starts, each of at most 1000. A full pupil gets three, or one if phases are retrieved.
        A mask gets up to nine, while there may be a better one; six or one if its frames are faint, but explained.
    tolerance : float
        A start has converged when 100 iterations gain less than this part of the cost (see `Schedule.nearly_at_rest`).
    minimizer : Minimizer
        `ProjectedLBFGS` (the default), or an optimiser of PyTorch in a `TorchMinimizer`.
    schedule : Schedule
        Numbers that control the course of the restoration.
    dtype : torch.dtype
        Data type of the model; float64 takes up to twice as long. Object, aberrations and cost are always float64.

    Raises
    ------
    ValueError
        If a number is out of range, or the grid samples the aperture too coarsely.
    TypeError
        If the aperture, the grid or a switch is of another type, or the prior is not callable.

    Examples
    --------
    The method as first published is `MyopicDeconvolution(mask, grid, n_modes=3, aberration_prior=False,
    background=Background.NONE, schedule=Schedule.plain())`.

    >>> from torchmask.optics.aperture import SparseAperture
    >>> mask = SparseAperture([[0.0, 0.3], [-0.3, -0.2], [0.3, -0.2]], 0.2, 1.0)
    >>> method = MyopicDeconvolution(mask, Grid.nyquist(1.0, 550e-9, 32), n_modes=3, r0=0.2, max_iterations=5)
    >>> x = torch.arange(32.0) - 16; frames = (20 + 1000 * torch.exp(-(x[:, None] ** 2 + x**2) / 20)).expand(4, 32, 32)
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
        dtype: torch.dtype = torch.float32,
        device: torch.device | str | None = None,
    ) -> None:
        check_given(
            aperture, grid, wavelengths, weights, readout_noise, tolerance, aberration_prior, schedule, minimizer
        )
        self.many_minima, self.known_r0 = aperture.n_subapertures == 1, r0 is not None
        self.schedule: Schedule = schedule or Schedule()
        self.recipe: ModelRecipe = ModelRecipe(
            aperture,
            grid,
            Band.given(Band.of([grid.wavelength] if wavelengths is None else wavelengths, weights), grid.wavelength),
            frame_modes=(FULL_MODES if self.many_minima else MASK_MODES) if n_modes is None else n_modes,
            last_modes=self.schedule.most_modes(self.many_minima) if n_modes is None else 0,
            static_modes=static_modes,
            # The holes of a mask are usually about r0 wide; a full pupil that needs a restoration spans several r0.
            r0=aperture.subaperture_diameter / (7 if self.many_minima else 1) if r0 is None else r0,
            outer_scale=20 * aperture.mask_diameter if outer_scale is None else outer_scale,
            whitened=aberration_prior,
            pixel=pixel,
            exposure_tau0=exposure_tau0,
            dtype=dtype,
            device=device,
        )
        self.refinement: Refinement = Refinement.of(refine_geometry, aperture)
        self.readout_noise, self.background = readout_noise, background
        self.max_iterations, self.tolerance = number_of_iterations(max_iterations), tolerance
        self.prior: ObjectPrior = as_prior(TotalVariation() if prior is None else prior)
        self.minimizer: Minimizer = minimizer or ProjectedLBFGS()
        self._model: ExposureModel = self.recipe.turbulent_model()

    @property
    def n_modes(self) -> int:
        """Number J of Zernike modes per sub-aperture in the restored coefficients."""
        return self.recipe.n_modes

    @property
    def model(self) -> ExposureModel:
        """Model of the exposures, with the present centres of the aperture."""
        if not torch.equal(self._model.pupil.aperture.centers, self.recipe.aperture.centers.detach()):
            self._model = self.recipe.turbulent_model()
        return self._model

    def objective(self, frames: Array, *, valid: Array | None = None, errors: Array | None = None) -> MyopicObjective:
        """Return the cost of object and aberrations for `frames` (T, H, W) [electrons], for a minimiser of your own.

        It is differentiable in the centres of the aperture too. The arguments and errors are those of `restore`.
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
        coefficients: Array | None = None,
        covariance: Array | None = None,
        known_object: Array | None = None,
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
            Exposures. Pixels may be negative (read-out noise).
        valid : (H, W) or (T, H, W) boolean tensor or array, optional
            False where a pixel is dead or saturated; it is ignored, whatever its value.
        errors : (H, W) or (T, H, W) tensor or array, optional
            Standard deviations of the pixels' noise [electrons]. Photon noise in them is evened out (`even_photons`),
            so that bright pixels keep their weight. None: the same for all pixels of frames of about the same light.
        coefficients : (T, N, J) tensor or array, optional
            Known aberrations [rad rms], which stay fixed (non-blind); the frames choose how heavy the prior is then.
        covariance : (N J, N J) tensor or array, optional
            Covariance of the errors of `coefficients` [rad^2], ordered by sub-aperture, the same for all frames. The
            coefficients are then refined, with these errors as their prior. Errors below 1 mrad count as 1 mrad.
        known_object : (H, W) tensor or array, optional
            Known object, up to its flux, which stays fixed: only the aberrations are restored.
        start : RestorationResult, optional
            Earlier result to continue from (warm start). It may come from the first T' <= T of these frames: the
            aberrations of the new frames are then fitted to its object before everything is refined together.
        n_samples : int
            Number of posterior samples for standard deviations, 0 for none; each takes as 50 iterations, 8 are enough.
        seed : int
            Seed of random starts, candidates and samples of aberrations.
        checkpoint : path, optional
            An .npz file, written every 100 iterations, not of phase retrieval, from which a restoration resumes.
        callback : callable, optional
            Called with a `Record` after every iteration; every tenth includes the object and the coefficients.

        Raises
        ------
        ValueError, TypeError
            If a shape is wrong, a valid pixel or a known value is not finite, one of `errors` is not positive, a frame
            or the known object has no light, both object and aberrations are known, `covariance` is not a covariance or
            comes without coefficients or with static modes, the prior is not a finite, differentiable scalar, or the
            checkpoint is damaged or of other frames, settings, known values or another start; if `start` is no result.

        Warns
        -----
        UserWarning
            If noise, border or fringes of the frames contradict `readout_noise`, the field or the mask, or if they show
            too little of the object for the standard deviations that `n_samples` asks for.
        """
        started, n_samples = time.perf_counter(), number_of_samples(n_samples)
        keep_freed_memory()
        told, stack = self.recipe, self._stack(frames, valid, errors)
        (look := look_at_mask(stack.frames, told.aperture, told.grid, told.band, stack.valid)).warn(stacklevel=2)
        known, stack = Known.of(coefficients, covariance, known_object), stack.to(self._model.dtype, self._model.device)
        faint = stack.change.each < self.schedule.faint
        in_steps = known.nothing and start is None and (faint or self.schedule.last_segments > 0)
        recipe = told.for_frames(in_steps=in_steps, faint=faint, fills_field=stack.fills_field)
        model = self.model if replace(recipe, last_modes=told.last_modes) == told else recipe.turbulent_model()
        model = (model if known.covariance is None else recipe.estimated_model(known.covariance)).beside(stack.free)
        with torch.inference_mode(False), each_on_a_core(model.device) as parallel:
            objective = MyopicObjective(
                model, stack.frames, stack.precision, self.prior, free=known.free, parallel=parallel
            )
            traits = replace(self._traits(known, seed), fills_field=stack.fills_field)
            later = recipe.later_bases(model.aberrations, blind=known.nothing)
            solver = Solver(objective, stack, traits, self.schedule, self.minimizer, callback, *later)
            unlimited = replace(traits, max_iterations=0, tolerance=0.0)
            settings = (unlimited, self.minimizer, self.schedule, recipe.last_modes, recipe.exposure_tau0)
            check_prior(self.prior, model.window.embed(stack.frames.mean(0).clamp(min=0)).double())
            file = Checkpoint.of(checkpoint, objective, settings, (*known.tensors, *tensors_of(start)))
            progress = solver.solve(known, start, file, self.n_modes)
            verdict = replace(solver.judge.verdict(solver.objective, progress.ending), **look._asdict())
            verdict = verdict.of_measured_noise() if self.readout_noise is None and errors is None else verdict
            result = assemble_result(solver.objective, stack, progress, solver.prior_r0, verdict, n_modes=self.n_modes)
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
        )

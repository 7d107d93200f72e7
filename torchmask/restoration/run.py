"""One run of a myopic deconvolution, from the frames to the result."""

from __future__ import annotations

import hashlib
import math
import time
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchmask.io import as_array
from torchmask.record import Callback, Record
from torchmask.restoration.checkpoint import Progress, load_checkpoint, save_checkpoint
from torchmask.restoration.crowd import ITERATIONS, N_CANDIDATES, crowd, select
from torchmask.restoration.initialization import (
    border_brightness,
    expected_variance,
    mean_frame,
    turbulence_strength,
)
from torchmask.restoration.model import ExposureModel
from torchmask.restoration.parallel import Map
from torchmask.restoration.posterior import standard_deviations
from torchmask.restoration.problem import JointProblem, State
from torchmask.restoration.repair import repair
from torchmask.restoration.result import RestorationResult
from torchmask.restoration.subpixel import centre_on_pixels

if TYPE_CHECKING:
    from torchmask.restoration.myopic import MyopicDeconvolution

SEGMENT = 100  # iterations between restarts of the descent
_BLURRED = 300  # iterations after which the object is sharp enough to look for its place and for lost frames
_RELOCATIONS = 7  # how often that is done at most
_CONTINUATION = 30.0  # the first noise variance: what the mean frame leaves unexplained over this
_START = 0.7  # rms of the first whitened aberrations of a full pupil, and of further starts
_MISSED = 0.0013  # of the change from frame to frame, left unexplained by the fit: the object is another one
_CHANCE = 2.0  # standard deviations of the stack's chi-square, left to noise
_STARTS = 4  # at most, for objects that were missed
_ALIKE = 0.03  # relative difference of what two starts leave unexplained
_SEED = 0
_BRIGHT_BORDER = 0.5  # of the mean pixel


class Restoration:
    """Holds frames (T, H, W) in units of their mean pixel; calling it restores the object behind them."""

    def __init__(
        self,
        method: MyopicDeconvolution,
        frames: Tensor,
        valid: Tensor,
        covariance: Tensor | None,
        callback: Callback | None,
        parallel: Map,
    ) -> None:
        self.method: MyopicDeconvolution = method
        self.callback: Callback | None = callback
        self.estimated: bool = covariance is not None  # with errors, whose prior replaces that of turbulence
        self.model: ExposureModel = method.model if covariance is None else method.model_of_errors(covariance)
        self.prior: bool = self.estimated or method.aberration_prior
        self.unit: float = float(frames.mean())
        bluest = replace(method.grid, wavelength=self.model.shortest_wavelength)
        self.variance: float = expected_variance(frames, bluest, method.aperture, method.readout_noise, valid)
        if border_brightness(frames) > _BRIGHT_BORDER:
            warnings.warn("the frames are bright at the border: does the object reach beyond the field?", stacklevel=3)
        basis = self.model.basis
        self.frames: Tensor = (frames / self.unit).to(basis)
        self.valid: Tensor = valid.to(basis.device)
        weight = valid.new_ones(1, 1, 1) if bool(valid.all()) else valid
        precision = weight.to(basis) * (self.unit**2 / self.variance)
        centre = torch.zeros(len(frames), self.model.n_parameters, dtype=torch.float64, device=basis.device)
        self.problem: JointProblem = JointProblem(
            self.model, self.frames, precision, centre, method.tv_weight, parallel=parallel
        )
        change = self.frames - self.frames.mean((1, 2), keepdim=True) * self.frames.mean(0)
        self._change = float((change**2 * precision).mean())
        self._first_excess = max(1.0, self._change / _CONTINUATION)
        noise = math.sqrt(2 / frames.numel())  # of the chi-square per pixel
        self._tolerable = max(_MISSED * self._change, _CHANCE * noise)
        self._full = method.aperture.n_subapertures == 1

    def __call__(
        self,
        coefficients: Tensor | None,
        known_object: Tensor | None,
        start: RestorationResult | None,
        n_samples: int,
        checkpoint: str | Path | None,
        started: float,
    ) -> RestorationResult:
        known = {"object": known_object is not None, "aberrations": coefficients is not None and not self.estimated}
        self.problem = replace(self.problem, free=tuple(name for name in known if not known[name]))
        begin = self._begin(coefficients, known_object)
        given = [tensor for tensor in (coefficients, known_object) if tensor is not None]
        if checkpoint is not None and Path(checkpoint).exists():
            progress = self._resume(checkpoint, self._fingerprint(given))
        else:
            progress = Progress(self._first(begin, _SEED)) if start is None else self._warm(begin, start)
        blind = len(self.problem.free) == 2 and not self.estimated and start is None
        # Without a prior a poor fit is the method's own.
        may_restart = blind and self.method.aberration_prior and len(self.frames) > 1
        while not progress.message:
            self._advance(progress)
            if progress.message and may_restart and progress.iterations > _BLURRED:
                self._compare(progress)
            if checkpoint is not None:
                save_checkpoint(checkpoint, progress, self._fingerprint(given))
        result = self._result(progress)
        if n_samples:
            result = replace(result, **self._deviations(progress.state, n_samples))
        return replace(result, seconds=time.perf_counter() - started)

    def _descend(self, progress: Progress, problem: JointProblem, n_iterations: int) -> State:
        n_candidates = len(progress.state.z) // len(self.frames)

        def step(cost: float, evaluations: int, variables: Any) -> None:
            progress.costs.append(cost / n_candidates)
            progress.n_evaluations += evaluations * n_candidates
            self._record(progress, variables)

        left = self.method.max_iterations - progress.iterations
        return problem.descend(progress.state, min(n_iterations, left), step)

    def _choose(self, progress: Progress, n_candidates: int) -> None:
        """One stage of several candidates for each frame, of which half are left then, or one at the last."""
        problem = crowd(self.problem, n_candidates)
        state = self._update(self._descend(progress, problem, ITERATIONS[n_candidates]), problem, _of_equal_excess)
        ends = progress.iterations >= self.method.max_iterations
        progress.state = select(problem, state, n_candidates, 1 if ends else n_candidates // 2)
        if ends:
            progress.message = self._exhausted()

    def _exhausted(self) -> str:
        return f"stopped at max_iterations = {self.method.max_iterations}"

    def _advance(self, progress: Progress) -> None:
        """One segment, then what is brought up to date between two."""
        n_candidates = len(progress.state.z) // len(self.frames)
        if n_candidates > 1:
            self._choose(progress, n_candidates)
            return
        method, problem = self.method, self.problem
        state, done = progress.state, progress.iterations
        before = float(problem.cost(state, state.image, state.z)[0])
        progress.state = state = self._descend(progress, problem, SEGMENT)
        after = float(problem.cost(state, state.image, state.z)[0])
        decrease = (before - after) / abs(after)
        goes_on = progress.iterations < method.max_iterations
        if goes_on and "aberrations" in problem.free and progress.relocations < _RELOCATIONS:
            at_rest = progress.iterations == done
            if at_rest or "object" not in problem.free or progress.iterations >= _BLURRED:
                self._relocate(progress)
        elif decrease <= method.tolerance:
            progress.message = f"converged: the last {SEGMENT} iterations lowered the cost by a fraction {decrease:.1e}"
            return
        if not goes_on:
            progress.message = self._exhausted()
            return
        at_last = progress.relocations == _RELOCATIONS
        progress.state = self._update(progress.state, problem, self._of_own_excess if at_last else _of_equal_excess)

    def _compare(self, progress: Progress) -> None:
        """At the end of a start: the best so far, and another one if that has missed the object.

        Two that end alike have found what there is to be found.
        """
        excess = self._unexplained(progress.state)
        best, alike = excess, False
        if progress.rival is not None:
            before = self._unexplained(progress.rival)
            best, alike = min(before, excess), abs(before - excess) < _ALIKE * max(min(before, excess), self._tolerable)
            if before < excess:
                progress.state, progress.message = progress.rival, progress.rival_message
        if best > self._tolerable and not alike and progress.starts < _STARTS:
            progress.rival, progress.rival_message = progress.state, progress.message
            progress.began, progress.relocations, progress.message = len(progress.costs), 0, ""
            progress.state = self._first(self._begin(None, None), _SEED + progress.starts)
            progress.starts += 1
        elif progress.starts > 1:
            progress.message += f"; the best of {progress.starts} starts, of which some missed the object"

    def _unexplained(self, state: State) -> float:
        """Variance of the residuals above that of the noise, over the latter."""
        return float(self.problem.fit_of_frames(state)[1].mean()) - 1

    def _first(self, state: State, seed: int) -> State:
        """The state with the aberrations to begin with: zero for masks at first, random ones from a full pupil.

        Zero is a saddle point of a full pupil: the sign of the even modes of a point-symmetric pupil cannot be seen.
        """
        if "aberrations" not in self.problem.free or self.estimated or not (self._full or seed != _SEED):
            return state
        n_candidates = N_CANDIDATES if self._full else 1
        z = self._random(state.z.repeat(n_candidates, 1), seed)
        return replace(state, z=z, gains=state.gains.repeat(n_candidates), excess=state.excess.repeat(n_candidates))

    def _random(self, z: Tensor, seed: int) -> Tensor:
        """First aberrations like z (T, K) that are not zero."""
        noise = torch.randn(z.shape, dtype=z.dtype, device="cpu", generator=torch.Generator().manual_seed(seed))
        z = noise.to(z) * (_START if self.method.aberration_prior else _START / 7)
        own = self.model.n_parameters - self.model.n_static
        z[:, own:] = z[0, own:]
        return z

    def _relocate(self, progress: Progress) -> None:
        """What no descent does: frames in a local minimum start anew, the object moves between the pixels.

        Those of a full pupil have had their starts, unless they began where a sensor saw them.
        """
        progress.relocations += 1
        state = progress.state
        if self.estimated or not self._full:
            excess = self.problem.calibrate(state).excess
            state, evaluations = repair(self.problem, state, excess, self._first_excess, seed=progress.relocations)
            progress.n_evaluations += evaluations
        if "object" in self.problem.free:
            state = centre_on_pixels(self.problem, state)
        if state is progress.state:  # all is where it belongs
            progress.relocations = _RELOCATIONS
        progress.state = state

    def _update(self, state: State, problem: JointProblem, weighed: Callable[[State], State]) -> State:
        """Gains, excess noise and strength of the turbulence as the state itself tells them."""
        state = weighed(problem.calibrate(state))
        if state.prior and "aberrations" in self.problem.free:
            state = replace(state, z=self.model.unwrapped(state.z, problem.centre))
        r0_is_open = self.method.aberration_prior and not self.method.known_r0 and not self.estimated
        if not r0_is_open or "aberrations" not in self.problem.free:
            return state
        own = self.model.n_parameters - self.model.n_static
        mixing = self.model.mixing[:, :own]
        strength = turbulence_strength(self._coefficients(state.z[:, :own], mixing), mixing)
        return state if strength is None else replace(state, prior=1 / strength)

    def _of_own_excess(self, state: State) -> State:
        """Each frame weighed by how well it fits.

        That of a full pupil by the square: what is left there comes from another minimum and harms more than white
        noise of that power, whereas that of a mask comes from the modes left out.
        """
        return replace(state, excess=state.excess**2 / state.excess.min()) if self._full else state

    def _begin(self, coefficients: Tensor | None, known_object: Tensor | None) -> State:
        grid, shape = self.method.grid, (len(self.frames), self.model.n_parameters)
        image = mean_frame(self.frames, self.model.field).double()
        z = torch.zeros(shape, dtype=torch.float64, device=image.device)
        if coefficients is not None:
            expected = (len(z), self.method.aperture.n_subapertures, self.method.n_modes)
            if tuple(coefficients.shape) != expected:
                raise ValueError(f"coefficients has shape {tuple(coefficients.shape)}: it must be {expected}")
            if not bool(torch.isfinite(coefficients).all()):
                raise ValueError("coefficients hold values that are not finite")
            z = self._whiten(coefficients)
            if self.estimated:
                self.problem = replace(self.problem, centre=z)
        if known_object is not None:
            if tuple(known_object.shape) != grid.shape:
                raise ValueError(f"known_object has shape {tuple(known_object.shape)}: it must be {grid.shape}")
            image = mean_frame(known_object[None].to(image), self.model.field)
            if not 0 < float(image.sum()) < math.inf:
                raise ValueError("known_object holds values that are not finite, or no light")
            image = image / float(self.model(image, z).mean())
        gains = self.frames.mean((1, 2)).double()
        gains = gains / gains.mean()
        excess = torch.full_like(gains, self._first_excess)
        return State(image, z, gains, 1.0 if self.prior else 0.0, excess)

    def _warm(self, state: State, start: RestorationResult) -> Progress:
        """Go on from `start`; frames that it does not know are first fitted to its object."""
        known, field_shape = len(start.coefficients), tuple(state.image.shape)
        expected = (self.method.aperture.n_subapertures, self.method.n_modes)
        fits = tuple(start.extended_object.shape) == field_shape and tuple(start.coefficients.shape[1:]) == expected
        if known > len(state.z) or not fits:
            raise ValueError(
                f"start has coefficients {tuple(start.coefficients.shape)} and an object on "
                f"{tuple(start.extended_object.shape)} pixels: (at most {len(state.z)}, *{expected}) and {field_shape} "
                "are needed"
            )
        image, z = state.image, state.z.clone()
        if "object" in self.problem.free:
            image = start.extended_object.to(image) / self.unit
        if "aberrations" in self.problem.free:
            z[:known] = self._whiten(start.coefficients)
            own = self.model.n_parameters - self.model.n_static
            z[known:, own:] = z[0, own:]
        progress = Progress(replace(state, image=image, z=z), relocations=_RELOCATIONS)
        if known < len(z) and "aberrations" in self.problem.free:
            fresh = self.problem.of_frames(slice(known, None), free=("aberrations",), static=False)
            n_frames = 0

            def count(cost: float, evaluations: int, variables: Any) -> None:
                nonlocal n_frames
                n_frames += evaluations * len(part.z)

            part = replace(progress.state, z=z[known:], gains=state.gains[known:], excess=state.excess[known:])
            part = self._first(part, _SEED)
            part.z[:, own:] = z[0, own:]
            while (n_candidates := len(part.z) // (len(z) - known)) > 1:
                several = crowd(fresh, n_candidates)
                part = several.descend(part, ITERATIONS[n_candidates], count)
                part = select(several, _of_equal_excess(several.calibrate(part)), n_candidates, n_candidates // 2)
            z[known:] = fresh.descend(part, SEGMENT, count).z
            progress.n_evaluations = n_frames // len(z)
        return progress

    def _record(self, progress: Progress, variables: Any) -> None:
        if self.callback is None:
            return
        step, arrays = len(progress.costs), {}
        if step == 1 or step % 10 == 0:
            image, z = variables()
            rows, columns = self.method.grid.shape
            coefficients = self._coefficients(z[: len(self.frames)])
            arrays = {"object": image[:rows, :columns] * self.unit, "coefficients": coefficients}
        scalars = {"cost": progress.costs[-1]}
        self.callback(Record("restoration", step, progress.began + self.method.max_iterations, scalars, arrays))

    def _coefficients(self, z: Tensor, mixing: Tensor | None = None) -> Tensor:
        flat = z @ (self.model.mixing if mixing is None else mixing).to(z).T
        return flat.unflatten(1, (self.method.aperture.n_subapertures, self.method.n_modes))

    def _whiten(self, coefficients: Tensor) -> Tensor:
        """z (T, K) whose coefficients come closest to (T, N, J); exact but for the mean piston.

        What is common to all frames goes to the common aberrations as far as they reach, which makes those equal.
        """
        own, common = self.model.mixing.double().tensor_split([self.model.n_parameters - self.model.n_static], dim=1)
        flat = coefficients.to(own).flatten(1)
        static = flat.mean(0) @ torch.linalg.pinv(common).T
        z = (flat - static @ common.T) @ torch.linalg.pinv(own).T
        return torch.cat([z, static.expand(len(z), -1)], dim=1)

    def _fingerprint(self, given: list[Tensor]) -> str:
        """Tells whether a checkpoint belongs to these frames and settings, and to what is `given` besides."""
        method = self.method
        settings = (self.problem.free, method.tv_weight, method.aberration_prior, method.known_r0)
        digest = hashlib.sha256(repr(settings).encode())
        for tensor in (self.frames, self.problem.precision, self.model.basis, self.model.weights, *given):
            digest.update(as_array(tensor).tobytes())
        return digest.hexdigest()

    def _resume(self, path: str | Path, fingerprint: str) -> Progress:
        progress = load_checkpoint(path, fingerprint, self.frames.device)
        if progress.message.startswith("stopped") and progress.iterations < self.method.max_iterations:
            progress.message = ""  # a larger budget than before: go on
        return progress

    def _deviations(self, state: State, n_samples: int) -> dict[str, Tensor]:
        """Standard deviations of the object [electrons] and of the coefficients [rad]."""
        rows, columns = self.method.grid.shape
        cutoff = min(0.5, self.method.grid.cutoff(self.method.aperture.extent))
        photons = min(1.0, self.unit / self.variance)
        image, z = standard_deviations(self.problem, state, cutoff, photons, n_samples)
        spread = torch.stack([self._coefficients(sample) for sample in z]).square().mean((0, 1)).sqrt()
        return {"object_std": image[:rows, :columns] * self.unit, "coefficients_std": spread}

    def _result(self, progress: Progress) -> RestorationResult:
        method, state = self.method, progress.state
        rows, columns = method.grid.shape
        gains = state.gains[:, None, None].to(self.frames)
        frames = torch.cat([self.model(state.image, state.z[part]) for part in self.model.chunks(len(state.z))]) * gains
        residuals = (self.frames - frames) * self.problem.precision.sqrt()
        n_valid = self.valid.sum((1, 2)).clamp(min=1)
        image = state.image * self.unit
        of_turbulence = method.aberration_prior and not self.estimated and "aberrations" in self.problem.free
        return RestorationResult(
            object=image[:rows, :columns].clone(),
            extended_object=image,
            coefficients=self._coefficients(state.z),
            gains=state.gains,
            model=frames * self.unit,
            residuals=residuals,
            chi_square=(residuals**2).sum((1, 2)) / n_valid,
            tv_weight=method.tv_weight,
            r0=method.r0 * state.prior ** (3 / 5) if of_turbulence else math.nan,
            noise=self.variance**0.5,
            cost=torch.tensor(progress.costs, dtype=torch.float64, device="cpu"),
            converged=progress.message.startswith("converged"),
            message=progress.message,
            n_evaluations=progress.n_evaluations,
            seconds=0.0,
        )


def _of_equal_excess(state: State) -> State:
    """Common to all frames: those that fit badly are what draws a wrong object to the right one."""
    return replace(state, excess=state.excess.mean().expand_as(state.excess).clone())

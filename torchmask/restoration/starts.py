"""Starting points of a restoration: the mean frame, known values, random aberrations, or an earlier result."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchmask.io import as_tensor
from torchmask.restoration.calibration import calibrate, share_noise_inflation
from torchmask.restoration.candidates import Candidates, play_stage, several
from torchmask.restoration.descent import Variables, descend
from torchmask.restoration.frames import Array
from torchmask.restoration.fringes import change_fringes
from torchmask.restoration.objective import Free, MyopicObjective
from torchmask.restoration.projected_lbfgs import Minimizer
from torchmask.restoration.result import RestorationResult
from torchmask.restoration.schedule import Schedule
from torchmask.restoration.state import Calibration, State
from torchmask.restoration.traits import Traits


@dataclass(frozen=True)
class Known:
    """Values that are known before a restoration begins; None for those that are not.

    coefficients : (T, N, J) aberrations [rad rms]
    covariance : (N J, N J) covariance of their errors [rad^2]; None: they are exact
    object : (H, W) object, up to its flux
    """

    coefficients: Tensor | None = None
    covariance: Tensor | None = None
    object: Tensor | None = None

    @classmethod
    def of(cls, coefficients: Array | None, covariance: Array | None, known_object: Array | None) -> Known:
        """Return what is known, as tensors. Raises ValueError if they are complex, and as `check`."""
        given = {"coefficients": coefficients, "covariance": covariance, "known_object": known_object}
        held = {name: None if values is None else as_tensor(values) for name, values in given.items()}
        for name, values in held.items():
            if values is not None and values.is_complex():
                raise ValueError(f"{name} is {values.dtype}: it must be real, give its real part")
        known = cls(*(None if values is None else values.detach().double() for values in held.values()))
        known.check()
        return known

    def check(self) -> None:
        """Raise ValueError if nothing is left to restore, or a covariance comes without coefficients."""
        if self.covariance is not None and self.coefficients is None:
            raise ValueError("covariance is given without coefficients: it describes their errors, give both")
        if self.coefficients is not None and self.object is not None and self.covariance is None:
            raise ValueError("coefficients and known_object are both given: nothing is left to restore")

    @property
    def tensors(self) -> tuple[Tensor | None, ...]:
        """All known values."""
        return self.coefficients, self.covariance, self.object

    @property
    def estimated(self) -> bool:
        """Whether the aberrations are known with errors."""
        return self.covariance is not None

    @property
    def nothing(self) -> bool:
        """Whether neither aberrations nor object are known."""
        return self.coefficients is None and self.object is None

    @property
    def free(self) -> Free:
        """Unknowns that a restoration estimates."""
        free = Free.OBJECT | Free.ABERRATIONS | Free.COMMON
        if self.object is not None:
            free &= ~Free.OBJECT
        if self.coefficients is not None and self.covariance is None:
            free &= ~(Free.ABERRATIONS | Free.COMMON)
        return free


def expected_parameters(objective: MyopicObjective, coefficients: Tensor | None) -> Tensor:
    """Return the parameters (T, K) of known coefficients (T, N, J), or zero for None.

    Raises ValueError if the coefficients have another shape or are not finite.
    """
    basis = objective.model.aberrations
    if coefficients is None:
        return torch.zeros_like(objective.centre)
    expected = (len(objective.frames), basis.n_subapertures, basis.n_modes)
    if tuple(coefficients.shape) != expected:
        raise ValueError(f"coefficients has shape {tuple(coefficients.shape)}: it must be {expected}")
    if not bool(torch.isfinite(coefficients).all()):
        raise ValueError("coefficients hold values that are not finite: leave out the frames that have them")
    return basis.parameters_of(coefficients)


def first_state(
    objective: MyopicObjective, z: Tensor, known_object: Tensor | None, first_inflation: float, traits: Traits
) -> State:
    """Return the state with the clipped mean frame, or the known object, and the aberrations z (T, K).

    The margin is dark, or as bright as the mean if the object fills the field. Raises ValueError if the known object
    has another shape than the frames, is not finite or has no light.
    """
    window, model = objective.model.window, objective.model
    neutral = objective.neutral_calibration()

    def embedded(image: Tensor) -> Tensor:
        return window.embed(image, float(image.mean()) if traits.fills_field else 0.0)

    light = objective.frames - model.background.first_guess(objective.frames)
    image = embedded(light.mean(0).clamp(min=0)).double()
    if known_object is not None:
        if tuple(known_object.shape) != window.grid.shape:
            raise ValueError(f"known_object has shape {tuple(known_object.shape)}: it must be {window.grid.shape}")
        image = embedded(known_object.to(image).clamp(min=0))
        if not 0 < float(image.sum()) < math.inf:
            raise ValueError(
                "known_object holds values that are not finite, or no light: give the light of each pixel, 0 where it "
                "is dark"
            )
        with torch.no_grad():
            image = image / float(model(image, z).mean())
    inflation = torch.full_like(neutral.transmission, first_inflation)
    return State(image, z, Calibration(neutral.transmission, inflation, traits.aberration_weight))


def has_tournament(objective: MyopicObjective, traits: Traits) -> bool:
    """Return whether a restoration begins with a tournament of candidates.

    Zero is a saddle point for a full pupil: a symmetric pupil does not show the sign of the even modes.
    """
    return traits.many_minima and not traits.estimated and Free.ABERRATIONS in objective.free


def start_rms(traits: Traits, schedule: Schedule) -> float:
    """Return the rms of random aberrations at a start."""
    return schedule.start_rms if traits.prior_on_aberrations else schedule.start_rms_unwhitened


def first_candidates(
    objective: MyopicObjective, state: State, traits: Traits, schedule: Schedule, seed: int
) -> Candidates:
    """Return the candidates of a start: zero aberrations for a mask's first one, random ones for every other."""
    rms = start_rms(traits, schedule)
    if has_tournament(objective, traits):
        return random_candidates(objective, state, schedule.n_candidates, rms, seed)
    if seed == traits.seed:
        return Candidates(state, 1)
    return random_candidates(objective, state, 1, rms, seed)


def random_candidates(objective: MyopicObjective, state: State, n_each: int, rms: float, seed: int) -> Candidates:
    """Return `n_each` candidates with random aberrations for each frame of `state`."""
    candidates = several(state, n_each)
    z = objective.model.aberrations.draw(candidates.state.z, rms, torch.Generator().manual_seed(seed))
    return Candidates(replace(candidates.state, z=z), n_each)


def start_from_result(
    objective: MyopicObjective, state: State, start: RestorationResult, unit: float
) -> tuple[State, int]:
    """Return `state` with the object and aberrations of an earlier result, and the number of frames of that result.

    Further frames keep the aberrations of `state`. Raises ValueError if the earlier result has more frames, another
    mask or another field.
    """
    basis = objective.model.aberrations
    known, *given = start.coefficients.shape
    expected = [basis.n_subapertures, basis.n_modes]
    if given != expected or known > len(state.z):
        raise ValueError(
            f"start is of {known} frames with {given[0]} holes and {given[1]} modes: at most {len(state.z)} frames, "
            f"{expected[0]} holes and {expected[1]} modes are needed, those of this restoration"
        )
    (rows, columns), own = start.object.shape, objective.model.window.grid.shape
    if (rows, columns) != own:
        raise ValueError(
            f"start is of frames of {rows} x {columns} pixels: those of this restoration have {own[0]} x {own[1]}"
        )
    image, z = state.image, state.z.clone()
    kept = (1 - start.light_beyond) / unit
    if Free.OBJECT in objective.free:
        if start.extended_object.shape == image.shape:
            image = start.extended_object.to(image) * kept
        else:  # its margin was another, as the object filled the field and did not, or the reverse
            image = image.clone()
            objective.model.window.crop(image).copy_(start.object * kept)
    if Free.ABERRATIONS in objective.free:
        z[:known] = basis.parameters_of(start.coefficients)
        z[known:] = basis.with_common_of(z[known:], z[:1])
    return replace(state, image=image, z=z, geometry=start.geometry), known


def tensors_of(start: RestorationResult | None) -> tuple[Tensor | None, ...]:
    """Return all of an earlier result that a restoration takes over; nothing if there is none.

    Raises TypeError if it is no result.
    """
    if start is None:
        return ()
    if not isinstance(start, RestorationResult):
        raise TypeError(f"start is a {type(start).__name__}: give what an earlier restoration has returned")
    return start.extended_object, start.coefficients, start.motion, start.geometry.matrix


def fit_new_frames(
    objective: MyopicObjective,
    state: State,
    n_known: int,
    rms: float | None,
    schedule: Schedule,
    minimizer: Minimizer,
    seed: int,
) -> tuple[State, int]:
    """Fit the aberrations of the frames from `n_known` on to the object of `state`; return it and the evaluations.

    `rms` is the rms of random initial candidates; None: one start from the aberrations in `state`.
    """
    n_frames, spent = len(state.z), 0

    def count(cost: float, evaluations: int, variables: Variables) -> None:
        nonlocal spent
        spent += evaluations * candidates.n_each * (n_frames - n_known)

    new = slice(n_known, None)
    fresh, begin = objective.of_frames(new, free=Free.ABERRATIONS), state.of_frames(new)
    candidates = Candidates(begin, 1)
    if rms is not None:
        candidates = random_candidates(fresh, begin, schedule.n_candidates, rms, seed)
        kept = objective.model.aberrations.with_common_of(candidates.state.z, state.z[:1])
        candidates = Candidates(replace(candidates.state, z=kept), candidates.n_each)
    while candidates.n_each > 1:
        n_iterations = schedule.stage_iterations(candidates.n_each)
        candidates = play_stage(
            fresh,
            candidates,
            candidates.n_each // 2,
            lambda crowded, now, n=n_iterations: descend(crowded, now, n, minimizer, count),
            lambda crowded, now: share_noise_inflation(calibrate(crowded, now)),
        )
    fitted = descend(fresh, candidates.state, schedule.segment, minimizer, count)
    fitted, tried = change_fringes(fresh, fitted)
    spent += tried * (n_frames - n_known)
    return replace(state, z=torch.cat([state.z[:n_known], fitted.z])), spent // n_frames

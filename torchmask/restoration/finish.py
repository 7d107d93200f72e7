"""The end of a restoration: a finer model, and in noisy light through a mask its aberrations are integrated out.

A descent from far away takes few modes per sub-aperture. Close to the solution, more of them take away much of what the
model leaves unexplained. So once the search has ended, the aberrations gain modes, and the object a prior that suits it
(`ObjectPrior.choices`, `cross_validation`), and that descent goes on while it gains. Where noise leaves the aberrations
of a mask uncertain, they are integrated out after it, or in its place if frames are faint, under a prior at the scale
of the object; a faint search under a lighter prior descends under the given one before. Modes that are asked for beyond
those of a faint search are fitted to the object that is found without them. Between segments of the last descent the
phases of frames are retrieved that a mask's search has left in poor minima (`retrieval`). For a full pupil its segments
begin with the object settled for the aberrations at hand: a joint descent is too slow at the frequencies that a full
pupil hardly passes, in which most of the error in bright light would lie. The prior of a last descent is adapted to the
object that is known by then; where an integration follows, only the prior of that is, unless the frames show gentle
slopes. In faint frames none is.
Where the aberrations are known, the object alone descends once more, under the prior of its whole family
(`ObjectPrior.family`) that the frames choose.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from torchmask.record import Callback
from torchmask.restoration.calibration import calibrate, recalibrate
from torchmask.restoration.change import Change
from torchmask.restoration.checkpoint import Progress
from torchmask.restoration.cross_validation import choose_prior
from torchmask.restoration.descent import Variables, descend
from torchmask.restoration.escapes import centre_on_pixels, settle
from torchmask.restoration.marginal import integrate_aberrations
from torchmask.restoration.motion import Setting
from torchmask.restoration.objective import Free, MyopicObjective
from torchmask.restoration.priors import ObjectPrior
from torchmask.restoration.projected_lbfgs import Minimizer
from torchmask.restoration.retrieval import retrieve_lost_frames
from torchmask.restoration.schedule import Schedule
from torchmask.restoration.slopes import rate_of_descent, rate_of_slopes
from torchmask.restoration.spectrum import is_too_steep, rate_at_end, rate_in_noise, shows_gentle_slopes
from torchmask.restoration.state import State
from torchmask.restoration.traits import End, Traits

_REACH = 0.5  # width over which the structure of an object is taken [resolution elements]: 0.5 to 2.5 tried


@dataclass(frozen=True)
class Finisher:
    """Finishes restorations whose search has ended.

    `save` is called after every segment of the last descent, which goes on where an interrupted one was. `change` is
    that of the frames.
    """

    setting: Setting
    schedule: Schedule
    minimizer: Minimizer
    callback: Callback | None
    traits: Traits
    save: Callable[[Progress], None]
    change: Change

    def finish(self, objective: MyopicObjective, ended: Progress, end: End) -> MyopicObjective:
        """Update `ended`, and return the objective of its state."""
        prior = objective.prior
        if end.descends:
            objective = self._descend(objective, ended, end)
        elif ended.rate < 1 and prior.in_search(ended.rate) is not prior:
            self._descend_again(objective, ended)
        if end.integrates:
            rounds = self.schedule.fine_rounds if end.descends else self.schedule.rounds
            how = (self.schedule, self.minimizer, self.callback)
            known = {"seed": self.traits.seed, "follow_r0": self.traits.r0_is_open}
            gentle = shows_gentle_slopes(objective, ended.state, self.change, faint=self._faint)
            astray = gentle and is_too_steep(objective, ended.state)
            rate = rate_in_noise(objective, ended.state, self.change, gentle=gentle)
            prior = prior.suited_to(rate) if rate > 0 else prior
            # most edges found in gentle slopes are noise, and a faint search shows too few
            if end.descends and not gentle:
                prior = prior.adapted_to(ended.state.image, _reach(objective))
            objective = objective.with_changes(prior=prior)
            ended.state, spent = integrate_aberrations(objective, ended.state, rounds, *how, **known, astray=astray)
            ended.n_evaluations += spent
            ended.integrated = True
        return objective if end.descends else self._fit_further_modes(objective, ended)

    def _descend(self, objective: MyopicObjective, ended: Progress, end: End) -> MyopicObjective:
        """Run the last descent, with the same effects.

        For a full pupil its result is dropped if the mean chi-square rises: frames in poor minima count little in it,
        so that it may give up too many of them.
        """
        schedule, first = self.schedule, objective
        state = self.setting.in_finer_modes(ended.state) if ended.finer is None else ended.finer
        objective = self.setting.objective_at(objective, state)
        most, done = (number * schedule.segment for number in (schedule.last_segments, ended.last_segments))
        report, costs = ended.reporter("last descent", most, self.callback, done), []
        least_gain = schedule.last_gain_full if self.traits.many_minima else schedule.last_gain
        searched = not (self.traits.many_minima or self.traits.estimated or end is End.OBJECT)
        may_find = searched and objective.model.pupil.n_rasters == 1 and len(state.z) > 1
        chosen = self._choose_for_all(first, ended.state, end)

        def prior_of(state: State) -> ObjectPrior:
            if chosen is not None:
                return chosen
            choices = first.prior.choices(rate_of_slopes(state.image))
            return choose_prior(objective, state, choices, schedule.comparing)

        def objective_under(prior: ObjectPrior, state: State) -> MyopicObjective:
            # noisy frames show edges that are none; their integration may adapt its own prior to what is found here
            return objective.with_changes(prior=prior if end.integrates else self._adapted(prior, objective, state))

        def listen(cost: float, evaluations: int, variables: Variables) -> None:
            costs.append(cost)
            report(cost, evaluations, variables)

        while ended.last_segments < schedule.last_segments:
            costs.clear()
            state = self._recalibrate(objective, state)
            objective = objective_under(prior := prior_of(state), state)
            if self.traits.many_minima:
                state = settle(objective, state, schedule.last_settling)
            state = descend(objective, state, schedule.segment, self.minimizer, listen)
            gains = bool(costs) and costs[len(costs) // 2] - costs[-1] > least_gain * abs(costs[-1])
            is_last = ended.last_segments + 1 == schedule.last_segments
            if may_find and not (ended.seeks_no_more or is_last):
                # which moves the object, and an adapted prior would hold it where it was
                plain = objective.with_changes(prior=prior)
                descended, state = state, self._find_lost_frames(plain, state, ended)
                ended.seeks_no_more = state is descended
                gains = gains or not ended.seeks_no_more
            ended.finer, ended.last_segments = state, ended.last_segments + 1 if gains else schedule.last_segments
            self.save(ended)
        objective = objective_under(prior_of(state), state)
        # a descent moves flat parts of the object slowly
        state = settle(objective, state, schedule.last_settling)
        if end is End.FULL_PUPIL and _chi_square(objective, state) > _chi_square(first, ended.state) + self._chance():
            return first
        ended.state = state
        return objective

    def _adapted(self, prior: ObjectPrior, objective: MyopicObjective, state: State) -> ObjectPrior:
        """Return the prior that suits the structure of the object.

        The object that is asked is settled under `prior` itself: one under a prior that was adapted before has sharper
        edges already, and would ask for still sharper ones. Faint frames show too little structure: `prior` stays.
        """
        reach = _reach(objective)
        if self._faint:
            return prior
        if prior.adapted_to(state.image, reach) is prior:  # a prior without regard for structure needs no settling
            return prior
        settled = settle(objective.with_changes(prior=prior), state, self.schedule.last_settling)
        return prior.adapted_to(settled.image, reach)

    def _descend_again(self, objective: MyopicObjective, ended: Progress) -> None:
        """Descend under the given prior: a lighter one finds more, but bends aberrations to noise."""
        segments = self.schedule.faint_segments
        listen = ended.reporter("before integration", segments * self.schedule.segment, self.callback)
        for _ in range(segments):
            state = self._recalibrate(objective, ended.state)
            ended.state = descend(objective, state, self.schedule.segment, self.minimizer, listen)

    def _fit_further_modes(self, objective: MyopicObjective, ended: Progress) -> MyopicObjective:
        """Fit the modes that are asked for beyond those of a faint search to the object, and return their objective.

        Faint frames show them too little to change the object.
        """
        state = self.setting.in_all_modes(ended.state)
        if state is not ended.state:
            objective = self.setting.objective_at(objective, state)
            listen = ended.reporter("further modes", self.schedule.segment, self.callback)
            known_object = objective.with_changes(free=objective.free & ~Free.OBJECT)
            ended.state = descend(known_object, state, self.schedule.segment, self.minimizer, listen)
        return objective

    def _choose_for_all(self, objective: MyopicObjective, state: State, end: End) -> ObjectPrior | None:
        """Return the prior of all segments; None if it is chosen anew before each."""
        if end is End.OBJECT and len(state.z) > 1:
            state = self._recalibrate(objective, state)
            family = objective.prior.family(rate_of_descent(rate_of_slopes(state.image), full=self.traits.many_minima))
            return choose_prior(objective, state, family, self.schedule.last_settling)
        if end.integrates or end is End.OBJECT:
            # an integration finds the object's scale, and would find too heavy a one in what a heavier prior leaves
            return objective.prior.choices(0.0)[0]
        rate = rate_at_end(objective, state, self.change, faint=self._faint, full=self.traits.many_minima)
        heaviest, *lighter = objective.prior.choices(rate)
        # faint frames of a full pupil would choose too light a one; and the heavier a prior, the gentler are the slopes
        # that it leaves, which would ask for a heavier one
        return heaviest if self.traits.many_minima or not lighter else None

    @property
    def _faint(self) -> bool:
        return self.change.each < self.schedule.faint

    def _chance(self) -> float:
        """Return by how much the mean chi-square may rise by chance: a heavier prior leaves more of the noise."""
        return self.schedule.chance * math.sqrt(2 / (self.change.n_frames * self.change.n_pixels))

    def _recalibrate(self, objective: MyopicObjective, state: State) -> State:
        if not self.schedule.recalibrates:
            return state
        # known aberrations are in no poor minima, which a higher power is for
        power = self.traits.fit_power if Free.ABERRATIONS in objective.free else 1
        return recalibrate(objective, state, power, follow_r0=self.traits.r0_is_open)

    def _find_lost_frames(self, objective: MyopicObjective, state: State, ended: Progress) -> State:
        """Return the state with the phases of frames that a descent has lost, and an object that suits them; the state
        itself if none are found."""
        seed = self.traits.seed + ended.last_segments
        found, spent = retrieve_lost_frames(objective, state, seed, self.schedule, self.minimizer)
        ended.n_evaluations += spent
        if found is state:
            return state
        ended.retrieved = True
        # the sharper the object, the more it matters where it lies on the pixels
        found = centre_on_pixels(objective, self._recalibrate(objective, found), self.schedule)
        return settle(objective, found, self.schedule.last_settling)


def _reach(objective: MyopicObjective) -> float:
    """Return the width over which the structure of an object is taken [pixels]."""
    return _REACH / objective.model.cutoff


def _chi_square(objective: MyopicObjective, state: State) -> float:
    """Return the mean chi-square of the frames, at least 1 for each."""
    return float(calibrate(objective, state).calibration.noise_inflation.mean())

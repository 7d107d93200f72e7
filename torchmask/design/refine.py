"""The gradient stage of a search: quasi-Newton descents from given masks to feasible local optima."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np
import torch
from torch import Tensor

from torchmask.design.constraint_base import Constraint, Infeasible, project, require_constraints
from torchmask.design.constraints import InsideDisc, NoOverlap, check_mask
from torchmask.design.criterion_check import require_criterion, require_finite
from torchmask.design.descent import BatchedBFGS
from torchmask.design.merit import Criterion, Holes, Merit, device_of, for_processor
from torchmask.numbers import whole_number
from torchmask.optics.aperture import SparseAperture
from torchmask.plain import require_type
from torchmask.record import Callback, Record

PENALTY = 3e3  # weight of the squared shortfalls, in mask diameters, relative to log MSE
TOLERANCE = 1e-9  # largest shortfall of a result, in mask diameters
_FEWEST_DRAWN, _MOST_DRAWN, _DRAWN = 3, 30, 150_000  # masks of a stage in its history, and those of one hole


@dataclass(frozen=True)
class SearchResult:
    """Result of a search.

    aperture : the mask, feasible to 1e-9 of its diameter
    mse : value of the criterion at this mask
    relative_mse : relative value of the criterion at this mask
    evaluations : number of masks whose error was computed
    history : for each stage, an array (n, 2) of evaluations so far, in all stages, and relative MSE of the best mask.
        The MSE is the lowest so far of a few masks projected onto the constraints, on the grid of the criterion,
        so it never rises: the gradient stage begins where the search ended. `evaluations` does not include these.

    Examples
    --------
    >>> aperture = SparseAperture([[-0.4, 0.0], [0.4, 0.0]], 0.2, 1.0)
    >>> history = {"design/hybrid": torch.tensor([[10.0, 0.4], [20.0, 0.3]])}
    >>> found = SearchResult(aperture, mse=3e9, relative_mse=0.3, evaluations=20, history=history)
    >>> found
    SearchResult(aperture=SparseAperture((2, 2) disc, subaperture_diameter=0.2, mask_diameter=1), mse=3000000000.0, \
    relative_mse=0.3, evaluations=20)
    """

    aperture: SparseAperture
    mse: float
    relative_mse: float
    evaluations: int
    history: dict[str, Tensor] = field(repr=False)


class Monitor:
    """Keeps track of the best masks of a stage, and calls the callback about a hundred times.

    `before` is the number of evaluations of earlier stages, and `known` the best feasible mask that they found.
    """

    def __init__(
        self,
        stage: str,
        budget: int,
        holes: Holes,
        callback: Callback | None,
        before: int = 0,
        known: SparseAperture | None = None,
    ) -> None:
        self.stage, self.budget, self.holes, self.callback = stage, budget, holes, callback
        self.before, self.known = before, known
        self._rows: list[tuple[int, Tensor]] = []  # evaluations of this stage, centres; each mask once
        self._result: tuple[float, SparseAperture] | None = None  # with its relative MSE, once the stage has concluded
        self._merit = self._relative = float("inf")
        self._centers: Tensor | None = None
        self._due = 0.0

    def update(self, evaluations: int, merits: Tensor, relative_mse: Tensor, x: Tensor) -> None:
        """Update the best mask, the one with the lowest merit, with the results at x (P, F)."""
        index = int(merits.nan_to_num(torch.inf).argmin())
        if float(merits[index]) < self._merit:
            self._merit, self._relative = float(merits[index]), float(relative_mse[index])
            self._centers = self.holes.aperture(x[index]).centers
        if self._centers is not None and evaluations >= self._due:
            self._due = evaluations + self.budget / 100
            if not self._rows or self._rows[-1][1] is not self._centers:
                self._rows.append((evaluations, self._centers))
            self._tell(evaluations, self._relative, self._centers)

    def conclude(self, evaluations: int, relative_mse: float, aperture: SparseAperture) -> None:
        """Record a mask that the stage ends with."""
        self._result = relative_mse, aperture
        self._tell(evaluations, relative_mse, aperture.centers)

    def _tell(self, evaluations: int, relative_mse: float, centers: Tensor) -> None:
        if self.callback is not None:
            step, scalars = min(evaluations, self.budget), {"relative_mse": relative_mse}
            self.callback(Record(self.stage, step, self.budget, scalars, {"centers": centers.detach().clone()}))

    def tell_after(self, stage: str, step: int, n_steps: int, scalars: dict[str, float]) -> None:
        """Report work on what the stage found, which takes half a second for each mask of 60 holes."""
        if self.callback is not None:
            self.callback(Record(stage, step, n_steps, scalars, preparatory=True))

    def history(self, criterion: Criterion, used: int) -> tuple[dict[str, Tensor], SparseAperture | None]:
        """Return the entry of the stage in `SearchResult.history`, and the best mask of it that has been measured.

        `used` is its number of evaluations. A few of its masks are projected and measured, the last one among them.
        The callback learns of one that is better than what the stage ended with.
        """
        best = self.known
        least = float("inf") if best is None else _relative(criterion, best)
        curve = [(self.before, least)]
        if self._centers is not None and (not self._rows or self._rows[-1][1] is not self._centers):
            self._rows.append((used, self._centers))
        shown = _thinned(self._rows, self.holes.template.n_subapertures)
        stage, n_steps = f"{self.stage}/history", len(shown) + 1
        for step, (evaluations, centers) in enumerate(shown, 1):
            mask = self._projected(centers)
            if mask is not None and (found := _relative(criterion, mask)) < least:
                best, least = mask, found
            curve.append((self.before + evaluations, least))
            self.tell_after(stage, step, n_steps, {"relative_mse": least})
        if self._result is not None and self._result[0] <= least:
            least, best = self._result
        elif best is not None:
            self.conclude(used, least, best)
        curve.append((self.before + used, least))
        self.tell_after(stage, n_steps, n_steps, {"relative_mse": least})
        known = [row for row in curve if row[1] < float("inf")]
        return {self.stage: torch.tensor(known, dtype=torch.float64, device="cpu").reshape(-1, 2)}, best

    def _projected(self, centers: Tensor) -> SparseAperture | None:
        try:
            return project(self.holes.template.replace(centers=centers), self.holes.constraints)
        except Infeasible:
            return None


def _relative(criterion: Criterion, aperture: SparseAperture) -> float:
    with torch.no_grad():
        return float(criterion.relative(aperture))


def _thinned(rows: list[tuple[int, Tensor]], n_subapertures: int) -> list[tuple[int, Tensor]]:
    """Return a few of the masks, from the first to the last, for a history."""
    # a projection takes time in proportion to N^3, a second for 40 holes: so many that all take a few seconds
    count = min(len(rows), max(_FEWEST_DRAWN, min(_MOST_DRAWN, _DRAWN // n_subapertures**3)))
    return [rows[round(place)] for place in np.linspace(0, len(rows) - 1, count).tolist()]


@torch.inference_mode(False)  # it differentiates, whatever the caller does
def refine_mask(
    criterion: Criterion,
    aperture: SparseAperture,
    *,
    constraints: Sequence[Constraint] = (),
    budget: int = 1000,
    callback: Callback | None = None,
) -> SearchResult:
    """Refine a mask by descent to a feasible local optimum of `criterion` nearby.

    Parameters
    ----------
    criterion : AsymptoticMSE or similar
        Differentiable error of masks.
    aperture : SparseAperture
        One mask, which need not be feasible.
    constraints : sequence of Constraint
        Constraints in addition to those on the mask disc and on overlaps, which always hold.
    budget : int
        Largest number of evaluations of the criterion with its gradient.
    callback : callable, optional
        Receives a `Record` from time to time, whose centres may still violate a constraint slightly.

    Returns
    -------
    SearchResult
        Refined mask, feasible to 1e-9 of its diameter, on the device of the criterion; the given one if it is
        feasible and the descent has found none better.

    Raises
    ------
    ValueError
        If the aperture is a population or has no finite error, the budget is below 1, or no feasible mask is near it.
    TypeError
        If the aperture is not a `SparseAperture`, `constraints` not a sequence of them, or as `require_criterion`.

    Examples
    --------
    >>> from torchmask.design.criterion import AsymptoticMSE
    >>> from torchmask.spectra import NoisePSD, PowerLawPSD
    >>> from torchmask.grid import Grid
    >>> grid = Grid.nyquist(diameter=1.0, wavelength=550e-9, n_pixels=64)
    >>> criterion = AsymptoticMSE(grid, PowerLawPSD(1.5, 1e7), NoisePSD(1e7), n_frames=20)
    >>> golay = SparseAperture.from_catalog("golay6", mask_diameter=1.0, fill_factor=0.15)
    >>> better = refine_mask(criterion, golay, budget=60)
    >>> better.relative_mse < float(criterion.relative(golay))
    True
    """
    require_type("aperture", aperture, SparseAperture)
    if aperture.centers.ndim != 2:
        raise ValueError(f"centers has shape {tuple(aperture.centers.shape)}: refine_mask takes one mask, (N, 2)")
    require_constraints(constraints)
    budget = whole_number("budget", budget, note=", in evaluations")
    device, criterion = device_of(criterion), for_processor(criterion)
    still = aperture.still().to("cpu")
    holes = Holes(still, (InsideDisc(), NoOverlap(), *constraints))
    require_finite(require_criterion(criterion, still))
    start = holes.coordinates(still.centers)
    known = _if_feasible(still, constraints)
    monitor = Monitor("design/refine", budget, holes, callback, known=known)
    polished, evaluations = polish(criterion, holes, start[None], budget, monitor)
    history, best = monitor.history(criterion, evaluations)
    return conclude(criterion, best or polished, constraints, evaluations, history, device)


def _if_feasible(aperture: SparseAperture, constraints: Sequence[Constraint]) -> SparseAperture | None:
    try:
        check_mask(aperture, _tolerance(aperture), constraints)
    except ValueError:
        return None
    return aperture


def polish(criterion: Criterion, holes: Holes, x: Tensor, budget: int, monitor: Monitor) -> tuple[SparseAperture, int]:
    """Return the best feasible mask reached from x (P, F), and the number of evaluations used, at most `budget`.

    With the multipliers of the augmented Lagrangian, descents converge onto the constraints and not beyond them; a
    projection removes the remaining shortfall. The result is no worse than the feasible mask that the monitor
    knows; if there is none and no projection succeeds, `Infeasible` is raised.
    """
    known = monitor.known
    merit = Merit(criterion, holes, PENALTY)
    # for one update of the multipliers and the comparison at the end
    reserve = 2 * len(x) + (known is not None)
    descent = BatchedBFGS(x, first_step=0.003, tolerance=1e-8)
    multipliers: Tensor | float = 0.0
    while merit.evaluations + len(x) + reserve <= budget:
        points = descent.ask()
        found = merit(points, multipliers)
        monitor.update(merit.evaluations, found.merit, found.relative_mse, points)
        descent.tell(found.merit, found.gradient)
        if bool(descent.finished.all()):
            margins = merit(descent.points, multipliers).margins
            update = (multipliers - merit.weight * margins).clamp(min=0)
            if float((update - multipliers).abs().amax()) <= 1e-4 * float(update.max()):
                break
            multipliers = update
            descent.restart(slice(None), descent.points.clone())
    candidates, failure = _feasible(holes, descent.points, monitor)
    if known is not None:
        # where the budget ends before all are measured, the known one is
        candidates = [*candidates, known][-max(1, budget - merit.evaluations) :]
    if not candidates:
        raise failure
    with torch.no_grad():
        values = torch.stack([criterion.relative(candidate) for candidate in candidates])
    best = int(values.nan_to_num(torch.inf).argmin())
    monitor.conclude(merit.evaluations + len(candidates), float(values[best]), candidates[best])
    return candidates[best], merit.evaluations + len(candidates)


def _feasible(holes: Holes, x: Tensor, monitor: Monitor) -> tuple[list[SparseAperture], Infeasible]:
    """Return the masks at x (P, F) that could be projected onto the constraints, and the error of another one."""
    masks, failure = [], Infeasible("no mask to project")
    for step, point in enumerate(x, 1):
        tell = partial(monitor.tell_after, "design/project", step, len(x), {})
        try:
            masks.append(holes.feasible(point, tell))
        except Infeasible as error:
            failure = error
        tell()
    return masks, failure


def conclude(
    criterion: Criterion,
    aperture: SparseAperture,
    constraints: Sequence[Constraint],
    evaluations: int,
    history: dict[str, Tensor],
    device: torch.device,
) -> SearchResult:
    """Check the mask, measure it and return the result, with the mask on `device`."""
    check_mask(aperture, _tolerance(aperture), constraints)
    with torch.no_grad():
        mse, relative = float(criterion(aperture)), float(criterion.relative(aperture))
    return SearchResult(aperture.to(device), mse, relative, evaluations, history)


def _tolerance(aperture: SparseAperture) -> float:
    return TOLERANCE if aperture.centers.dtype == torch.float64 else 1e-6

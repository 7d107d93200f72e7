"""The gradient stage: quasi-Newton descents from given masks to feasible local optima."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from torchmask.design.constraint_base import Constraint, Infeasible, project, require_constraints
from torchmask.design.constraints import InsideDisc, NoOverlap, check_mask
from torchmask.design.descent import BatchedBFGS
from torchmask.design.merit import Criterion, Holes, Merit
from torchmask.optics.aperture import SparseAperture
from torchmask.record import Callback, Record

PENALTY = 3e3  # weight of the squared shortfalls against log MSE, lengths in mask diameters
TOLERANCE = 1e-9  # feasibility that results are held to, in mask diameters


@dataclass(frozen=True)
class SearchResult:
    """A mask, and how it was found.

    aperture : the mask, feasible to 1e-9 of its diameter
    mse, relative_mse : the criterion at this very mask
    evaluations : masks whose error was computed
    history : for each stage, of its best masks in turn, (evaluations so far in all stages, relative MSE) (n, 2): of the
        mask moved onto the rules, on the grid of the criterion, whatever grid and penalties it worked with. Masks
        for which no such move was found are left out. These measurements are not among the evaluations.

    Examples
    --------
    >>> aperture = SparseAperture([[-0.4, 0.0], [0.4, 0.0]], 0.2, 1.0)
    >>> history = {"design/hybrid": torch.tensor([[10.0, 0.4], [20.0, 0.3]])}
    >>> found = SearchResult(aperture, mse=3e9, relative_mse=0.3, evaluations=20, history=history)
    >>> found  # prints what matters
    SearchResult(aperture=SparseAperture((2, 2) disc, subaperture_diameter=0.2, mask_diameter=1), mse=3000000000.0, \
    relative_mse=0.3, evaluations=20)
    """

    aperture: SparseAperture
    mse: float
    relative_mse: float
    evaluations: int
    history: dict[str, Tensor] = field(repr=False)


class Monitor:
    """Keeps the best masks of a stage and tells the callback, about a hundred times.

    `before` counts the evaluations of earlier stages.
    """

    stage: str
    budget: int
    holes: Holes
    callback: Callback | None
    before: int

    def __init__(self, stage: str, budget: int, holes: Holes, callback: Callback | None, before: int = 0) -> None:
        self.stage, self.budget, self.holes, self.callback, self.before = stage, budget, holes, callback, before
        self.rows: list[tuple[int, Tensor]] = []  # evaluations, centres
        self._merit = self._relative = float("inf")
        self._centers: Tensor | None = None
        self._due = 0.0

    def update(self, evaluations: int, merits: Tensor, relative_mse: Tensor, x: Tensor) -> None:
        """Take note of what was found at x (P, F): the best merit so far is the best mask."""
        index = int(merits.nan_to_num(torch.inf).argmin())
        if float(merits[index]) < self._merit:
            self._merit, self._relative = float(merits[index]), float(relative_mse[index])
            self._centers = self.holes.aperture(x[index]).centers
        if self._centers is not None and evaluations >= self._due:
            self._due = evaluations + self.budget / 100
            self.rows.append((self.before + evaluations, self._centers))
            self._tell(evaluations, self._relative, self._centers)

    def conclude(self, evaluations: int, relative_mse: float, aperture: SparseAperture) -> None:
        """Tell what the stage returns."""
        self.rows.append((self.before + evaluations, aperture.centers))
        self._tell(evaluations, relative_mse, aperture.centers)

    def _tell(self, evaluations: int, relative_mse: float, centers: Tensor) -> None:
        if self.callback is not None:
            step, scalars = min(evaluations, self.budget), {"relative_mse": relative_mse}
            self.callback(Record(self.stage, step, self.budget, scalars, {"centers": centers.detach().clone()}))

    def history(self, criterion: Criterion) -> dict[str, Tensor]:
        """The stage's entry in `SearchResult.history`."""
        measured: dict[int, float] = {}  # by the identity of the centres: a mask is the best for many rows
        for _, centers in self.rows:
            if id(centers) not in measured:
                measured[id(centers)] = self._measure(criterion, centers)
        rows = [(evaluations, measured[id(centers)]) for evaluations, centers in self.rows]
        found = [row for row in rows if row[1] < float("inf")]
        return {self.stage: torch.tensor(found, dtype=torch.float64).reshape(-1, 2)}

    def _measure(self, criterion: Criterion, centers: Tensor) -> float:
        try:
            mask = project(self.holes.template.replace(centers=centers), self.holes.constraints)
        except Infeasible:
            return float("inf")
        with torch.no_grad():
            return float(criterion.relative(mask))


def refine_mask(
    criterion: Criterion,
    aperture: SparseAperture,
    *,
    constraints: Sequence[Constraint] = (),
    budget: int = 1000,
    callback: Callback | None = None,
) -> SearchResult:
    """Descend from a mask to the feasible local optimum of `criterion` beside it.

    Parameters
    ----------
    criterion : AsymptoticMSE, or any differentiable error of masks like it
    aperture : SparseAperture
        One mask; it need not be feasible.
    constraints : sequence of Constraint
        Rules beside the mask disc and the overlap, which always hold.
    budget : int
        Evaluations of the criterion, each with its gradient.
    callback : callable, optional
        Gets a `Record` now and then; its centres may still break a rule by a little.

    Returns
    -------
    SearchResult
        Feasible to 1e-9 of the mask's diameter.

    Raises
    ------
    ValueError
        For a population, a budget below 1, or if no feasible mask is found near the given one.

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
    if not isinstance(aperture, SparseAperture):
        raise TypeError(f"a SparseAperture is needed, not {type(aperture).__name__}")
    if aperture.centers.ndim != 2:
        raise ValueError(f"centers has shape {tuple(aperture.centers.shape)}: refine_mask takes one mask, (N, 2)")
    require_constraints(constraints)
    if budget != int(budget) or budget < 1:
        raise ValueError(f"budget is {budget}: it must be a whole number of evaluations, at least 1")
    still = aperture.still()
    holes = Holes(still, (InsideDisc(), NoOverlap(), *constraints))
    start = holes.coordinates(still.centers)
    monitor = Monitor("design/refine", budget, holes, callback)
    best, evaluations = polish(criterion, holes, start[None], budget, monitor)
    return conclude(criterion, best, constraints, evaluations, monitor.history(criterion))


def polish(
    criterion: Criterion,
    holes: Holes,
    x: Tensor,
    budget: int,
    monitor: Monitor,
    fallback: SparseAperture | None = None,
) -> tuple[SparseAperture, int]:
    """The best feasible mask reached from x (P, F) within `budget` evaluations of `criterion`, and their number.

    The multipliers of the augmented Lagrangian let the descents come to rest on the rules, not beyond them; the
    last step projects what is left. If no projection succeeds the mask is `fallback`; without one, raises `Infeasible`.
    """
    merit = Merit(criterion, holes, PENALTY)
    reserve = 2 * len(x)  # for the look at the multipliers that a round may take, and the comparison at the end
    descent = BatchedBFGS(x, first_step=0.003, tolerance=1e-8)
    multipliers: Tensor | float = 0.0
    while merit.evaluations + len(x) + reserve <= budget:
        points = descent.ask()
        found = merit(points, multipliers)
        monitor.update(merit.evaluations, found.merit, found.relative_mse, points)
        descent.tell(found.merit, found.gradient)
        if bool(descent.finished.all()):
            margins = merit(descent.points, multipliers).margins
            update = (torch.as_tensor(multipliers) - merit.weight * margins).clamp(min=0)
            if float((update - multipliers).abs().amax()) <= 1e-4 * float(update.max()):
                break
            multipliers = update
            descent.restart(slice(None), descent.points.clone())
    candidates, failure = _feasible(holes, descent.points)
    if not candidates:
        if fallback is None:
            raise failure
        candidates = [fallback]
    with torch.no_grad():
        values = torch.stack([criterion.relative(candidate) for candidate in candidates])
    best = int(values.argmin())
    monitor.conclude(merit.evaluations + len(candidates), float(values[best]), candidates[best])
    return candidates[best], merit.evaluations + len(candidates)


def _feasible(holes: Holes, x: Tensor) -> tuple[list[SparseAperture], Infeasible]:
    """Those of x (P, F) that could be projected onto the rules, and why one of the others could not."""
    masks, failure = [], Infeasible("no mask to project")
    for point in x:
        try:
            masks.append(holes.feasible(point))
        except Infeasible as error:
            failure = error
    return masks, failure


def conclude(
    criterion: Criterion,
    aperture: SparseAperture,
    constraints: Sequence[Constraint],
    evaluations: int,
    history: dict[str, Tensor],
) -> SearchResult:
    """Check the mask and measure it."""
    tolerance = TOLERANCE if aperture.centers.dtype == torch.float64 else 1e-6
    check_mask(aperture, tolerance, constraints)
    with torch.no_grad():
        mse, relative = float(criterion(aperture)), float(criterion.relative(aperture))
    return SearchResult(aperture, mse, relative, evaluations, history)

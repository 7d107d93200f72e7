"""The searches side by side at equal time: relative MSE of the mask found, over seeds.

    python benchmarks/search.py                                        # N = 6 and 11, 3 seeds, 10 s each: 3 minutes
    python benchmarks/search.py --n-subapertures 6 9 11 13 16 --seeds 5 --seconds 60
    python benchmarks/search.py --methods hybrid --telescope vlt --n-subapertures 11 --seeds 5 --seconds 60
    python benchmarks/search.py --smoke

Reference case: 1 m, Nyquist, 256 x 256 frequencies, knee 1/64, exponent 1.5, 1e7 photons, 20 frames.
Budgets of a search are evaluations, never seconds. So short runs of each method measure its rate, and the budget is
what that rate makes of the time given; the seconds that the runs then took stand in the table. "above floor" is the
median less what no mask of this diameter can change. Every mask is feasible to 1e-9 of its diameter. "vlt" is the same
for 8.2 m with a central obstruction and vanes, which holes keep clear of. "over best" is the median over the best mask
ever found, of which best_masks.json beside this file has the positions; --keep puts better ones there.
"""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch
import tyro

from torchmask.design.constraint_base import Constraint
from torchmask.design.constraints import check_mask
from torchmask.design.criterion import AsymptoticMSE
from torchmask.design.rules import MaskRules
from torchmask.design.search import SearchResult, search_mask
from torchmask.grid import Grid
from torchmask.instrument.parts import Telescope
from torchmask.io import read_json, write_json
from torchmask.optics.aperture import SparseAperture
from torchmask.spectra import NoisePSD, PowerLawPSD

BEST = Path(__file__).parent / "best_masks.json"
TELESCOPES = {
    "reference": Telescope(diameter=1.0),
    "vlt": Telescope(diameter=8.2, central_obstruction=1.12, vane_width=0.05, vane_angles=(45.0, 135.0, 225.0, 315.0)),
}

_TRIAL = 0.05  # of the time of a search, which measures what the rest of it buys
_GROWN = 2.5  # times the time that a quarter of the budget took: most of it then grows with the budget

METHODS: dict[str, dict[str, Any]] = {
    "cma": {"method": "cma", "refine": False},
    "cma + gradient": {"method": "cma", "refine": True},
    "hybrid": {"method": "hybrid"},
}


@dataclass(frozen=True)
class Config:
    n_subapertures: tuple[int, ...] = (6, 11)
    seeds: int = 3
    seconds: float = 10.0
    """Time of one search [s]."""
    fill_factor: float = 0.15
    methods: tuple[Literal["cma", "cma + gradient", "hybrid"], ...] = ("cma", "cma + gradient", "hybrid")
    clock: Literal["wall", "cpu"] = "wall"
    """On a machine that others use as well, count seconds of the processor, with one thread."""
    threads: int | None = None
    """Number of threads; None leaves it to torch."""
    telescope: Literal["reference", "vlt"] = "reference"
    """Telescope whose rules the holes obey."""
    keep: bool = False
    """Keep a mask that is better than all found before in best_masks.json."""
    smoke: bool = False


class Case:
    """What is searched: the criterion, the telescope with its rules, and the best masks found so far."""

    def __init__(self, name: str, fill_factor: float) -> None:
        self.name, self.fill_factor = name, fill_factor
        telescope = TELESCOPES[name]
        self.diameter: float = telescope.diameter
        self.rules: list[Constraint] = MaskRules(
            central_obstruction=telescope.central_obstruction, spiders=telescope.spiders
        ).constraints()
        self.criterion = AsymptoticMSE(
            Grid.nyquist(self.diameter, 550e-9, 256), PowerLawPSD(1.5, 1e7), NoisePSD(1e7), 20
        )

    def search(self, n: int, **options: Any) -> SearchResult:
        """One search, whose mask is feasible."""
        found = search_mask(self.criterion, n, self.diameter, self.fill_factor, constraints=self.rules, **options)
        check_mask(found.aperture, 1e-9, self.rules)
        return found

    def best(self, n: int) -> SparseAperture | None:
        """The best mask of `n` holes in best_masks.json."""
        own = next((row for row in read_json(BEST) if self._is(row, n)), None)
        if own is None:
            return None
        hole = self.diameter * math.sqrt(self.fill_factor / n)
        return SparseAperture(torch.tensor(own["centers"], dtype=torch.float64), hole, self.diameter)

    def keep(self, found: SearchResult) -> None:
        """Write a mask to best_masks.json if it is better than the one there."""
        n = found.aperture.n_subapertures
        best = self.best(n)
        if best is not None and float(self.criterion.relative(best)) <= found.relative_mse:
            return
        own = {"telescope": self.name, "n_subapertures": n, "fill_factor": self.fill_factor}
        own |= {"relative_mse": found.relative_mse, "centers": found.aperture.centers.tolist()}
        rows = [row for row in read_json(BEST) if not self._is(row, n)] + [own]
        rows.sort(key=lambda row: (row["telescope"], row["fill_factor"], row["n_subapertures"]))
        write_json(BEST, rows, replace=True)

    def _is(self, row: dict[str, Any], n: int) -> bool:
        return (row["telescope"], row["n_subapertures"], row["fill_factor"]) == (self.name, n, self.fill_factor)


def main(config: Config) -> None:
    """Run the table."""
    if config.smoke:
        config = replace(config, n_subapertures=config.n_subapertures[:1], seeds=1, seconds=1.0)
    if config.threads is not None:
        torch.set_num_threads(config.threads)
    clock = time.perf_counter if config.clock == "wall" else time.process_time
    case = Case(config.telescope, config.fill_factor)
    floor = case.criterion.relative_floor(case.diameter)
    print(
        f"{config.telescope}, {config.seconds:g} s ({config.clock}) a search, {config.seeds} seeds, "
        f"{torch.get_num_threads()} threads"
    )
    print(
        f"{'N':>3} {'method':<15} {'median':>8} {'best':>8} {'worst':>8} {'above floor':>11} {'over best':>9} "
        f"{'budget':>8} {'s':>6}"
    )
    for n in config.n_subapertures:
        for name in config.methods:
            options = METHODS[name]
            budget = affordable(case, n, config.seconds, clock, options)
            errors, seconds = [], []
            for seed in range(config.seeds):
                start = clock()
                found = case.search(n, seed=seed, budget=budget, **options)
                seconds.append(clock() - start)
                errors.append(found.relative_mse)
                if config.keep:
                    case.keep(found)
            median, best = statistics.median(errors), case.best(n)
            over = math.nan if best is None else 100 * (median / float(case.criterion.relative(best)) - 1)
            print(
                f"{n:>3} {name:<15} {median:>8.5f} {min(errors):>8.5f} {max(errors):>8.5f} {median - floor:>11.5f} "
                f"{over:>7.2f} % {budget:>8} {statistics.median(seconds):>6.1f}",
                flush=True,
            )


def affordable(case: Case, n: int, wanted: float, clock: Callable[[], float], options: dict[str, Any]) -> int:
    """Evaluations that so many seconds buy, from the times of two budgets, of which the larger takes long enough."""
    budget, before = 320, math.inf
    case.search(n, seed=0, budget=budget, **options)  # first use of everything
    while True:
        start = clock()
        case.search(n, seed=0, budget=budget, **options)
        spent = clock() - start
        if spent > max(_TRIAL * wanted, _GROWN * before):  # the gradient stage, in both times, does not grow
            rate = 0.75 * budget / (spent - before)
            return max(1, int(budget + rate * (wanted - spent)))
        budget, before = 4 * budget, spent


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))

"""The searches side by side at equal time: relative MSE of the mask found, over seeds.

    python benchmarks/search.py                                        # N = 6 and 11, 3 seeds, 10 s each: 3 minutes
    python benchmarks/search.py --n-subapertures 6 9 11 13 16 --seeds 5 --seconds 60
    python benchmarks/search.py --smoke

Reference case: 1 m, Nyquist, 256 x 256 frequencies, knee 1/64, exponent 1.5, 1e7 photons, 20 frames.
Budgets of a search are evaluations, never seconds. So short runs of each method measure its rate, and the budget is
what that rate makes of the time given; the seconds that the runs then took stand in the table. "above floor" is the
median less what no mask of this diameter can change. Every mask is feasible to 1e-9 of its diameter.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
import tyro

from torchmask.design.constraints import check_mask
from torchmask.design.criterion import AsymptoticMSE
from torchmask.design.search import search_mask
from torchmask.grid import Grid
from torchmask.spectra import NoisePSD, PowerLawPSD

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
    smoke: bool = False


def main(config: Config) -> None:
    """Run the table."""
    if config.smoke:
        config = replace(config, n_subapertures=config.n_subapertures[:1], seeds=1, seconds=1.0)
    if config.threads is not None:
        torch.set_num_threads(config.threads)
    clock = time.perf_counter if config.clock == "wall" else time.process_time
    criterion = AsymptoticMSE(Grid.nyquist(1.0, 550e-9, 256), PowerLawPSD(1.5, 1e7), NoisePSD(1e7), 20)
    floor = criterion.relative_floor(1.0)
    print(f"{config.seconds:g} s ({config.clock}) a search, {config.seeds} seeds, {torch.get_num_threads()} threads")
    print(f"{'N':>3} {'method':<15} {'median':>8} {'best':>8} {'worst':>8} {'above floor':>11} {'budget':>8} {'s':>6}")
    for n in config.n_subapertures:
        for name in config.methods:
            options = METHODS[name]
            budget = affordable(criterion, n, config, clock, options)
            errors, seconds = [], []
            for seed in range(config.seeds):
                start = clock()
                found = search_mask(criterion, n, 1.0, config.fill_factor, seed=seed, budget=budget, **options)
                seconds.append(clock() - start)
                check_mask(found.aperture, 1e-9)
                errors.append(found.relative_mse)
            median = statistics.median(errors)
            print(
                f"{n:>3} {name:<15} {median:>8.5f} {min(errors):>8.5f} {max(errors):>8.5f} {median - floor:>11.5f} "
                f"{budget:>8} {statistics.median(seconds):>6.1f}",
                flush=True,
            )


def affordable(
    criterion: AsymptoticMSE, n: int, config: Config, clock: Callable[[], float], options: dict[str, Any]
) -> int:
    """Evaluations that `config.seconds` buy, from the times of a small and a larger budget."""
    times = []
    small, large = 320, 1600
    search_mask(criterion, n, 1.0, config.fill_factor, seed=0, budget=small, **options)  # first use of everything
    for budget in (small, large):
        start = clock()
        search_mask(criterion, n, 1.0, config.fill_factor, seed=0, budget=budget, **options)
        times.append(clock() - start)
    rate = (large - small) / max(times[1] - times[0], 0.2 * times[1])
    return max(small, int(large + rate * (config.seconds - times[1])))


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))

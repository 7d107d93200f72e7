"""One search for each number of holes and seed: what the gallery and the curve over N have in common."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from torchmask.cli.options import SweepOptions
from torchmask.design.space import Design, DesignSpace


@dataclass(frozen=True, kw_only=True)
class SearchedMaskOptions(SweepOptions):
    """What the searches depend on."""

    n_subapertures: tuple[int, ...] = tuple(range(3, 21))
    """Numbers of holes, N."""
    fill_factor: float = 0.15
    """Collecting area N d^2 / D^2."""
    n_photons: float = 1e7
    """Per exposure."""
    n_frames: int = 20
    """Exposures, K."""
    exponent: float = 1.5
    """Of the power-law power spectrum of the object."""
    n_pixels: int = 256
    """Frequency grid, per side."""
    seed: tuple[int, ...] = (0, 1)
    """Of the searches: the best counts, and their scatter is given."""
    budget: int = 10_000
    """Evaluations of each search."""


def design_space(options: SearchedMaskOptions, **changes: Any) -> DesignSpace:
    """One search for each N and seed, without turbulence unless `changes` bring it."""
    settings: dict[str, Any] = {
        "n_subapertures": options.n_subapertures,
        "fill_factor": (options.fill_factor,),
        "n_photons": (options.n_photons,),
        "reference_fill_factor": options.fill_factor,
        "n_frames": (options.n_frames,),
        "diameter_over_r0": (),
        "seed": options.seed,
        "n_pixels": options.n_pixels,
        "exponent": options.exponent,
        "budget": options.budget,
    }
    return DesignSpace(**settings | changes)


def error(row: Design) -> float:
    """Relative MSE_a of a row. Raises ValueError if it has no mask."""
    if row.relative_mse is None:
        raise ValueError(f"no mask of {row.n_subapertures} holes: {row.infeasible}")
    return row.relative_mse

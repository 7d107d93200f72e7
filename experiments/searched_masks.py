"""Searches shared by several scripts: the gallery of masks and the curve over N, and the masks of planning scripts."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from torchmask.cli.options import SweepOptions
from torchmask.design.space import Design, DesignSpace
from torchmask.design.table import design_table
from torchmask.optics.aperture import SparseAperture
from torchmask.record import Callback


@dataclass(frozen=True, kw_only=True)
class SearchedMaskOptions(SweepOptions):
    """Options of the searches."""

    n_subapertures: tuple[int, ...] = tuple(range(3, 21))
    """Numbers of holes, N."""
    fill_factor: float = 0.15
    """Collecting area N d^2 / D^2."""
    n_photons: float = 1e7
    """Number of photons per exposure."""
    n_frames: int = 20
    """Number K of exposures."""
    exponent: float = 1.5
    """Exponent of the object's power-law power spectrum."""
    n_pixels: int = 256
    """Number of samples per side of the frequency grid."""
    seed: tuple[int, ...] = (0, 1)
    """Seeds of the searches, of which the best result is used; their scatter is given."""
    budget: int = 10_000
    """Number of evaluations of each search."""


def design_space(options: SearchedMaskOptions, **changes: Any) -> DesignSpace:
    """Return one search for each N and seed, without turbulence unless `changes` bring it."""
    settings: dict[str, Any] = {
        "n_subapertures": options.n_subapertures,
        "fill_factor": (options.fill_factor,),
        "n_photons": (options.n_photons,),
        "reference_fill_factor": options.fill_factor,
        "n_frames": (options.n_frames,),
        "diameter_over_r0": (),
        "seed": options.seed,
        "n_frequencies": options.n_pixels,
        "exponent": options.exponent,
        "budget": options.budget,
    }
    return DesignSpace(**settings | changes)


def error(row: Design) -> float:
    """Relative MSE_a of a row. Raises ValueError if it has no mask."""
    if row.relative_mse is None:
        raise ValueError(f"no mask of {row.n_subapertures} holes: {row.infeasible}")
    return row.relative_mse


def search_masks(
    holes: Iterable[int], fill_factor: float, options: SweepOptions, callback: Callback
) -> dict[int, SparseAperture]:
    """Return a mask for each number of holes, by a short search without turbulence."""
    space = DesignSpace(
        n_subapertures=tuple(sorted(set(holes))),
        fill_factor=(fill_factor,),
        reference_fill_factor=fill_factor,
        diameter_over_r0=(),
        n_frequencies=64 if options.smoke else 128,
        budget=100 if options.smoke else 2000,
    )
    table = design_table(space, options.sweep, **options.keywords(callback))
    return {row.n_subapertures: table.aperture(row) for row in table.rows}

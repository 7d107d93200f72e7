"""Rank the masks of the catalogue, and this library's own, by MSE_a: `torchmask rank` in the reference case.

    python experiments/rank_masks.py
    python experiments/rank_masks.py --fill-factor 0.05         # small holes, which more of the patterns can carry
    python experiments/rank_masks.py --smoke                    # everything, tiny, in seconds

Case: D = 1 m, 550 nm, Nyquist, p = 1.5, 1e7 photons at the common collecting area, K = 20. The table, as CSV, markdown
and JSON, its picture and our own masks go to a new folder.
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Sequence
from dataclasses import dataclass

from torchmask.cli import rank
from torchmask.cli.program import run_script


@dataclass(frozen=True, kw_only=True)
class Options(rank.Options):
    """The ranking of the figure."""

    search: tuple[int, ...] = (3, 6, 7, 9, 10, 11, 12)
    """Numbers of holes for which this library searches a mask."""
    smoke: bool = False
    """Run with everything tiny, to test that it works."""


def run(options: Options) -> None:
    """Rank in a new folder."""
    if options.smoke:
        options = dataclasses.replace(options, search=(3, 6), budget=200, n_frequencies=64)
    rank.run(options)


def main(argv: Sequence[str] | None = None) -> int:
    """Return the exit status."""
    return run_script("rank_masks", run, Options, __doc__, argv)


if __name__ == "__main__":
    sys.exit(main())

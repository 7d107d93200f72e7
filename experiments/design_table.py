"""Choose the number of holes, their size and the flux: a table of searched masks and what turbulence leaves of them.

    python experiments/design_table.py runs/table --space.n-subapertures 6 9 11 13 --space.fill-factor 0.05 0.1 0.15
    python experiments/design_table.py runs/table --space.diameter-over-r0 3 7 12 --space.n-photons 1e5 1e6 1e7
    python experiments/design_table.py runs/table --backend ray     # on the Ray cluster that RAY_ADDRESS names
    python experiments/design_table.py runs/table --smoke           # everything, tiny, in seconds

Every combination is a row. The folder holds the tasks, one file each, and the table as CSV and JSON (with the holes'
positions). The same folder again goes on where a run was stopped, and wider axes only compute what is new.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import tyro

from torchmask.cli.options import DebugOptions, WorkerOptions
from torchmask.cli.program import run_script
from torchmask.design.space import DesignSpace
from torchmask.design.table import design_table
from torchmask.progress import Progress


@dataclass(frozen=True, kw_only=True)
class Options(WorkerOptions, DebugOptions):
    """What the table depends on."""

    folder: tyro.conf.Positional[Path]
    """Folder of the tasks and the table."""
    space: DesignSpace = field(default_factory=DesignSpace)
    """Values that are varied and values that are fixed, see `torchmask.design.space.DesignSpace`."""
    smoke: bool = False
    """Run everything at a tiny size, as a test."""


def run(options: Options) -> None:
    """Fill the table, or go on with it."""
    space = options.space
    if options.smoke:
        space = replace(space, n_subapertures=(3, 5), n_pixels=32, n_frames=(2,), n_draws=2, budget=64)
    try:
        with Progress() as progress:
            table = design_table(space, options.folder, **options.keywords(progress))
    except KeyboardInterrupt:
        print(f"\ncall again with {options.folder} to go on", file=sys.stderr)
        raise
    print(table, f"\nwritten to {options.folder}", sep="\n")


def main(argv: Sequence[str] | None = None) -> int:
    """The exit status."""
    return run_script("design_table", run, Options, __doc__, argv)


if __name__ == "__main__":
    sys.exit(main())

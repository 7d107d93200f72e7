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
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

import tyro

from torchmask.design.space import DesignSpace
from torchmask.design.table import design_table
from torchmask.progress import Progress


@dataclass(frozen=True)
class Config:
    """Everything a run depends on."""

    folder: Annotated[Path, tyro.conf.Positional]
    """Of the tasks and the table."""
    space: DesignSpace = field(default_factory=DesignSpace)
    """What is varied and what is held fixed: see `torchmask.design.space.DesignSpace`."""
    workers: int | None = None
    """Tasks at a time; None: one per core."""
    backend: Literal["loky", "ray"] = "loky"
    """This machine or a Ray cluster."""
    smoke: bool = False
    """Everything tiny, to see that it runs."""


def main(config: Config) -> int:
    """Fill the table, or go on with it."""
    space = config.space
    if config.smoke:
        space = replace(space, n_subapertures=(3, 5), n_pixels=32, n_frames=(2,), n_draws=2, budget=64)
    try:
        with Progress() as progress:
            options = {"backend": config.backend, "n_workers": config.workers}
            table = design_table(space, config.folder, callback=progress, **options)
    except KeyboardInterrupt:
        print(f"\ninterrupted: call again with {config.folder} to go on", file=sys.stderr)
        return 130
    except ValueError as problem:
        print(f"design_table: {problem}", file=sys.stderr)
        return 2
    print(table, f"\nwritten to {config.folder}", sep="\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Config, description=__doc__)))

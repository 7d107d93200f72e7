"""This library beside its peers on the same stacks: score, structural similarity and seconds.

    python benchmarks/peers.py ../shared/stacks/*.npz      # stacks with their truth, as Observation.save writes them
    python benchmarks/peers.py                             # two stacks of the packaged satellite, simulated here
    python benchmarks/peers.py --smoke                     # everything, tiny, in seconds

Needs the extra `torchmask[bench]`. This library runs once, with its defaults, and knows the frames and the instrument.
Every peer may choose its settings, and whether to clip at 0, with the truth at hand, and is told r0: the table gives
the best score it reaches, and the seconds of that setting. Peers: the plain joint descent by SciPy's L-BFGS-B on this
library's own cost, from zero aberrations; torchmfbd, which models a full pupil and nothing else, has as many modes as
this library among its settings, and starts several times, of which it keeps the start of its own lowest loss;
shift-and-add; and scikit-image's Richardson-Lucy and unsupervised Wiener on shift-and-add, with the PSF that
shift-and-add has on average in such turbulence. The multi-frame Wiener estimate knows the true PSFs of all frames.
The table, as markdown and JSON, goes to a new folder.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import torch
import tyro
from peer_methods import LIMIT, METHODS, OURS, Candidate, Effort
from torch import Tensor

import torchmask
from torchmask.atmosphere.phase import TurbulencePhase
from torchmask.cli.options import ExperimentOptions
from torchmask.cli.program import run_script
from torchmask.cli.run import new_run
from torchmask.grid import Grid
from torchmask.metrics import relative_error, ssim
from torchmask.observation import Observation
from torchmask.optics.aperture import FullAperture, SparseAperture
from torchmask.optics.detector import Detector
from torchmask.simulation.exposures import simulate_observation
from torchmask.simulation.scene import SceneOptions, make_scene

WANTED_LEAD = 1.5  # over the best peer that does not know the PSFs


@dataclass(frozen=True, kw_only=True)
class Options(ExperimentOptions):
    """What is compared."""

    stacks: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Stacks of exposures with their truth (.npz); none: a mask and a full pupil, simulated here."""
    cutoff: float = 0.5
    """Cut-off of the score, D pixel_scale / wavelength [cycles/pixel]."""
    mfbd_iterations: int = 500
    """Number of iterations of torchmfbd."""
    mfbd_starts: int = 3
    """Number of random starts of torchmfbd, of which that of the lowest loss is kept."""


def best(name: str, candidates: Iterator[Candidate], truth: Tensor | None, cutoff: float) -> dict[str, Any] | None:
    """The candidate of the best score, clipped at 0 if that helps; None without candidates."""
    row: dict[str, Any] | None = None
    for candidate in candidates:
        for image in (candidate.image, candidate.image.clamp(min=0)):
            value = relative_error(image, truth, cutoff)
            if row is None or value < row["score"]:
                row = {"method": name, "score": value, "ssim": ssim(image, truth, cutoff)}
                row |= {"seconds": candidate.seconds, "settings": candidate.settings}
    return row


def compare(name: str, observation: Observation, cutoff: float, effort: Effort) -> list[dict[str, Any]]:
    """A row for each method that applies to a stack."""
    rows = []
    for method, function in METHODS.items():
        print(f"{name}: {method} ...", end=" ", file=sys.stderr, flush=True)
        row = best(method, function(observation, effort), observation.object, cutoff)
        print("does not apply" if row is None else f"{row['score']:.4f}", file=sys.stderr, flush=True)
        if row is not None:
            rows.append({"stack": name} | row)
    return rows


def lead(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return how far this library is ahead on one stack: the score of the best peer without the PSFs over its own."""
    ours = next(row for row in rows if row["method"] == OURS)
    peer = min((row for row in rows if row["method"] not in (OURS, LIMIT)), key=lambda row: row["score"])
    limit = next(row for row in rows if row["method"] == LIMIT)
    return {
        "stack": ours["stack"],
        "best_peer": peer["method"],
        "lead": peer["score"] / ours["score"],
        "over_limit": ours["score"] / limit["score"],
    }


def load(path: Path) -> Observation:
    """A stack with all that a comparison needs. Raises ValueError if its truth is missing."""
    observation = Observation.load(path)
    missing = [name for name in ("object", "psfs", "r0") if getattr(observation, name) is None]
    if missing:
        raise ValueError(f"{path} lacks {', '.join(missing)}: methods cannot be compared without the truth")
    return observation


def simulated(smoke: bool) -> dict[str, Observation]:
    """The packaged satellite through nine holes and through a full pupil that reaches as far, D/r0 = 7."""
    n_pixels, n_frames, photons = (48, 3, 1e6) if smoke else (128, 20, 1e7)
    mask, grid = SparseAperture.from_catalog("golay9", 1.0, 0.15), Grid.nyquist(1.0, 550e-9, n_pixels)
    stacks = {}
    for name, aperture in (("satellite_mask", mask), ("satellite_full", FullAperture(mask.extent))):
        scene = make_scene(grid.shape, photons * aperture.area / mask.area, SceneOptions(size=0.5))
        generator = torch.Generator().manual_seed(0)
        turbulence, detector = TurbulencePhase(1 / 7, 20.0), Detector(1.5)
        stacks[name] = simulate_observation(scene, aperture, grid, turbulence, detector, n_frames, generator)
    return stacks


def versions() -> dict[str, str]:
    """Return a row for everything that was compared. Raises ValueError if the extra is not installed."""
    try:
        others = ("torchmfbd", "scikit-image", "torch", "numpy", "scipy")
        return {"torchmask": torchmask.__version__} | {name: version(name) for name in others}
    except PackageNotFoundError as error:
        raise ValueError(f"{error.name} is not installed: pip install 'torchmask[bench]'") from error


def markdown(rows: Sequence[Mapping[str, Any]], leads: Sequence[Mapping[str, Any]], used: Mapping[str, str]) -> str:
    """The table, and what it says."""
    lines = [
        "| stack | method | score | SSIM | seconds | settings, chosen with the truth except for torchmask's |",
        "|---|---|---|---|---|---|",
    ]
    for row in rows:
        lines.append(
            f"| {row['stack']} | {row['method']} | {row['score']:.4f} | {row['ssim']:.3f} | {row['seconds']:.1f} | "
            f"{row['settings']} |"
        )
    lines.append("")
    for item in leads:
        reached = "reached" if item["lead"] >= WANTED_LEAD else "NOT reached"
        lines.append(
            f"- {item['stack']}: {item['lead']:.2f} times better than the best peer without the PSFs "
            f"({item['best_peer']}); {WANTED_LEAD:g} is {reached}. {item['over_limit']:.2f} times the score of the "
            "Wiener estimate with the true PSFs."
        )
    listed = ", ".join(f"{name} {number}" for name, number in used.items())
    lines += ["", f"{listed}; {torch.get_num_threads()} threads of {os.cpu_count()} cores."]
    return "\n".join(lines) + "\n"


def run(options: Options) -> None:
    """Compare in a new folder."""
    used = versions()
    stacks = {path.stem: load(path) for path in options.stacks} or simulated(options.smoke)
    mfbd = (5, 2) if options.smoke else (options.mfbd_iterations, options.mfbd_starts)
    effort = Effort(10 if options.smoke else None, *mfbd)
    with new_run("peers", options) as output:
        rows = {name: compare(name, observation, options.cutoff, effort) for name, observation in stacks.items()}
        leads = [lead(own) for own in rows.values()]
        flat = [row for own in rows.values() for row in own]
        text = markdown(flat, leads, used)
        numbers = {"versions": used, "threads": torch.get_num_threads(), "rows": flat, "leads": leads}
        output.report("peers", numbers, text)
        output.summary.append(text)


def main(argv: Sequence[str] | None = None) -> int:
    """The exit status."""
    return run_script("peers", run, Options, __doc__, argv)


if __name__ == "__main__":
    sys.exit(main())

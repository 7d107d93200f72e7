"""How fast the Wiener MSE of K short exposures falls to MSE_a, its limit for many, by Monte Carlo.

    python experiments/asymptotic_limit.py                       # Golay-6 and a mask of 11 holes, K = 1 to 100
    python experiments/asymptotic_limit.py --d-over-r0 3         # other turbulence
    python experiments/asymptotic_limit.py --smoke               # everything, tiny, in seconds

Two models of the exposures: an independent uniform piston on each hole, as MSE_a assumes, with OTFs in closed form; and
full von Karman screens, with all that they do inside the holes and all that neighbouring holes share. In the piston
model the mean MSE is never below MSE_a (Jensen). The picture and the numbers go to a new folder; the
draws are kept in --sweep, one file for each batch, so that a run that was stopped goes on.
"""

from __future__ import annotations

import dataclasses
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse
import torch
from asymptotic_limit_report import MODELS, figure, findings, markdown

from torchmask.atmosphere.phase import TurbulencePhase
from torchmask.cli.options import SweepOptions
from torchmask.cli.program import run_script
from torchmask.cli.run import new_run
from torchmask.design.criterion import AsymptoticMSE, wiener_mse
from torchmask.design.space import DesignSpace
from torchmask.design.sweep import run_tasks
from torchmask.design.table import design_table
from torchmask.grid import Grid
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.otf import OTF
from torchmask.optics.overlaps import check_overlaps
from torchmask.record import Callback
from torchmask.spectra import NoisePSD, PowerLawPSD

DIAMETER = 1.0  # of the masks [m]: nothing here depends on it but r0 and the outer scale
WAVELENGTH = 550e-9
_GROUPS = 10  # sets of K exposures taken from one stack, at most
_FRAMES = 20  # OTFs held in memory


@dataclass(frozen=True, kw_only=True)
class Options(SweepOptions):
    """Options of the draws."""

    frames: tuple[int, ...] = (1, 2, 3, 5, 7, 10, 15, 20, 30, 50, 70, 100)
    """Numbers of exposures K."""
    d_over_r0: float = 7.0
    """Strength of the turbulence, D / r0."""
    outer_scale: float = 20.0
    """Outer scale of the turbulence, in units of D."""
    fill_factor: float = 0.15
    """Collecting area N d^2 / D^2."""
    n_photons: float = 1e7
    """Number of photons per exposure."""
    exponent: float = 1.5
    """Exponent of the object's power-law power spectrum."""
    n_pixels: int = 256
    """Number of pixels per side of the image."""
    oversampling: int = 2
    """Oversampling of the pupil under von Karman screens; its error is given with the results."""
    n_subapertures: int = 11
    """Number of holes of the searched mask, which is compared with Golay-6."""
    budget: int = 20_000
    """Number of evaluations of that search."""
    piston_stacks: int = 200
    """Number of stacks of max(K) exposures drawn with random pistons."""
    screen_stacks: int = 20
    """Number of stacks drawn with von Karman screens."""
    seed: int = 0
    """Seed of the search and the draws."""


class PistonOTFs:
    """|OTF|^2 of a mask for any pistons, in closed form: the overlaps of all pairs of holes, computed once."""

    def __init__(self, mask: SparseAperture, grid: Grid) -> None:
        n = mask.n_subapertures
        nu_y, nu_x = grid.frequencies(torch.float64)
        self.first, self.second = torch.nonzero(~torch.eye(n, dtype=torch.bool), as_tuple=True)
        columns = []
        for baseline in [torch.zeros(2), *((mask.centers[self.first] - mask.centers[self.second]) / grid.period)]:
            dx, dy = nu_x - baseline[0], nu_y - baseline[1]
            shift = torch.stack(torch.broadcast_tensors(dx - dx.round(), dy - dy.round()), dim=-1)
            overlap = mask.shape.otf(shift * grid.period, mask.subaperture_diameter)
            columns.append(scipy.sparse.csc_array(overlap.reshape(-1, 1).numpy()))
        self.alone = columns[0].toarray()
        self.pairs = scipy.sparse.hstack(columns[1:]).tocsr() / n
        self.shape = grid.shape

    def power(self, pistons: torch.Tensor) -> torch.Tensor:
        """|h|^2 (F, H, W) for pistons (F, N) [rad]."""
        delta = (pistons[:, self.second] - pistons[:, self.first]).T.numpy()
        power = (self.alone + self.pairs @ np.cos(delta)) ** 2 + (self.pairs @ np.sin(delta)) ** 2
        return torch.from_numpy(power.T).unflatten(1, self.shape)


def uniform_pistons(n_frames: int, n: int, generator: torch.Generator) -> torch.Tensor:
    """Draw uniform pistons (F, N) [rad]."""
    return 2 * math.pi * torch.rand(n_frames, n, dtype=torch.float64, generator=generator)


def criterion(task: dict[str, Any], n_frames: int) -> AsymptoticMSE:
    """MSE_a for K exposures."""
    photons = task["n_photons"]
    grid = Grid.nyquist(DIAMETER, WAVELENGTH, task["n_pixels"])
    return AsymptoticMSE(grid, PowerLawPSD(task["exponent"], photons), NoisePSD(photons), n_frames)


def draw(task: dict[str, Any]) -> dict[str, Any]:
    """Some stacks of exposures: for each K the relative Wiener MSE of independent sets of K of them."""
    mask = SparseAperture(task["centers"], task["subaperture_diameter"], DIAMETER)
    limit = criterion(task, 1)
    generator = torch.Generator().manual_seed(task["seed"])
    n_frames = max(task["frames"])
    if task["model"] == "pistons":
        closed = PistonOTFs(mask, limit.grid)
    else:
        otf = OTF(mask, limit.grid, task["oversampling"])
        samples = otf.samples()
        turbulence = TurbulencePhase(DIAMETER / task["d_over_r0"], task["outer_scale"])
    values: dict[int, list[float]] = {k: [] for k in task["frames"]}
    for _ in range(task["n_stacks"]):
        if task["model"] == "pistons":
            power = closed.power(uniform_pistons(n_frames, mask.n_subapertures, generator))
        else:
            chunks = [min(_FRAMES, n_frames - first) for first in range(0, n_frames, _FRAMES)]
            power = torch.cat([otf(turbulence(samples, chunk, generator)).abs() ** 2 for chunk in chunks])
        for k, found in values.items():
            sets = min(n_frames // k, _GROUPS)
            summed = power[: sets * k].unflatten(0, (sets, k)).sum(1)
            # The error depends on the sum of |h_k|^2 alone: one OTF with that square stands for K.
            errors = wiener_mse(summed.sqrt()[:, None], limit.object_psd, limit.noise_psd)
            found += (errors / limit.object_psd.mean()).tolist()
    return {"mean": float(np.mean(values[n_frames])), "values": values}


def sampling_error(task: dict[str, Any]) -> float:
    """Return the relative change that sampling the pupil makes to the Wiener MSE of 20 exposures of equal pistons."""
    mask = SparseAperture(task["centers"], task["subaperture_diameter"], DIAMETER)
    limit = criterion(task, 1)
    pistons = uniform_pistons(_FRAMES, mask.n_subapertures, torch.Generator().manual_seed(task["seed"]))
    exact = PistonOTFs(mask, limit.grid).power(pistons).sqrt()
    otf = OTF(mask, limit.grid, task["oversampling"])
    sampled = otf(pistons[..., None].expand(-1, -1, otf.samples().weights.shape[-1]))
    psds = (limit.object_psd, limit.noise_psd)
    return float(wiener_mse(sampled, *psds) / wiener_mse(exact, *psds)) - 1


def masks(options: Options, callback: Callback) -> dict[str, SparseAperture]:
    """Golay-6 and a mask of this library's own."""
    space = DesignSpace(
        n_subapertures=(options.n_subapertures,),
        fill_factor=(options.fill_factor,),
        n_photons=(options.n_photons,),
        reference_fill_factor=options.fill_factor,
        diameter_over_r0=(),
        seed=(options.seed,),
        n_frequencies=options.n_pixels,
        exponent=options.exponent,
        budget=options.budget,
    )
    table = design_table(space, options.sweep, **options.keywords(callback))
    own = table.aperture(table.rows[0])
    return {
        "Golay-6": SparseAperture.from_catalog("golay6", DIAMETER, options.fill_factor),
        f"N = {options.n_subapertures}": own,
    }


def tasks(options: Options, mask: SparseAperture) -> list[dict[str, Any]]:
    """Return the draws of both models for one mask, in batches of about equal time."""
    shared = ("frames", "n_photons", "exponent", "n_pixels", "oversampling", "d_over_r0")
    common = {name: getattr(options, name) for name in shared} | {
        "centers": mask.centers.tolist(),
        "subaperture_diameter": mask.subaperture_diameter,
        "outer_scale": options.outer_scale * DIAMETER,
    }
    batches = []
    for model, total, size in (("pistons", options.piston_stacks, 10), ("von_karman", options.screen_stacks, 2)):
        for first in range(0, total, size):
            seed = int(np.random.SeedSequence([options.seed, first]).generate_state(1)[0])
            batches.append(common | {"model": model, "n_stacks": min(size, total - first), "seed": seed})
    return batches


def compare(options: Options, callback: Callback) -> list[dict[str, Any]]:
    """Return a row for each mask, model and K: MSE_a, the mean of the draws and its standard error, both relative."""
    keywords = options.keywords(callback)
    batches = {name: tasks(options, mask) for name, mask in masks(options, callback).items()}
    flat = [(name, task) for name, own in batches.items() for task in own]
    results = run_tasks(draw, [task for _, task in flat], options.sweep / "tasks", stage="asymptotic_limit", **keywords)
    rows = []
    for name, own in batches.items():
        mask = SparseAperture(own[0]["centers"], own[0]["subaperture_diameter"], DIAMETER)
        bias = sampling_error(own[0])
        for model in MODELS:
            drawn = [r["values"] for (n, t), r in zip(flat, results, strict=True) if (n, t["model"]) == (name, model)]
            for k in options.frames:
                values = np.concatenate([batch[str(k)] for batch in drawn])
                limit = float(criterion(own[0], k).relative(mask))
                error = values.std(ddof=1) / math.sqrt(len(values))
                row = {"mask": name, "model": model, "n_frames": k, "mse_a": limit, "wiener_mse": values.mean()}
                row |= {"standard_error": error, "ratio": values.mean() / limit, "ratio_error": error / limit}
                row |= {"n_draws": len(values), "sampling_error": 0.0 if model == "pistons" else bias}
                rows.append(row)
    return rows


def check(options: Options) -> None:
    """Raise ValueError for options that the draws would reject, before the long search begins."""
    if not options.frames or min(options.frames) < 1:
        raise ValueError(f"frames is {options.frames}: it must hold at least one number, and each at least 1")
    if not options.d_over_r0 > 0:
        raise ValueError(f"d_over_r0 is {options.d_over_r0}: it must be positive")
    for name in ("piston_stacks", "screen_stacks"):
        if getattr(options, name) < 2:
            raise ValueError(f"{name} is {getattr(options, name)}: a standard error needs at least 2")
    TurbulencePhase(DIAMETER / options.d_over_r0, options.outer_scale * DIAMETER)
    golay = SparseAperture.from_catalog("golay6", DIAMETER, options.fill_factor)
    check_overlaps(golay)
    OTF(golay, Grid.nyquist(DIAMETER, WAVELENGTH, options.n_pixels), options.oversampling)


def setting(options: Options) -> str:
    """Return a sentence on what all rows share."""
    return (
        f"p = {options.exponent:g}, {options.n_photons:g} photons per exposure, N d^2 / D^2 = {options.fill_factor:g}, "
        f"{options.n_pixels} frequencies a side, outer scale {options.outer_scale:g} D."
    )


def run(options: Options) -> None:
    """Search, draw, compare, in a new folder."""
    if options.smoke:
        small = {"frames": (1, 2, 4), "n_pixels": 64, "n_subapertures": 4, "budget": 200}
        options = dataclasses.replace(options, **small, piston_stacks=4, screen_stacks=4)
    check(options)
    with new_run("asymptotic_limit", options, options.seed) as output:
        rows = compare(options, output.callback)
        found = findings(options.d_over_r0, rows)
        text = markdown(setting(options), found, rows)
        output.report("asymptotic_limit", {"rows": rows}, text, figure(options.d_over_r0, rows))
        output.summary.extend(found)


def main(argv: Sequence[str] | None = None) -> int:
    """Return the exit status."""
    return run_script("asymptotic_limit", run, Options, __doc__, argv)


if __name__ == "__main__":
    sys.exit(main())

"""Code shared by `exposure` and `band`: the trade of more light against less contrast, restored and predicted."""

from __future__ import annotations

import itertools
import math
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from mask_vs_full import instrument
from mask_vs_full_options import DIAMETER, WAVELENGTH
from mask_vs_full_report import INSTRUMENTS
from observing import SIZE, WIND, ObservingOptions, curves, optimum, scores, shared

from torchmask.atmosphere.seeing import Seeing
from torchmask.design.sweep import run_tasks
from torchmask.design.turbulent import TurbulentMSE
from torchmask.grid import Grid
from torchmask.optics.band import Band
from torchmask.planning.smearing import phase_spread, smearing_map
from torchmask.planning.success import success_map
from torchmask.record import Callback
from torchmask.spectra import NoisePSD, PowerLawPSD
from torchmask.viz.style import COLORS, FAINT, new_figure, styled

if TYPE_CHECKING:
    from matplotlib.figure import Figure


_NOTHING = 1e-12  # of the object's power


@dataclass(frozen=True)
class Trade:
    """What is varied, and what it leaves of the contrast.

    key : of a row and a cell
    name, label : in a sentence and along the axis
    kept : V^2 that is left, for an amount of it
    where : whose V^2 that is
    """

    key: str
    name: str
    label: str
    kept: Callable[[float], float]
    where: str

    def summarise(
        self, rows: Sequence[Mapping[str, Any]], predicted: Mapping[tuple[str, float], Mapping[str, float]]
    ) -> list[dict[str, Any]]:
        """Return one cell for each instrument and amount, with the scores that `predictions` give."""
        keys = dict.fromkeys((row["instrument"], row[self.key]) for row in rows)
        return [
            {"instrument": which, self.key: amount, "kept": self.kept(amount), **predicted[which, amount]}
            | scores([row for row in rows if (row["instrument"], row[self.key]) == (which, amount)])
            for which, amount in keys
        ]

    def findings(self, cells: Sequence[Mapping[str, Any]]) -> list[str]:
        """Return the optimum of each instrument."""
        lines = []
        for which, name in INSTRUMENTS.items():
            own = [cell for cell in cells if cell["instrument"] == which]
            if own:
                best = min(own, key=lambda cell: cell["score"])
                lines.append(
                    f"The {name} is best at {self.name} = {optimum(own, self.key)}, with a score of "
                    f"{best['score']:.3f}; {best['kept']:.3f} of V^2 is kept {self.where} there. "
                    f"Between the amounts the best is {between(own, self.key, 'score'):.2g}, and that predicted for "
                    f"known PSFs {between(own, self.key, 'predicted'):.2g}, or "
                    f"{between(own, self.key, 'predicted_blind'):.2g} with what restorations lose."
                )
        return lines

    @property
    def columns(self) -> dict[str, str]:
        """Heads of the table beside instrument and score."""
        kept = {self.key: self.name, "kept": f"V^2 kept {self.where}"}
        return kept | {"predicted": "predicted, known PSFs", "predicted_blind": "predicted, blind"}


def between(cells: Sequence[Mapping[str, Any]], key: str, value: str) -> float:
    """Return the amount of least `value` by a parabola over its logarithm, or the least at an end."""
    order = sorted(cells, key=lambda cell: cell[key])
    least = min(range(len(order)), key=lambda k: order[k][value])
    if least in (0, len(order) - 1):
        return order[least][key]
    near = order[least - 1 : least + 2]
    curve = np.polynomial.Polynomial.fit([math.log(cell[key]) for cell in near], [cell[value] for cell in near], 2)
    return math.exp(float(curve.deriv().roots()[0]))


def predict(task: Mapping[str, Any]) -> dict[str, Any]:
    """Return the score of `observing.measure` that TurbulentMSE predicts for known PSFs and a power-law object.

    `instants` is that of instants in narrow light with the same photons.
    """
    still = {name: value for name, value in task.items() if name not in ("exposure", "band")}
    aperture, tasks = instrument(task), {"predicted": task, "instants": still}
    return {name: math.sqrt(float(criterion(one).relative(aperture))) for name, one in tasks.items()}


def criterion(task: Mapping[str, Any]) -> TurbulentMSE:
    """Return the criterion at the conditions of a task, for what lies within the diffraction limit."""
    return criterion_of(task, light(task))


def light(task: Mapping[str, Any]) -> float:
    """Return the electrons per frame through the aperture of a task, which tells those through the mask."""
    aperture, mask = instrument(task), instrument({**task, "instrument": "mask"})
    return float(task["n_photons"] * aperture.area / mask.area)


def criterion_of(task: Mapping[str, Any], photons: float) -> TurbulentMSE:
    """Return the criterion at the conditions of a task, with so many electrons in each frame."""
    side, r0 = task["n_pixels"], DIAMETER / task["d_over_r0"]
    grid = Grid.nyquist(DIAMETER, WAVELENGTH, 2 * side, task.get("oversampling", 1.0))
    exposure = task.get("exposure", 0.0) * Seeing(r0, wind=WIND).tau0
    band = (
        Band.top_hat(WAVELENGTH, task["band"] * WAVELENGTH, task["n_simulated"])
        if "band" in task
        else Band.of([WAVELENGTH])
    )
    signal = PowerLawPSD(1.5, photons, 1 / (SIZE * side))(grid)
    nu_y, nu_x = grid.frequencies(signal.dtype)
    signal[torch.hypot(nu_y, nu_x) >= grid.cutoff(DIAMETER)] *= _NOTHING  # no score counts what lies beyond
    return TurbulentMSE(
        *(grid, signal, NoisePSD(photons, task["readout_noise"], side**2)),
        *(task["n_frames"], r0, task["outer_scale"] * DIAMETER, exposure, WIND if exposure else 0.0),
        *(band.wavelengths, band.shares),
    )


def predictions(
    options: ObservingOptions, key: str, settings: Iterable[Mapping[str, Any]], callback: Callback
) -> dict[tuple[str, float], dict[str, float]]:
    """Return the predicted scores for each instrument and amount: for known PSFs, and blind as a plan says it."""
    common, cases = shared(options, callback), list(itertools.product(options.instruments, settings))
    tasks: list[dict[str, Any]] = [common | dict(setting) | {"instrument": which} for which, setting in cases]
    found = run_tasks(predict, tasks, options.sweep / "tasks", stage="predicted_scores", **options.keywords(callback))
    return {
        (task["instrument"], task[key]): {**row, "predicted_blind": blind(task, row["instants"])}
        for task, row in zip(tasks, found, strict=True)
    }


def blind(task: Mapping[str, Any], instants: float) -> float:
    """Return what a plan makes of the score predicted for instants in narrow light.

    Beyond what was tried, the nearest edge is taken.
    """
    size, photons = instrument(task).subaperture_diameter / DIAMETER * task["d_over_r0"], light(task)
    exposure, spread = task.get("exposure", 0.0), phase_spread(task.get("band", 0.0), task["d_over_r0"])
    with warnings.catch_warnings(action="ignore", category=UserWarning):
        found = success_map(task["instrument"]).outlook(size, photons, task["n_frames"])
        outlook = smearing_map(task["instrument"]).outlook(found, n_photons=photons, exposure=exposure, spread=spread)
    return math.sqrt(outlook.mse(instants**2, instants**2))


@styled
def figure(trade: Trade, cells: Sequence[Mapping[str, Any]]) -> Figure:
    """Score against what is varied, restored and predicted, and what is kept of the contrast."""
    sheet = new_figure(5.4, 3.9)
    ax = sheet.subplots()
    curves(ax, cells, trade.key)
    for (which, name), color in zip(INSTRUMENTS.items(), COLORS, strict=False):
        own = [cell for cell in cells if cell["instrument"] == which]
        for key, style, told in (("predicted", ":", "known PSFs"), ("predicted_blind", "-.", "blind")):
            if own:
                x, y = ([cell[axis] for cell in own] for axis in (trade.key, key))
                ax.plot(x, y, style, color=color, linewidth=1.1, label=f"{name}, predicted, {told}")
    ax.set(xscale="log", xlabel=trade.label, ylabel="score (0 is perfect)")
    ticks = sorted({cell[trade.key] for cell in cells})
    ax.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    ax.minorticks_off()
    beside = ax.twinx()
    fine = np.geomspace(ticks[0], ticks[-1], 50)
    beside.plot(fine, [trade.kept(amount) for amount in fine], "--", color=FAINT)
    beside.set(ylim=(0, 1.02), ylabel=f"V$^2$ kept {trade.where} (dashed)")
    sheet.legend(*ax.get_legend_handles_labels(), loc="outside upper left", ncols=2)
    return sheet

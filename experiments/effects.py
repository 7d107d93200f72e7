"""What a telescope does to frames, what it costs not to know of it, and what the verdict says of wrong settings.

    python experiments/effects.py           # 4 minutes
    python experiments/effects.py --smoke   # everything, tiny, in seconds

The packaged satellite through one random mask and one draw of turbulence, which all frames share. Each row adds one
effect to the frames: a sky, pixels that fill their pitch, a mask that lies turned, exposures of one coherence time. The
restoration is told of it, or not. The last row has none of these, but settings that are wrong.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import torch

from torchmask.atmosphere.layers import Layers
from torchmask.atmosphere.phase import LayeredPhase
from torchmask.cli.options import ExperimentOptions
from torchmask.cli.program import run_script
from torchmask.cli.run import new_run
from torchmask.grid import Grid
from torchmask.metrics import align, lowpass, relative_error
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.detector import Detector
from torchmask.optics.geometry import MaskGeometry
from torchmask.optics.pixel import SquarePixel
from torchmask.record import Callback, Record
from torchmask.restoration.background import Background
from torchmask.restoration.myopic import MyopicDeconvolution
from torchmask.simulation.conditions import Conditions
from torchmask.simulation.exposures import simulate_observation
from torchmask.simulation.scene import SceneOptions, make_scene
from torchmask.viz import style as drawing
from torchmask.viz.figures import peak

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DIAMETER, WAVELENGTH, WIND = 1.0, 550e-9, 10.0  # [m], [m], [m/s]
TURN = 1.2  # [degrees]
SKY = 0.5  # of the object's mean pixel
AS_DRAWN, IDEAL = MaskGeometry(), Conditions()


@dataclass(frozen=True, kw_only=True)
class Options(ExperimentOptions):
    """The observation that all rows share."""

    n_subapertures: int = 9
    """Number of holes of the random mask, whose fill factor is 0.15."""
    d_over_r0: float = 5.0
    """Strength of the turbulence, D / r0."""
    n_photons: float = 2e7
    """Electrons per frame through the mask."""
    readout_noise: float = 1.5
    """Read-out noise [electrons rms per pixel and frame]."""
    n_frames: int = 8
    """Number of short exposures."""
    n_pixels: int = 64
    """Number of pixels per side of the image."""
    iterations: int = 600
    """Maximum number of iterations of a restoration."""
    seed: int = 0
    """Random seed of the mask, the turbulence and the noise."""


@dataclass(frozen=True)
class Restoration:
    """One restoration of a row: its title, and what it is told besides frames, mask and grid."""

    title: str
    told: Mapping[str, Any] = field(default_factory=dict)
    geometry: MaskGeometry = AS_DRAWN
    """How the mask lies, as the restoration is told."""


@dataclass(frozen=True)
class Effect:
    """One row: what happens to the frames, and the restorations that are compared."""

    title: str
    restorations: Sequence[Restoration]
    conditions: Conditions = IDEAL
    geometry: MaskGeometry = AS_DRAWN
    """How the mask lies."""
    pixel: SquarePixel | None = None
    """Pixels of the detector; None: points."""


def effects(options: Options, tau0: float) -> list[Effect]:
    """Return the rows, for turbulence with the coherence time `tau0` [s]."""
    filled, turned = SquarePixel(1.0), MaskGeometry(math.radians(TURN))
    fixed = {"refine_geometry": False}
    return [
        Effect(
            f"sky of {SKY:g} mean pixels",
            [Restoration("no sky assumed", {"background": Background.NONE}), Restoration("a sky may be found")],
            Conditions(sky=SKY * options.n_photons / options.n_pixels**2),
        ),
        Effect(
            "pixels that fill their pitch",
            [Restoration("pixels as points"), Restoration("pixels told", {"pixel": filled})],
            pixel=filled,
        ),
        Effect(
            f"mask turned by {TURN:g} degrees",
            [Restoration("turn not told", fixed), Restoration("turn told", fixed, turned)],
            geometry=turned,
        ),
        Effect(
            "exposures of tau0",
            [Restoration("as snapshots"), Restoration("exposure told", {"exposure_tau0": 1.0})],
            Conditions(exposure_time=tau0),
        ),
        Effect(
            "verdicts",
            [
                Restoration("settings as they are", fixed),
                Restoration("read-out noise too high", {**fixed, "readout_noise": 100.0}),
                Restoration("mask told mirrored", fixed, MaskGeometry(mirrored=True)),
            ],
        ),
    ]


def restore_all(options: Options, callback: Callback) -> tuple[torch.Tensor, Grid, list[dict[str, Any]]]:
    """Return the scene, the grid, and for each row its title, a frame and the restorations with score and verdict."""
    grid = Grid.nyquist(DIAMETER, WAVELENGTH, options.n_pixels)
    scene = make_scene(grid.shape, options.n_photons, SceneOptions(size=0.5), dtype=torch.float64)
    mask = SparseAperture.random(options.n_subapertures, DIAMETER, 0.15, torch.Generator().manual_seed(options.seed))
    layers = Layers.from_fractions(DIAMETER / options.d_over_r0, WAVELENGTH, [0.0], [1.0], [(WIND, 0.0)])
    turbulence = LayeredPhase(layers, WAVELENGTH, 20 * DIAMETER)
    rows = effects(options, layers.tau0(WAVELENGTH))
    total, found = sum(len(effect.restorations) for effect in rows), list[dict[str, Any]]()
    for effect in rows:
        seen = simulate_observation(
            *(
                scene,
                effect.geometry.apply(mask),
                grid,
                turbulence,
                Detector(options.readout_noise, pixel=effect.pixel),
            ),
            *(options.n_frames, torch.Generator().manual_seed(options.seed + 1)),
            conditions=effect.conditions,
        )
        row: dict[str, Any] = {"title": effect.title, "frame": seen.frames[0], "restorations": []}
        found.append(row)
        for restoration in effect.restorations:
            told = {"readout_noise": options.readout_noise, **restoration.told}
            method = MyopicDeconvolution(
                restoration.geometry.apply(mask), grid, max_iterations=options.iterations, **told
            )
            result = method.restore(seen.frames)
            verdict = result.verdict
            assert verdict is not None
            row["restorations"].append(
                {
                    "title": restoration.title,
                    "object": result.object,
                    "score": relative_error(result.object, scene, grid.cutoff(DIAMETER)),
                    "chi_square": verdict.chi_square,
                    "limit": verdict.limit,
                    "explained": verdict.explained,
                }
            )
            done = sum(len(each["restorations"]) for each in found)
            callback(Record("effects", done, total, {"score": row["restorations"][-1]["score"]}))
    return scene, grid, found


@drawing.styled
def figure(scene: torch.Tensor, grid: Grid, rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Draw a row of images for each effect, with a colour bar of its own; the first has a frame unless three fit."""
    cutoff = grid.cutoff(DIAMETER)
    norm = drawing.light_norm(peak(lowpass(scene, cutoff).numpy()))
    sheet = drawing.new_figure(7.2, 2.75 * len(rows))
    for row, part in zip(rows, sheet.subfigures(len(rows), 1, squeeze=False)[:, 0], strict=True):
        part.suptitle(row["title"], x=0.01, ha="left", fontsize=11, fontweight="bold")
        shown = [(image_title(each), align(each["object"], scene, cutoff)) for each in row["restorations"]]
        if len(shown) < 3:
            frame = row["frame"]
            shown = [("one exposure\n", frame * (scene.sum() / frame.sum())), *shown]
        axes = list(part.subplots(1, 3))
        for ax, (title, image) in zip(axes, shown, strict=True):
            ax.imshow(image.numpy(), cmap="gray", norm=norm)
            ax.set(xticks=[], yticks=[])
            ax.set_title(title, fontsize=9.5)
        drawing.light_bar(part, axes)
    return sheet


def image_title(found: Mapping[str, Any]) -> str:
    """Return the title of a restoration: what it was told, its score and its verdict."""
    verdict = "explained" if found["explained"] else "not explained"
    return f"{found['title']}\nscore {found['score']:.3f}, {verdict}"


def page(options: Options, rows: Sequence[Mapping[str, Any]]) -> str:
    """Return a page of Markdown with the scores and verdicts."""
    lines = [
        "# Effects of a telescope, known and not",
        "",
        f"The packaged satellite through a random mask of {options.n_subapertures} holes, "
        f"D/r0 = {options.d_over_r0:g}, {options.n_photons:.0e} electrons per frame, {options.n_frames} frames of "
        f"{options.n_pixels} x {options.n_pixels} pixels, seed {options.seed}, at most {options.iterations} "
        "iterations.",
        "",
        "| frames | restoration | score | chi-square | explained up to | verdict |",
        "|---|---|---|---|---|---|",
    ]
    for row in rows:
        for each in row["restorations"]:
            verdict = "explained" if each["explained"] else "not explained"
            numbers = f"{each['score']:.3f} | {each['chi_square']:.3f} | {each['limit']:.3f}"
            lines.append(f"| {row['title']} | {each['title']} | {numbers} | {verdict} |")
    return "\n".join(lines) + "\n"


def run(options: Options) -> None:
    """Simulate, restore and draw in a new folder."""
    if options.smoke:
        options = replace(options, n_subapertures=5, d_over_r0=3.0, n_frames=2, n_pixels=32, iterations=2)
    with new_run("effects", options, options.seed) as output:
        scene, grid, rows = restore_all(options, output.callback)
        told = [[{k: v for k, v in each.items() if k != "object"} for each in row["restorations"]] for row in rows]
        numbers = [{"title": row["title"], "restorations": each} for row, each in zip(rows, told, strict=True)]
        output.report("effects", {"rows": numbers}, page(options, rows), figure(scene, grid, rows))


def main(argv: Sequence[str] | None = None) -> int:
    """Return the exit status."""
    return run_script("effects", run, Options, __doc__, argv)


if __name__ == "__main__":
    sys.exit(main())

"""`torchmask codesign`: design a mask, observe a scene through turbulence with it, restore the image, compare.

The rival is a full pupil that reaches the same spatial frequencies and receives photons in proportion to its area. All
results, figures and TensorBoard events go to one new folder, runs/<name>/.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Literal

import torch
from rich.console import Console
from rich.table import Table

from torchmask.atmosphere.phase import TurbulencePhase
from torchmask.cli.design import make_criterion, search
from torchmask.cli.options import ConfigOptions, SearchOptions
from torchmask.cli.report import log_design, log_observation
from torchmask.cli.run import Run, new_run
from torchmask.design.search import SearchResult
from torchmask.grid import Grid
from torchmask.io import save_npz
from torchmask.metrics import relative_error, ssim
from torchmask.observation import Observation
from torchmask.optics.aperture import Aperture, FullAperture, SparseAperture
from torchmask.optics.detector import Detector
from torchmask.optics.packing import hole_diameter
from torchmask.record import Callback
from torchmask.restoration.myopic import MyopicDeconvolution
from torchmask.restoration.result import RestorationResult
from torchmask.simulation.exposures import simulate_observation
from torchmask.simulation.scene import SceneOptions, make_scene
from torchmask.spectra import NoisePSD
from torchmask.viz import figures as viz


@dataclass(frozen=True)
class ImagingOptions:
    """Telescope, turbulence and detector of the simulated observation."""

    diameter: float = 1.0
    """Of the disc that the mask is cut from, D [m]."""
    wavelength: float = 550e-9
    """[m]"""
    n_pixels: int = 128
    """Of the image, per side."""
    d_over_r0: float = 7.0
    """Strength of the turbulence, D / r0."""
    outer_scale: float = 20.0
    """Of the turbulence, in units of D."""
    n_frames: int = 20
    """Short exposures, T."""
    n_photons: float = 1e7
    """Electrons per frame through the mask, before light leaves the field."""
    readout_noise: float = 1.5
    """Electrons rms per pixel and frame."""


@dataclass(frozen=True)
class RestorationOptions:
    """The myopic deconvolution, with equal budgets for the mask and the full pupil."""

    n_modes: int | None = None
    """Noll modes, from piston, per sub-aperture (or over the full pupil); None: the library's choice for each."""
    prior: bool = True
    """Weigh aberrations by their von Karman statistics."""
    max_iterations: int = 2800
    """Upper limit of iterations, of all starts together; one start takes 1000 at most."""


@dataclass(frozen=True)
class Config:
    """Everything a run depends on."""

    design: SearchOptions = field(default_factory=SearchOptions)
    imaging: ImagingOptions = field(default_factory=ImagingOptions)
    scene: SceneOptions = field(default_factory=SceneOptions)
    """The target."""
    restoration: RestorationOptions = field(default_factory=RestorationOptions)
    preset: Literal["default", "paper"] = "default"
    """`paper`: CMA-ES alone, piston and tip-tilt only, no aberration prior, as the seed method has it."""
    smoke: bool = False
    """Everything tiny, to see that it runs."""
    seed: int = 0
    """Of the search, the turbulence and the noise."""
    name: str | None = None
    """Folder of the run below `runs`; None: date and time."""
    runs: Path = Path("runs")
    """Where run folders are made."""


@dataclass(frozen=True)
class Options(Config, ConfigOptions):
    """Design a mask, observe a scene through turbulence with it, restore the image, and compare with a full pupil.

    The full pupil reaches the same spatial frequencies and receives photons in proportion to its area. All results,
    figures and TensorBoard events go to one new folder, runs/<name>/.
    """


def with_presets(config: Config) -> Config:
    """The config that runs: `preset` and `smoke` replace what they stand for."""
    design, imaging, restoration = config.design, config.imaging, config.restoration
    if config.preset == "paper":
        design = dataclasses.replace(design, method="cma", refine=False)
        restoration = dataclasses.replace(restoration, n_modes=3, prior=False)
    if config.smoke:
        design = dataclasses.replace(design, n_subapertures=5, budget=200, n_frequencies=64)
        imaging = dataclasses.replace(imaging, n_pixels=64, n_frames=3)
        restoration = dataclasses.replace(restoration, max_iterations=15)
    return dataclasses.replace(config, design=design, imaging=imaging, restoration=restoration)


def image_grid(config: Config) -> Grid:
    """The grid of the exposures: Nyquist for the mask's disc."""
    return Grid.nyquist(config.imaging.diameter, config.imaging.wavelength, config.imaging.n_pixels)


def outside(config: Config) -> tuple[TurbulencePhase, Detector]:
    """What comes between the scene and the frames."""
    imaging = config.imaging
    if not imaging.d_over_r0 > 0:
        raise ValueError(f"imaging.d_over_r0 is {imaging.d_over_r0}: it must be positive")
    turbulence = TurbulencePhase(imaging.diameter / imaging.d_over_r0, imaging.outer_scale * imaging.diameter)
    return turbulence, Detector(imaging.readout_noise)


def inversion(config: Config, aperture: Aperture, n_modes: int | None) -> MyopicDeconvolution:
    """The restoration, told what an observer knows: instrument, read-out noise and turbulence."""
    imaging, options = config.imaging, config.restoration
    return MyopicDeconvolution(
        aperture,
        image_grid(config),
        n_modes=n_modes,
        r0=imaging.diameter / imaging.d_over_r0,
        outer_scale=imaging.outer_scale * imaging.diameter,
        readout_noise=imaging.readout_noise,
        aberration_prior=options.prior,
        max_iterations=options.max_iterations,
    )


def check(config: Config) -> None:
    """Raise ValueError for what the stages after the search would refuse: the search takes long."""
    outside(config)
    design, diameter = config.design, config.imaging.diameter
    size = hole_diameter(design.n_subapertures, diameter, design.fill_factor)
    hole = SparseAperture(torch.zeros(1, 2, dtype=torch.float64), size, diameter)
    inversion(config, hole, config.restoration.n_modes or 1)


def design_mask(config: Config, callback: Callback) -> SearchResult:
    """Search for the mask that minimises MSE_a, with photon noise alone as in the reference case."""
    imaging = config.imaging
    grid = Grid.nyquist(imaging.diameter, imaging.wavelength, config.design.n_frequencies)
    criterion = make_criterion(config.design, grid, NoisePSD(imaging.n_photons), imaging.n_frames)
    return search(config.design, criterion, imaging.diameter, config.seed, callback)


def observe(config: Config, scene: torch.Tensor, aperture: Aperture, callback: Callback) -> Observation:
    """Draw short exposures end to end: the full turbulent phase, and no model that the inversion knows.

    One seed: mask and full pupil look through the same screens.
    """
    turbulence, detector = outside(config)
    generator = torch.Generator().manual_seed(config.seed)
    n_frames = config.imaging.n_frames
    return simulate_observation(
        scene, aperture, image_grid(config), turbulence, detector, n_frames, generator, callback=callback
    )


def restore(config: Config, observation: Observation, callback: Callback) -> RestorationResult:
    """Restore the object from the frames."""
    method = inversion(config, observation.aperture, config.restoration.n_modes)
    return method.restore(observation.frames, callback=callback)


def under(stage: str, callback: Callback) -> Callback:
    """The same callback under another stage's name: both instruments run the same algorithms."""
    return lambda record: callback(dataclasses.replace(record, stage=stage))


def metrics(observation: Observation, result: RestorationResult, cutoff: float) -> dict[str, float]:
    """What the table at the end says of one instrument."""
    truth = observation.object
    assert truth is not None
    return {
        "score": relative_error(result.object, truth, cutoff),
        "ssim": ssim(result.object, truth, cutoff),
        "mean_frame_score": relative_error(observation.frames.mean(0), truth, cutoff),
        "photons_per_frame": float(truth.sum()),
        "chi_square": float(result.chi_square.mean()),
        "iterations": len(result.cost),
        "evaluations": result.n_evaluations,
        "seconds": result.seconds,
    }


def codesign(config: Config, scene: torch.Tensor, output: Run) -> dict[str, dict[str, float]]:
    """Design, observe, restore and compare; returns the metrics of each instrument."""
    logger, callback = output.logger, output.callback
    design = design_mask(config, callback)
    log_design(design, image_grid(config), logger)
    mask = design.aperture
    cutoff = image_grid(config).cutoff(config.imaging.diameter)
    full = FullAperture(mask.extent)
    table: dict[str, dict[str, float]] = {}
    arrays: dict[str, torch.Tensor | float] = {
        "centers": mask.centers,
        "subaperture_diameter": mask.subaperture_diameter,
        "relative_mse": design.relative_mse,
    }
    pictures = {}
    for name, aperture in (("mask", mask), ("full", full)):
        light = scene * (aperture.area / mask.area)
        observation = observe(config, light, aperture, under(f"observation/{name}", callback))
        log_observation(f"observation/{name}", observation, logger)
        result = restore(config, observation, under(f"restoration/{name}", callback))
        logger.figure(f"restoration/{name}_cost", viz.history_figure({name: result.cost.tolist()}, "cost"))
        table[name] = metrics(observation, result, cutoff)
        for key, value in table[name].items():
            logger.scalar(f"comparison/{name}/{key}", value)
        pictures[f"{name}, {table[name]['photons_per_frame']:.1e} photons"] = (observation.frames[0], result.object)
        arrays |= {f"{name}_object": result.object, f"{name}_coefficients": result.coefficients}
        arrays |= {f"{name}_frames": observation.frames}
    logger.figure("comparison", viz.comparison_figure(scene, pictures, cutoff, image_grid(config).pixel_scale))
    logger.table("comparison/table", [{"instrument": name, **row} for name, row in table.items()])
    save_npz(logger.directory / "result.npz", {**arrays, "scene": scene})
    return table


def print_table(table: dict[str, dict[str, float]]) -> None:
    """Scores side by side: 0 is perfect, whichever wins."""
    view = Table(title="Restoration from equal budgets (score: relative error up to the diffraction limit)")
    view.add_column("")
    for name in table:
        view.add_column(name, justify="right")
    for key in next(iter(table.values())):
        view.add_row(key.replace("_", " "), *(f"{row[key]:.4g}" for row in table.values()))
    Console().print(view)


def run(config: Config) -> None:
    """Run in a new folder; an interrupted run leaves there what it reached."""
    directory = config.runs / (config.name or datetime.now().strftime("codesign-%Y%m%d-%H%M%S"))
    config = with_presets(config)
    check(config)
    scene = make_scene(image_grid(config).shape, config.imaging.n_photons, config.scene)
    with new_run("codesign", config, directory, config.seed) as output:
        output.summary.append(f"look at it with: tensorboard --logdir {config.runs}")
        table = codesign(config, scene, output)
    print_table(table)

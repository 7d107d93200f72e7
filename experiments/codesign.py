"""The whole loop: design a mask, observe a scene through turbulence with it, restore the image, compare.

    python experiments/codesign.py                                    # the reference case, a packaged satellite
    python experiments/codesign.py --scene.path model.obj             # any mesh or image
    python experiments/codesign.py --preset paper                     # the method as it was published
    python experiments/codesign.py --smoke                            # everything, tiny, in seconds

The rival is a full pupil that reaches the same spatial frequencies and receives photons in proportion to its area. All
results, figures and TensorBoard events go to one new folder, runs/<name>/.
"""

from __future__ import annotations

import dataclasses
import sys
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Literal

import torch
import tyro
from rich.console import Console
from rich.table import Table

from torchmask import viz
from torchmask.design.criterion import AsymptoticMSE
from torchmask.design.psd import NoisePSD, PowerLawPSD
from torchmask.design.search import SearchResult, search_mask
from torchmask.grid import Grid
from torchmask.io import save_npz
from torchmask.metrics import score, ssim
from torchmask.optics.aperture import Aperture, FullAperture
from torchmask.optics.detector import Detector
from torchmask.optics.otf import analytic_otf
from torchmask.optics.turbulence import TurbulencePhase
from torchmask.progress import Progress
from torchmask.record import Callback
from torchmask.restoration.myopic import MyopicDeconvolution
from torchmask.restoration.result import RestorationResult
from torchmask.simulation.observation import Observation, simulate_observation
from torchmask.simulation.scene import SceneOptions, make_scene
from torchmask.tracking import RunLogger, fan_out


@dataclass(frozen=True)
class DesignOptions:
    """The search for the mask, and the criterion it minimises."""

    n_subapertures: int = 11
    """Number of holes, N."""
    fill_factor: float = 0.15
    """Collecting area N d^2 / D^2."""
    method: Literal["cma", "hybrid"] = "cma"
    """CMA-ES, or descents and basin hopping on a coarse grid, which finds better masks."""
    refine: bool = True
    """Refine the result by gradient descent through the same criterion."""
    budget: int | None = None
    """Evaluations of the criterion; None: the method's own default."""
    n_frequencies: int = 256
    """Frequency grid of the criterion, per side."""
    exponent: float = 1.5
    """Of the power-law power spectrum of the object."""
    knee: float = 1 / 64
    """Frequency below which that spectrum is flat [cycles/pixel]: one over the object's size in pixels."""


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
    max_iterations: int = 700
    """Upper limit of L-BFGS-B iterations."""


@dataclass(frozen=True)
class Config:
    """Everything a run depends on."""

    design: DesignOptions = field(default_factory=DesignOptions)
    imaging: ImagingOptions = field(default_factory=ImagingOptions)
    scene: SceneOptions = field(default_factory=SceneOptions)
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


def design_mask(config: Config, callback: Callback) -> SearchResult:
    """Search for the mask that minimises MSE_a, with photon noise alone as in the reference case."""
    options, imaging = config.design, config.imaging
    criterion = AsymptoticMSE(
        Grid.nyquist(imaging.diameter, imaging.wavelength, options.n_frequencies),
        PowerLawPSD(options.exponent, imaging.n_photons, options.knee),
        NoisePSD(imaging.n_photons),
        n_frames=imaging.n_frames,
    )
    return search_mask(
        criterion,
        options.n_subapertures,
        imaging.diameter,
        options.fill_factor,
        method=options.method,
        refine=options.refine,
        budget=options.budget,
        seed=config.seed,
        callback=callback,
    )


def observe(config: Config, scene: torch.Tensor, aperture: Aperture, callback: Callback) -> Observation:
    """Draw short exposures end to end: the full turbulent phase, and no model that the inversion knows.

    One seed: mask and full pupil look through the same screens.
    """
    imaging = config.imaging
    return simulate_observation(
        scene,
        aperture,
        image_grid(config),
        TurbulencePhase(imaging.diameter / imaging.d_over_r0, imaging.outer_scale * imaging.diameter),
        Detector(imaging.readout_noise),
        imaging.n_frames,
        torch.Generator().manual_seed(config.seed),
        callback=callback,
    )


def restore(config: Config, observation: Observation, callback: Callback) -> RestorationResult:
    """Restore the object from the frames and what an observer knows: instrument, read-out noise and turbulence."""
    options = config.restoration
    inversion = MyopicDeconvolution(
        observation.aperture,
        observation.grid,
        n_modes=options.n_modes,
        r0=observation.r0,
        outer_scale=observation.outer_scale,
        readout_noise=observation.readout_noise,
        aberration_prior=options.prior,
        max_iterations=options.max_iterations,
    )
    return inversion.restore(observation.frames, callback=callback)


def log_design(design: SearchResult, grid: Grid, logger: RunLogger) -> None:
    """The mask, the frequencies it passes, and how the search went."""
    logger.figure("design/mask", viz.mask_figure(design.aperture))
    logger.figure("design/uv_coverage", viz.uv_coverage_figure(design.aperture, grid))
    logger.figure(
        "design/history",
        viz.history_figure(
            {stage: best[:, 1].tolist() for stage, best in design.history.items()}, "relative MSE", "report"
        ),
    )
    logger.scalar("design/relative_mse", design.relative_mse)


def log_observation(name: str, observation: Observation, logger: RunLogger) -> None:
    """PSFs with and without turbulence, their MTFs, and frames."""
    assert observation.psfs is not None
    grid = observation.grid
    psfs = torch.fft.ifftshift(observation.psfs, dim=(-2, -1))
    perfect = analytic_otf(observation.aperture, grid)
    still = torch.fft.ifft2(perfect).real
    logger.figure(f"{name}/psf", viz.psf_figure({"no turbulence": still, "first exposure": psfs[0]}, grid))
    logger.figure(f"{name}/mtf", viz.mtf_figure({"no turbulence": perfect, "exposures": torch.fft.fft2(psfs)}, grid))
    logger.figure(f"{name}/frames", viz.frames_figure(observation.frames, pixel_scale=grid.pixel_scale))
    logger.image(f"{name}/first_frame", observation.frames[0])


def under(stage: str, callback: Callback) -> Callback:
    """The same callback under another stage's name: both instruments run the same algorithms."""
    return lambda record: callback(dataclasses.replace(record, stage=stage))


def metrics(observation: Observation, result: RestorationResult, cutoff: float) -> dict[str, float]:
    """What the table at the end says of one instrument."""
    truth = observation.object
    assert truth is not None
    return {
        "score": score(result.object, truth, cutoff),
        "ssim": ssim(result.object, truth, cutoff),
        "mean_frame_score": score(observation.frames.mean(0), truth, cutoff),
        "photons_per_frame": float(truth.sum()),
        "chi_square": float(result.chi_square.mean()),
        "iterations": len(result.cost),
        "evaluations": result.n_evaluations,
        "seconds": result.seconds,
    }


def run(config: Config, scene: torch.Tensor, logger: RunLogger, callback: Callback) -> dict[str, dict[str, float]]:
    """Design, observe, restore and compare; returns the metrics of each instrument."""
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
            logger.scalar(f"comparison/{name}_{key}", value)
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


def main(config: Config) -> int:
    """Run in a new folder; an interrupted run leaves there what it reached."""
    directory = config.runs / (config.name or datetime.now().strftime("codesign-%Y%m%d-%H%M%S"))
    config = with_presets(config)
    try:
        scene = make_scene(image_grid(config).shape, config.imaging.n_photons, config.scene)
        with RunLogger(directory, seed=config.seed) as logger, Progress() as progress:
            logger.log_config(config)
            table = run(config, scene, logger, fan_out(logger, progress))
    except KeyboardInterrupt:
        print(f"\ninterrupted: what was reached is in {directory}", file=sys.stderr)
        return 130
    except ValueError as error:
        print(f"codesign: {error}", file=sys.stderr)
        return 2
    print_table(table)
    print(f"{directory}\nlook at it with: tensorboard --logdir {config.runs}")
    return 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Config, description=__doc__)))

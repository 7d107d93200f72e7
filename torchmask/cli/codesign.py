"""`torchmask codesign`: design a mask, simulate and restore an observation with it, and compare with a full pupil.

The full pupil reaches the same spatial frequencies and receives photons in proportion to its area. All results, figures
and TensorBoard events go to one new folder, runs/codesign-date-time by default.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Literal

import torch
from rich.console import Console
from rich.table import Table

from torchmask.atmosphere.phase import TurbulencePhase
from torchmask.cli.design import search
from torchmask.cli.options import ExperimentOptions, SearchOptions
from torchmask.cli.report import log_cost, log_design, log_observation
from torchmask.cli.run import Run, new_run
from torchmask.design.criterion import AsymptoticMSE
from torchmask.design.search import SearchResult
from torchmask.grid import Grid
from torchmask.io import save_npz
from torchmask.memory import require_memory
from torchmask.metrics import relative_error, ssim
from torchmask.numbers import require_wavelength
from torchmask.observation import Observation
from torchmask.optics.aperture import Aperture, FullAperture, SparseAperture
from torchmask.optics.detector import Detector
from torchmask.optics.packing import hole_diameter
from torchmask.record import Callback, label_stage
from torchmask.restoration.background import Background
from torchmask.restoration.myopic import MyopicDeconvolution
from torchmask.restoration.result import RestorationResult
from torchmask.restoration.schedule import Schedule
from torchmask.restoration.verdict import Verdict
from torchmask.simulation.exposures import simulate_observation
from torchmask.simulation.scene import SceneOptions, make_scene
from torchmask.spectra import NYQUIST, NoisePSD, PowerLawPSD
from torchmask.viz.comparison import comparison_figure

LABELS = {"mask": "mask", "full": "full pupil"}  # in figures; in this order, so that each has one colour everywhere


@dataclass(frozen=True)
class ImagingOptions:
    """Telescope, turbulence and detector of the simulated observation."""

    diameter: float = 1.0
    """Diameter D of the disc that the mask is cut from [m]."""
    wavelength: float = 550e-9
    """Wavelength of the light [m]."""
    n_pixels: int = 128
    """Number of pixels per side of the image."""
    d_over_r0: float = 7.0
    """Strength of the turbulence, D / r0."""
    outer_scale: float = 20.0
    """Outer scale of the turbulence, in units of D."""
    n_frames: int = 20
    """Number T of short exposures."""
    n_photons: float = 1e7
    """Electrons per frame through the mask, including light that falls outside the field."""
    readout_noise: float = 1.5
    """Read-out noise [electrons rms per pixel and frame]."""


@dataclass(frozen=True)
class RestorationOptions:
    """Settings of the myopic deconvolution, the same for the mask and the full pupil."""

    n_modes: int | None = None
    """Number of Zernike modes per hole or over the full pupil, from Noll mode 1 (piston); None: 6, or 231 for the full
    pupil."""
    prior: bool = True
    """Weight the aberrations by their von Karman statistics."""
    max_iterations: int = 2800
    """Maximum number of iterations over all starts, each of which takes at most 1000."""
    plain: bool = False
    """Use one plain L-BFGS descent on a fixed cost, without further starts, escapes, recalibration or sky."""
    told_turbulence: bool = False
    """Give the restoration r0 and the outer scale of the simulation, which an observer does not know."""


@dataclass(frozen=True, kw_only=True)
class Options(ExperimentOptions):
    """Design a mask, observe a scene through turbulence with it, restore the image, and compare with a full pupil.

    The full pupil reaches the same spatial frequencies and receives photons in proportion to its area. All results,
    figures and TensorBoard events go to one new folder.
    """

    design: SearchOptions = field(default_factory=SearchOptions)
    imaging: ImagingOptions = field(default_factory=ImagingOptions)
    scene: SceneOptions = field(default_factory=SceneOptions)
    """Scene that is observed."""
    restoration: RestorationOptions = field(default_factory=RestorationOptions)
    preset: Literal["default", "paper"] = "default"
    """With paper, the method as first published: CMA-ES alone, piston, tip and tilt only, no aberration prior, and one
    plain L-BFGS."""
    seed: int = 0
    """Seed of the search, the turbulence and the noise."""


def with_presets(options: Options) -> Options:
    """Return the options with the replacements of `preset` and `smoke`."""
    design, imaging, restoration = options.design, options.imaging, options.restoration
    if options.preset == "paper":
        design = dataclasses.replace(design, method="cma", refine=False)
        restoration = dataclasses.replace(restoration, n_modes=3, prior=False, plain=True)
    if options.smoke:
        design = dataclasses.replace(design, n_subapertures=5, budget=200, n_frequencies=64)
        imaging = dataclasses.replace(imaging, n_pixels=64, n_frames=3)
        restoration = dataclasses.replace(restoration, max_iterations=15)
    return dataclasses.replace(options, design=design, imaging=imaging, restoration=restoration)


def image_grid(options: Options) -> Grid:
    """Return the grid of the exposures, Nyquist-sampled for the mask's disc."""
    return Grid.nyquist(options.imaging.diameter, options.imaging.wavelength, options.imaging.n_pixels)


def outside(options: Options) -> tuple[TurbulencePhase, Detector]:
    """Return turbulence and detector of the simulation. Raises ValueError if their options are out of range."""
    imaging = options.imaging
    if not imaging.diameter > 0:
        raise ValueError(f"imaging.diameter is {imaging.diameter}: it must be positive, in m")
    if not imaging.d_over_r0 > 0:
        raise ValueError(f"imaging.d_over_r0 is {imaging.d_over_r0}: it must be positive")
    if not imaging.outer_scale > 0:
        raise ValueError(f"imaging.outer_scale is {imaging.outer_scale}: it must be positive, in units of the diameter")
    turbulence = TurbulencePhase(imaging.diameter / imaging.d_over_r0, imaging.outer_scale * imaging.diameter)
    return turbulence, Detector(imaging.readout_noise)


def inversion(options: Options, aperture: Aperture, n_modes: int | None) -> MyopicDeconvolution:
    """Return the restoration method with what an observer knows: instrument and noise, on request the turbulence."""
    imaging, wanted = options.imaging, options.restoration
    told = wanted.told_turbulence
    return MyopicDeconvolution(
        aperture,
        image_grid(options),
        n_modes=n_modes,
        r0=imaging.diameter / imaging.d_over_r0 if told else None,
        outer_scale=imaging.outer_scale * imaging.diameter if told else None,
        readout_noise=imaging.readout_noise,
        background=Background.NONE if wanted.plain else Background.IF_SEEN,
        schedule=Schedule.plain() if wanted.plain else None,
        aberration_prior=wanted.prior,
        max_iterations=wanted.max_iterations,
    )


def check(options: Options) -> None:
    """Raise ValueError for options that stages after the search would reject, before that long search begins."""
    require_wavelength("--imaging.wavelength", options.imaging.wavelength)
    outside(options)
    design, diameter = options.design, options.imaging.diameter
    size = hole_diameter(design.n_subapertures, diameter, design.fill_factor)
    hole = SparseAperture(torch.zeros(1, 2, dtype=torch.float64), size, diameter)
    modes = options.restoration.n_modes
    inversion(options, hole, 3 if modes is None else modes)
    imaging = options.imaging
    require_memory("imaging.n_frames", imaging.n_frames, 16.0 * imaging.n_frames * imaging.n_pixels**2)  # and PSFs


def design_mask(options: Options, callback: Callback) -> SearchResult:
    """Search for the mask that minimises MSE_a, with the noise of the simulated detector and the size of the scene."""
    imaging = options.imaging
    grid = Grid.nyquist(imaging.diameter, imaging.wavelength, options.design.n_frequencies)
    noise = NoisePSD(imaging.n_photons, imaging.readout_noise, imaging.n_pixels**2)
    spectrum = PowerLawPSD(options.design.exponent, imaging.n_photons, scene_knee(options))
    criterion = AsymptoticMSE(grid, spectrum, noise, imaging.n_frames)
    return search(options.design, criterion, imaging.diameter, options.seed, callback)


def scene_knee(options: Options) -> float:
    """Return --design.knee, or else one over the larger side of the scene [cycles/pixel]."""
    knee = options.design.knee
    return min(NYQUIST, 1 / (options.scene.size * options.imaging.n_pixels)) if knee is None else knee


def observe(options: Options, scene: torch.Tensor, aperture: Aperture, callback: Callback) -> Observation:
    """Simulate short exposures end to end, with the full turbulent phase and independently of the restoration's model.

    The seed is the same for mask and full pupil, so that both look through the same screens.
    """
    turbulence, detector = outside(options)
    generator = torch.Generator().manual_seed(options.seed)
    n_frames = options.imaging.n_frames
    return simulate_observation(
        scene, aperture, image_grid(options), turbulence, detector, n_frames, generator, callback=callback
    )


def restore(options: Options, observation: Observation, callback: Callback) -> RestorationResult:
    """Restore the object from the frames."""
    method = inversion(options, observation.aperture, options.restoration.n_modes)
    return method.restore(observation.frames, callback=callback)


def metrics(observation: Observation, result: RestorationResult, cutoff: float) -> dict[str, float]:
    """Return one instrument's column of the table at the end."""
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


def codesign(
    options: Options, scene: torch.Tensor, output: Run
) -> tuple[dict[str, dict[str, float]], dict[str, Verdict | None]]:
    """Design, observe, restore and compare; return the metrics of each instrument, and the verdicts."""
    logger, callback = output.logger, output.callback
    design = design_mask(options, callback)
    log_design(design, image_grid(options), logger)
    mask = design.aperture
    cutoff = image_grid(options).cutoff(options.imaging.diameter)
    full = FullAperture(mask.extent)
    table: dict[str, dict[str, float]] = {}
    arrays: dict[str, torch.Tensor | float] = {
        "centers": mask.centers,
        "subaperture_diameter": mask.subaperture_diameter,
        "relative_mse": design.relative_mse,
    }
    pictures, costs, verdicts = {}, {}, dict[str, Verdict | None]()
    for name, aperture in (("mask", mask), ("full", full)):
        light = scene * (aperture.area / mask.area)
        observation = observe(options, light, aperture, label_stage(callback, name))
        log_observation(f"observation/{name}", observation, logger)
        result = restore(options, observation, label_stage(callback, name))
        verdicts[name] = result.verdict
        costs[LABELS[name]] = result.cost.tolist()
        table[name] = metrics(observation, result, cutoff)
        for key, value in table[name].items():
            logger.scalar(f"summary/{name}/{key}", value)
        title = f"{LABELS[name]}, {table[name]['photons_per_frame']:.1e} photons"
        pictures[title] = (observation.frames[0], result.object)
        arrays |= {f"{name}_object": result.object, f"{name}_coefficients": result.coefficients}
        arrays |= {f"{name}_frames": observation.frames}
    log_cost("restoration/cost", costs, logger)
    logger.figure("comparison", comparison_figure(scene, pictures, cutoff, image_grid(options).pixel_scale))
    logger.table("comparison/table", [{"instrument": name, **row} for name, row in table.items()])
    save_npz(logger.directory / "result.npz", {**arrays, "scene": scene})
    logger.conclude(verdicts={name: verdict and verdict.to_json() for name, verdict in verdicts.items()})
    return table, verdicts


def print_table(table: dict[str, dict[str, float]]) -> None:
    """Print the metrics of the instruments side by side; a score of 0 is perfect."""
    view = Table(title="Restoration from equal budgets (score: relative error up to the diffraction limit)")
    view.add_column("")
    for name in table:
        view.add_column(name, justify="right")
    for key in next(iter(table.values())):
        view.add_row(key.replace("_", " "), *(f"{row[key]:.4g}" for row in table.values()))
    Console().print(view)


def run(options: Options) -> None:
    """Run in a new folder, in which an interrupted run leaves its results so far."""
    options = with_presets(options)
    check(options)
    scene = make_scene(image_grid(options).shape, options.imaging.n_photons, options.scene)
    with new_run("codesign", options, options.seed) as output:
        imaging = options.imaging
        output.summary.append(
            f"seen with D = {imaging.diameter:g} m at {1e9 * imaging.wavelength:g} nm, D / r0 = {imaging.d_over_r0:g}"
        )
        output.summary.append(f"view it with: tensorboard --logdir {output.directory.parent}")
        table, verdicts = codesign(options, scene, output)
    print_table(table)
    print(*(f"{name}: {verdict}" for name, verdict in verdicts.items()), sep="\n")

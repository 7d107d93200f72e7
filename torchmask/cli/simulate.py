"""`torchmask simulate`: draw short exposures."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch

from torchmask.atmosphere.phase import TurbulencePhase
from torchmask.cli.options import MaskOptions, RunOptions, load_aperture
from torchmask.cli.report import log_observation
from torchmask.cli.run import new_run
from torchmask.grid import ARCSEC, Grid
from torchmask.optics.detector import Detector
from torchmask.simulation.exposures import simulate_observation
from torchmask.simulation.scene import SceneOptions, make_scene


@dataclass(frozen=True, kw_only=True)
class Options(MaskOptions, RunOptions):
    """Draw short exposures of a scene through a mask and turbulence, with photon and read-out noise.

    Writes stack.npz (for `torchmask restore`; it holds the truth too), figures, config.yaml and the log to a new
    folder.
    """

    scene: SceneOptions = field(default_factory=SceneOptions)
    """The target."""
    wavelength: float = 550e-9
    """Of the observation [m]."""
    n_pixels: int = 128
    """Of the image, per side."""
    pixel_scale_arcsec: float | None = None
    """Angle on the sky of one pixel [arcsec]; None: the largest without aliasing, wavelength / (2 D)."""
    r0: float | None = 0.15
    """Fried parameter of the turbulence at the wavelength [m]; None: no turbulence."""
    outer_scale: float = 20.0
    """Of the turbulence [m]."""
    n_frames: int = 20
    """Short exposures."""
    n_photons: float = 1e7
    """Electrons per frame through the mask, before light leaves the field."""
    readout_noise: float = 1.5
    """Electrons rms per pixel and frame."""
    seed: int = 0
    """Of the turbulence and the noise."""


def run(options: Options) -> None:
    """Simulate, and write the stack."""
    aperture = load_aperture(options)
    if options.pixel_scale_arcsec is None:
        # Real masks may reach beyond their nominal pupil.
        diameter = max(aperture.mask_diameter, aperture.extent)
        grid = Grid.nyquist(diameter, options.wavelength, options.n_pixels)
    else:
        grid = Grid(options.n_pixels, options.pixel_scale_arcsec * ARCSEC, options.wavelength)
    turbulence = None if options.r0 is None else TurbulencePhase(options.r0, options.outer_scale)
    detector = Detector(options.readout_noise)
    scene = make_scene(grid.shape, options.n_photons, options.scene)
    with new_run("simulate", options, options.seed) as output:
        generator = torch.Generator().manual_seed(options.seed)
        observation = simulate_observation(
            scene, aperture, grid, turbulence, detector, options.n_frames, generator, callback=output.callback
        )
        observation.save(output.directory / "stack.npz")
        log_observation("observation", observation, output.logger)
        kept = float(observation.frames.sum() / (options.n_photons * options.n_frames))
        output.summary.append(
            f"{options.n_frames} frames of {grid.shape[0]} x {grid.shape[1]} pixels of "
            f"{grid.pixel_scale / ARCSEC:.4g} arcsec, {100 * kept:.1f} % of the light inside the field"
        )

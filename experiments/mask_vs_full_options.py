"""Options of `mask_vs_full`."""

from __future__ import annotations

import dataclasses
import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from torchmask.atmosphere.phase import TurbulencePhase
from torchmask.cli.options import SweepOptions
from torchmask.grid import Grid
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.packing import hole_diameter
from torchmask.restoration.myopic import MyopicDeconvolution
from torchmask.spectra import NoisePSD

DIAMETER, WAVELENGTH = 1.0, 550e-9  # [m]; only ratios to them matter
VIEWS = {"satellite, oblique": (25.0, -30.0, 15.0), "satellite, front": (0.0, 0.0, 0.0)}


@dataclass(frozen=True, kw_only=True)
class MaskSearchOptions(SweepOptions):
    """Options for the choice of the mask."""

    mask: Path | None = None
    """File of the mask to use (.json, .dxf or .fits); None: search for one."""
    n_subapertures: int = 11
    """Number of holes of the searched mask."""
    fill_factor: float = 0.15
    """Collecting area N d^2 / D^2 of the searched mask."""
    budget: int = 20_000
    """Number of evaluations of the search."""


@dataclass(frozen=True, kw_only=True)
class Options(MaskSearchOptions):
    """Options of the restorations."""

    photons: tuple[float, ...] = (1e5, 1e6, 1e7)
    """Electrons per frame through the mask."""
    d_over_r0: tuple[float, ...] = (3.0, 7.0, 15.0)
    """Strengths of the turbulence, D / r0."""
    seeds: tuple[int, ...] = (0, 1)
    """Seeds of the turbulence and the noise."""
    views: int = 2
    """Number of views of the packaged satellite used as scenes: 0, 1 or 2."""
    scenes: tuple[Path, ...] = ()
    """Further scenes: meshes (.obj, .stl, .ply, .glb ...) or images (.npz, .png, .fits)."""
    n_frames: int = 10
    """Number T of short exposures."""
    n_pixels: int = 96
    """Number of pixels per side of the image."""
    iterations: int = 2400
    """Maximum number of iterations over all starts of a restoration."""
    restarts: int = 1
    """Number of restorations of the full pupil, of which the best fit is kept."""
    readout_noise: float = 1.5
    """Read-out noise [electrons rms per pixel and frame]."""
    outer_scale: float = 20.0
    """Outer scale of the turbulence, in units of D."""
    full: bool = False
    """Run the whole grid, which takes hours on many cores."""


def with_presets(options: Options) -> Options:
    """Return the options with the replacements of `full` and `smoke`."""
    if options.full and options.smoke:
        raise ValueError("full and smoke are both given: choose one")
    if options.full:
        whole = {"photons": (1e4, 1e5, 1e6, 1e7, 1e8), "d_over_r0": (3.0, 5.0, 7.0, 10.0, 15.0)}
        whole |= {"seeds": (0, 1, 2, 3, 4), "n_frames": 20, "n_pixels": 128, "iterations": 4000, "restarts": 2}
        options = dataclasses.replace(options, **whole)
    if options.smoke:
        tiny: dict[str, Any] = {"photons": (1e5, 1e6), "d_over_r0": (3.0,), "seeds": (0, 1), "views": 1, "n_frames": 2}
        tiny |= {"n_pixels": 32, "iterations": 8, "n_subapertures": 4, "budget": 100}
        options = dataclasses.replace(options, **tiny)
    return options


def check(options: Options) -> None:
    """Raise ValueError for options that the restorations would reject, before the long search begins."""
    for name in ("photons", "d_over_r0", "seeds"):
        values = getattr(options, name)
        if not values or len(set(values)) < len(values):
            raise ValueError(f"{name} is {values}: it must hold at least one value, and none twice")
    for name in ("n_frames", "iterations", "restarts"):
        if getattr(options, name) < 1:
            raise ValueError(f"{name} is {getattr(options, name)}: it must be at least 1")
    if options.restarts > options.n_frames:
        raise ValueError(f"restarts is {options.restarts}: {options.n_frames} frames have no more starts than that")
    if not 0 <= options.views <= len(VIEWS) or not (options.views or options.scenes):
        raise ValueError(f"views is {options.views}: it must be 0 to {len(VIEWS)}, and 0 only with other scenes")
    names = [path.name for path in options.scenes]
    if len(set(names)) < len(names):
        raise ValueError(f"scenes are named {', '.join(names)}: give each file a name of its own")
    scenes(options)
    outer_scale = options.outer_scale * DIAMETER
    for strength in options.d_over_r0:
        if not strength > 0:
            raise ValueError(f"d_over_r0 is {strength}: it must be positive")
        TurbulencePhase(DIAMETER / strength, outer_scale)
    for photons in options.photons:
        NoisePSD(photons, options.readout_noise)
    size = hole_diameter(options.n_subapertures, DIAMETER, options.fill_factor)
    hole = SparseAperture(torch.zeros(1, 2, dtype=torch.float64), size, DIAMETER)
    MyopicDeconvolution(hole, Grid.nyquist(DIAMETER, WAVELENGTH, options.n_pixels))


def scenes(options: Options) -> dict[str, dict[str, Any]]:
    """Names of the scenes and what they are; a file counts by its content."""
    found: dict[str, dict[str, Any]] = {
        name: {"path": None, "attitude": attitude} for name, attitude in list(VIEWS.items())[: options.views]
    }
    for path in options.scenes:
        if not path.is_file():
            raise ValueError(f"there is no scene {path}")
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
        found[path.name] = {"path": str(path), "attitude": None, "sha256": digest}
    return found

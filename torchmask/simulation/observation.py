"""A stack of short exposures, and the end-to-end simulation that draws one.

The simulation shares no model with the inversion: the turbulent phase is sampled within each sub-aperture rather than
expanded in modes, on a pupil raster four times as fine, whose image is four times as wide as the field, and light that
leaves the field is lost.
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchmask.grid import Grid
from torchmask.io import load_npz, save_npz
from torchmask.optics.aperture import Aperture, FullAperture, SparseAperture
from torchmask.optics.detector import Detector, image_formation
from torchmask.optics.otf import psf_from_samples
from torchmask.optics.turbulence import TurbulencePhase
from torchmask.record import Callback, Record

_OVERSAMPLING = 4  # of the pupil: the field of the PSFs beside that of the image
_CHUNK = 2**21  # pixels of unfolded PSFs held at once

_NEEDED_NUMBERS = ("subaperture_diameter", "mask_diameter", "pixel_scale", "wavelength", "readout_noise")
_NUMBERS = (*_NEEDED_NUMBERS, "orientation", "central_obstruction", "r0", "outer_scale", "n_photons")


@dataclass(frozen=True, eq=False)
class Observation:
    """Short exposures of one object, how they were taken and, where it is known, the truth behind them.

    frames : (T, H, W) electrons
    aperture, grid : what they were taken through
    readout_noise : electrons rms per pixel and frame
    object : (H, W) the scene in expected electrons per frame, on the frames' pixels
    psfs : (T, H, W) centred on pixel [H // 2, W // 2] and cropped to the field, not renormalised: what is missing to a
        sum of 1 fell outside
    r0, outer_scale : of the turbulence [m]
    n_photons : electrons per frame, before the field was cropped

    The last five are None where nobody knows them, as in a real observation.
    """

    frames: Tensor
    aperture: Aperture
    grid: Grid
    readout_noise: float
    object: Tensor | None = None
    psfs: Tensor | None = None
    r0: float | None = None
    outer_scale: float | None = None
    n_photons: float | None = None

    def __post_init__(self) -> None:
        if self.frames.ndim != 3 or self.frames.shape[-2:] != self.grid.shape or not len(self.frames):
            raise ValueError(
                f"frames has shape {tuple(self.frames.shape)}: it must be (n_frames, {self.grid.shape[0]}, "
                f"{self.grid.shape[1]}), with at least one frame"
            )
        if not (math.isfinite(self.readout_noise) and self.readout_noise >= 0):
            raise ValueError(f"readout_noise is {self.readout_noise}: it must be finite and not negative")
        for name, shape in (("object", self.grid.shape), ("psfs", tuple(self.frames.shape))):
            values = getattr(self, name)
            if values is not None and tuple(values.shape) != shape:
                raise ValueError(f"{name} has shape {tuple(values.shape)}: it must be {shape}")

    def save(self, path: str | Path) -> None:
        """Write everything to a new .npz file (compressed, without pickle; the format of `load`).

        Raises ValueError if the file exists, its folder does not, or its name does not end in .npz.
        """
        aperture, grid = self.aperture, self.grid
        values = {
            "frames": self.frames,
            "readout_noise": self.readout_noise,
            "pixel_scale": grid.pixel_scale,
            "wavelength": grid.wavelength,
            "centers": aperture.centers,
            "subaperture_diameter": aperture.subaperture_diameter,
            "mask_diameter": aperture.mask_diameter,
            "shape": aperture.shape,
            "orientation": aperture.orientation,
            "central_obstruction": aperture.central_obstruction,
        }
        truth = {name: getattr(self, name) for name in ("object", "psfs", "r0", "outer_scale", "n_photons")}
        save_npz(path, values | {name: value for name, value in truth.items() if value is not None})

    @classmethod
    def load(cls, path: str | Path) -> Observation:
        """Read what `save` wrote, or any .npz file with its keys.

        `shape`, `orientation`, `central_obstruction` and the truth may be missing. One centred disc is a full pupil
        of its own diameter, whatever `mask_diameter` says.

        Raises
        ------
        ValueError
            If the file is missing, damaged, holds pickled objects, lacks a key or holds arrays that disagree.
        """
        stored = load_npz(path, required=("frames", "centers", *_NEEDED_NUMBERS))
        try:
            return cls._from_arrays(stored)
        except (ValueError, TypeError) as error:
            raise ValueError(f"{path} holds no valid observation: {error}") from error

    @classmethod
    def _from_arrays(cls, stored: dict) -> Observation:
        number = {name: float(stored[name].item()) for name in _NUMBERS if name in stored}
        centers, diameter = torch.from_numpy(stored["centers"]), number["subaperture_diameter"]
        shape, orientation = str(stored.get("shape", "disc")), number.get("orientation", 0.0)
        if len(centers) == 1 and not centers.any() and shape == "disc":
            aperture = FullAperture(diameter, number.get("central_obstruction", 0.0), dtype=centers.dtype)
        else:
            aperture = SparseAperture(centers, diameter, number["mask_diameter"], shape, orientation)
        frames = torch.from_numpy(stored["frames"])
        height, width = frames.shape[-2:]
        grid = Grid(height if height == width else (height, width), number["pixel_scale"], number["wavelength"])
        truth: dict[str, Any] = {n: torch.from_numpy(stored[n]) for n in ("object", "psfs") if n in stored}
        truth |= {name: number[name] for name in ("r0", "outer_scale", "n_photons") if name in number}
        return cls(frames, aperture, grid, number["readout_noise"], **truth)


def simulate_observation(
    scene: Tensor,
    aperture: Aperture,
    grid: Grid,
    turbulence: TurbulencePhase | None,
    detector: Detector,
    n_frames: int,
    generator: torch.Generator | None = None,
    *,
    callback: Callback | None = None,
) -> Observation:
    """Draw short exposures of a scene, end to end.

    Parameters
    ----------
    scene : (H, W) tensor
        Expected electrons per pixel and frame before any blur; its sum is the number of photons that the aperture
        collects in a frame. All of it lies within the field.
    aperture : Aperture
        One aperture, without leading axes.
    grid : Grid
    turbulence : TurbulencePhase or None
        None for a perfect atmosphere.
    detector : Detector
    n_frames : int
    generator : torch.Generator, optional
        Seeds one stream for the screens and one for the noise: another flux or read-out noise leaves the screens as
        they were.
    callback : callable, optional
        Receives a `Record` of stage "simulation" after each chunk of frames, with the frames so far.

    Returns
    -------
    Observation
        Of the scene's dtype and device, detached.

    Raises
    ------
    ValueError
        If the scene does not fit the grid, is negative, black or not finite, the aperture is a population,
        `n_frames` is below 1, or the grid samples the aperture too coarsely.

    Examples
    --------
    >>> mask = SparseAperture([[0.0, 0.3], [0.3, -0.2], [-0.3, -0.2]], 0.2, 1.0)
    >>> scene = torch.zeros(32, 32, dtype=torch.float64); scene[12:20, 14:18] = 1000.0
    >>> observation = simulate_observation(
    ...     scene, mask, Grid.nyquist(1.0, 550e-9, 32), TurbulencePhase(0.15, 20.0), Detector(1.5), n_frames=4,
    ...     generator=torch.Generator().manual_seed(0))
    >>> observation.frames.shape
    torch.Size([4, 32, 32])
    """
    scene = scene.detach()
    _check(scene, aperture, grid, n_frames)
    device = None if generator is None else generator.device
    screens_seed, noise_seed = torch.randint(2**62, (2,), generator=generator, device=device).tolist()
    noise = torch.Generator().manual_seed(noise_seed)
    with torch.no_grad():
        samples = aperture.samples(grid, _OVERSAMPLING)
        phases = None
        if turbulence is not None:
            phases = turbulence(samples, n_frames, torch.Generator().manual_seed(screens_seed))
        chunk = max(1, _CHUNK // math.prod(samples.raster))
        frames, psfs = [], []
        for first in range(0, n_frames, chunk):
            count = min(chunk, n_frames - first)
            phase = None if phases is None else phases[first : first + count]
            unfolded = psf_from_samples(samples, phase).to(scene).expand(count, *samples.raster)
            frames.append(detector(image_formation(scene, unfolded), noise))
            psfs.append(_centre(unfolded, grid.shape))
            if callback is not None:
                light = {"kept_light": float(frames[-1].sum() / (count * scene.sum()))}
                callback(Record("simulation", first + count, n_frames, light, {"frames": torch.cat(frames)}))
    return Observation(
        frames=torch.cat(frames),
        aperture=copy.deepcopy(aperture).requires_grad_(False),  # a mask that trains on does not change the past
        grid=grid,
        readout_noise=detector.readout_noise,
        object=scene,
        psfs=torch.cat(psfs),
        r0=None if turbulence is None else float(turbulence.r0),
        outer_scale=None if turbulence is None else float(turbulence.outer_scale),
        n_photons=float(scene.sum()),
    )


def _check(scene: Tensor, aperture: Aperture, grid: Grid, n_frames: int) -> None:
    if tuple(scene.shape) != grid.shape:
        raise ValueError(f"scene has shape {tuple(scene.shape)}: the grid needs {grid.shape}")
    if not scene.is_floating_point():
        raise ValueError(f"scene has dtype {scene.dtype}: it must be floating point, in electrons per frame")
    if not bool(torch.isfinite(scene).all()):
        raise ValueError("scene holds values that are not finite")
    if float(scene.min()) < 0:
        raise ValueError(f"scene holds negative light ({float(scene.min()):.3g} electrons): clip it at 0")
    if float(scene.sum()) == 0:
        raise ValueError("scene is black: scale it so that its sum is the number of photons per frame")
    if aperture.centers.ndim != 2:
        raise ValueError(f"aperture is a population {tuple(aperture.centers.shape[:-2])}: simulate one at a time")
    if n_frames != int(n_frames) or n_frames < 1:
        raise ValueError(f"n_frames is {n_frames}: it must be a whole number of at least 1")


def _centre(psfs: Tensor, shape: tuple[int, int]) -> Tensor:
    """Crop PSFs with their origin at [0, 0] to `shape`, the origin at its middle."""
    middle = (shape[0] // 2, shape[1] // 2)
    return psfs.roll(middle, dims=(-2, -1))[..., : shape[0], : shape[1]].clone()

"""Simulated stacks as a torch Dataset, for those who train networks on them."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from torchmask.atmosphere.phase import TurbulencePhase
from torchmask.grid import Grid
from torchmask.optics.aperture import Aperture
from torchmask.optics.detector import Detector
from torchmask.simulation.exposures import simulate_observation
from torchmask.simulation.render import load_mesh, render_mesh
from torchmask.simulation.satellite import satellite_mesh

Range = tuple[float, float]
"""Lowest and highest value; twice the same to hold it fixed."""


@dataclass(frozen=True)
class StackRanges:
    """What differs from stack to stack, and how far: each value is drawn between the two that are given.

    Angles are uniform, the rest log-uniform. Raises ValueError for a range that is not finite, turned round, or out of
    bounds.

    Examples
    --------
    >>> StackRanges(n_photons=(1e6, 1e6)).r0  # one flux, turbulence as by default
    (0.1, 0.25)
    """

    attitude: tuple[Range, Range, Range] = ((-180.0, 180.0), (-180.0, 180.0), (-180.0, 180.0))
    """Turns of the target about the axes to the right, up and towards the viewer [degrees]."""
    sun_angle: Range = (10.0, 70.0)
    """Angle between the sun and the viewer as the target sees them, in [0, 180]; on all sides alike [degrees]."""
    n_photons: Range = (1e6, 1e8)
    """Electrons per frame, before light leaves the field."""
    r0: Range = (0.1, 0.25)
    """Fried parameter at the imaging wavelength [m]."""

    def __post_init__(self) -> None:
        bounds = {"sun_angle": (0.0, 180.0), "attitude": (-math.inf, math.inf)}
        for field in fields(self):
            lowest, highest = bounds.get(field.name, (np.nextafter(0.0, 1.0), math.inf))
            value = getattr(self, field.name)
            for low, high in value if field.name == "attitude" else [value]:
                if not (math.isfinite(low) and math.isfinite(high) and lowest <= low <= high <= highest):
                    raise ValueError(
                        f"{field.name} is {value}: a range is (lowest, highest), both finite"
                        + (", within 0 to 180 degrees" if field.name == "sun_angle" else "")
                        + (", above 0" if field.name in ("n_photons", "r0") else "")
                    )


class StackDataset(Dataset[dict[str, Tensor]]):
    """Stacks of short exposures of a target in random poses, sunlight, flux and turbulence, with the truth.

    Stack i is drawn when it is asked for, from `seed` and i alone: the same whichever worker draws it, in whatever
    order.

    Parameters
    ----------
    aperture : Aperture
        One aperture; a mask that trains on does not change the stacks.
    grid : Grid
        Of the frames.
    length : int
        Number of stacks.
    n_frames : int
        Exposures in a stack, T.
    ranges : StackRanges, optional
    path : str or Path, optional
        A mesh (.obj, .stl, .ply, .glb ...); without one, the packaged satellite.
    size : float
        Larger side of the target's outline as a fraction of the field.
    outer_scale : float
        Of the turbulence [m].
    readout_noise : float
        Electrons rms per pixel and frame.
    seed : int
    dtype : torch.dtype
        Of the simulation and of what it gives.

    Raises
    ------
    ValueError
        For a length or number of frames below 1, a negative seed, a mesh file that is missing or damaged, and whatever
        `simulate_observation` refuses; all when it is made, which takes as long as one stack.

    Notes
    -----
    An item is a dict, as the default collate of a DataLoader batches it, of tensors on the CPU:

    frames : (T, H, W) [electrons]
    object : (H, W) the truth, expected electrons per pixel and frame before any blur
    psfs : (T, H, W) centred on pixel [H // 2, W // 2], cropped to the field
    n_photons, r0 : () of this stack [electrons per frame], [m]
    attitude, sun : (3,) [degrees]; unit vector, right, up and towards the viewer

    With the start method "spawn", or "forkserver", a script needs the usual `if __name__ == "__main__"`. For several
    targets, use `torch.utils.data.ConcatDataset`.

    Examples
    --------
    >>> from torch.utils.data import DataLoader
    >>> from torchmask.optics.aperture import SparseAperture
    >>> mask = SparseAperture.from_catalog("golay6", mask_diameter=1.0, fill_factor=0.15)
    >>> stacks = StackDataset(mask, Grid.nyquist(1.0, 550e-9, 32), length=100, n_frames=4)
    >>> batch = next(iter(DataLoader(stacks, batch_size=2)))
    >>> batch["frames"].shape, batch["object"].shape
    (torch.Size([2, 4, 32, 32]), torch.Size([2, 32, 32]))
    """

    def __init__(
        self,
        aperture: Aperture,
        grid: Grid,
        length: int,
        n_frames: int = 8,
        ranges: StackRanges | None = None,
        *,
        path: str | Path | None = None,
        size: float = 0.7,
        outer_scale: float = 20.0,
        readout_noise: float = 1.5,
        seed: int = 0,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        if length != int(length) or length < 1:
            raise ValueError(f"length is {length}: it must be a whole number of at least 1")
        if seed != int(seed) or seed < 0:
            raise ValueError(f"seed is {seed}: it must be a whole number of at least 0")
        self.aperture: Aperture = copy.deepcopy(aperture).requires_grad_(False).to("cpu", dtype)
        self.grid = grid
        self.length: int = int(length)
        self.n_frames = n_frames
        self.ranges: StackRanges = ranges or StackRanges()
        self.size = size
        self.outer_scale = outer_scale
        self.detector: Detector = Detector(readout_noise)
        self.seed: int = int(seed)
        self.dtype = dtype
        self._mesh = satellite_mesh() if path is None else load_mesh(path)
        self[0]  # refuses what cannot be simulated now rather than in a worker

    def __len__(self) -> int:
        return self.length

    def __getitem__(self, index: int) -> dict[str, Tensor]:
        if not 0 <= index < self.length:
            raise IndexError(f"there is no stack {index}: there are {self.length}, from 0")
        random = np.random.default_rng([self.seed, index])
        attitude = [random.uniform(*turn) for turn in self.ranges.attitude]
        sun = _direction(math.radians(random.uniform(*self.ranges.sun_angle)), random.uniform(0, 2 * math.pi))
        n_photons, r0 = (_log_uniform(random, bounds) for bounds in (self.ranges.n_photons, self.ranges.r0))
        image = render_mesh(self._mesh, self.grid.shape, attitude=attitude, sun=sun, size=self.size, device="cpu")
        observation = simulate_observation(
            (image * (n_photons / image.sum())).to(self.dtype),
            self.aperture,
            self.grid,
            TurbulencePhase(r0, self.outer_scale),
            self.detector,
            self.n_frames,
            torch.Generator().manual_seed(int(random.integers(2**62))),
        )
        assert observation.object is not None
        assert observation.psfs is not None
        conditions = {"n_photons": n_photons, "r0": r0, "attitude": attitude, "sun": sun}
        arrays = {"frames": observation.frames, "object": observation.object, "psfs": observation.psfs}
        like = {"dtype": self.dtype, "device": "cpu"}
        return arrays | {name: torch.tensor(value, **like) for name, value in conditions.items()}


def _direction(polar: float, azimuth: float) -> tuple[float, float, float]:
    """Unit vector at an angle `polar` from the viewer."""
    return math.sin(polar) * math.cos(azimuth), math.sin(polar) * math.sin(azimuth), math.cos(polar)


def _log_uniform(random: np.random.Generator, bounds: Range) -> float:
    return math.exp(random.uniform(math.log(bounds[0]), math.log(bounds[1])))

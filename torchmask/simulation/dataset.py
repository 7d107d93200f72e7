"""Simulated stacks as a torch Dataset, for those who train networks on them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from torchmask.atmosphere.phase import TurbulencePhase
from torchmask.grid import Grid
from torchmask.optics.aperture import Aperture
from torchmask.optics.detector import Detector
from torchmask.simulation.exposures import simulate_observation
from torchmask.simulation.render import Mesh, load_mesh, render_mesh
from torchmask.simulation.satellite import satellite_mesh

Range = tuple[float, float]
"""Lowest and highest value; twice the same to hold it fixed."""

Scene = Callable[[int, torch.Generator], Tensor]
"""Gives the target of a stack, (H, W), from the stack's index and a generator that is seeded for it alone."""


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
    """Stacks of short exposures of random targets in random flux and turbulence, with the truth.

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
    scene : callable, optional
        Targets of your own: `scene(index, generator)` gives what stack `index` shows, a tensor (H, W) on the grid's
        pixels, at least 0 and of any brightness. An archive of images takes the index; chance comes from the
        generator, never from elsewhere, so that a stack stays the same in every worker. Without it, a mesh in random
        poses and sunlight.
    path : str or Path, optional
        The mesh (.obj, .stl, .ply, .glb ...); without one, the packaged satellite.
    size : float
        Larger side of the mesh's outline as a fraction of the field.
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
        For a length or number of frames below 1, a negative seed, a mesh file that is missing or damaged or beside a
        `scene`, a black scene, and whatever `simulate_observation` refuses; for stack 0 when it is made, which takes
        as long as one stack.
    TypeError
        If `scene` is not callable or gives something other than a tensor.

    Notes
    -----
    An item is a dict, as the default collate of a DataLoader batches it, of tensors on the CPU:

    frames : (T, H, W) [electrons]
    object : (H, W) the truth, expected electrons per pixel and frame before any blur
    psfs : (T, H, W) centred on pixel [H // 2, W // 2], cropped to the field
    n_photons, r0 : () of this stack [electrons per frame], [m]
    attitude, sun : (3,) of the mesh [degrees]; unit vector, right, up and towards the viewer

    With the start method "spawn", or "forkserver", a script needs the usual `if __name__ == "__main__"`, and `scene`
    must be a function of a module or another object that can be pickled. For several meshes, use
    `torch.utils.data.ConcatDataset`.

    Examples
    --------
    >>> from torch.utils.data import DataLoader
    >>> from torchmask.optics.aperture import SparseAperture
    >>> mask = SparseAperture.from_catalog("golay6", mask_diameter=1.0, fill_factor=0.15)
    >>> stacks = StackDataset(mask, Grid.nyquist(1.0, 550e-9, 32), length=100, n_frames=4)
    >>> batch = next(iter(DataLoader(stacks, batch_size=2)))
    >>> batch["frames"].shape, batch["object"].shape
    (torch.Size([2, 4, 32, 32]), torch.Size([2, 32, 32]))

    Own scenes, here three stars:

    >>> def stars(index, generator):
    ...     image = torch.zeros(32, 32)
    ...     image.view(-1)[torch.randint(32 * 32, (3,), generator=generator)] = 1.0
    ...     return image
    >>> stacks = StackDataset(mask, Grid.nyquist(1.0, 550e-9, 32), length=100, n_frames=4, scene=stars)
    >>> int((stacks[7]["object"] > 0).sum())
    3
    """

    def __init__(
        self,
        aperture: Aperture,
        grid: Grid,
        length: int,
        n_frames: int = 8,
        ranges: StackRanges | None = None,
        *,
        scene: Scene | None = None,
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
        if scene is not None and not callable(scene):
            raise TypeError(f"scene is a {type(scene).__name__}: it must be a function of an index and a generator")
        if scene is not None and path is not None:
            raise ValueError("scene and path are two targets: give one of them")
        self.aperture: Aperture = aperture.still().to("cpu", dtype)
        self.grid = grid
        self.length: int = int(length)
        self.n_frames = n_frames
        self.ranges: StackRanges = ranges or StackRanges()
        self.size = size
        self.outer_scale = outer_scale
        self.detector: Detector = Detector(readout_noise)
        self.seed: int = int(seed)
        self.dtype = dtype
        self.scene = scene
        self._mesh = None if scene is not None else satellite_mesh() if path is None else load_mesh(path)
        self[0]  # refuses what cannot be simulated now rather than in a worker

    def __len__(self) -> int:
        return self.length

    def __getitem__(self, index: int) -> dict[str, Tensor]:
        if not 0 <= index < self.length:
            raise IndexError(f"there is no stack {index}: there are {self.length}, from 0")
        random = np.random.default_rng([self.seed, index])
        image, pose = self._own(index, random) if self._mesh is None else self._posed(self._mesh, random)
        n_photons, r0 = (_log_uniform(random, bounds) for bounds in (self.ranges.n_photons, self.ranges.r0))
        observation = simulate_observation(
            (image * (n_photons / image.sum())).to(self.dtype),
            self.aperture,
            self.grid,
            TurbulencePhase(r0, self.outer_scale),
            self.detector,
            self.n_frames,
            _seeded(random),
        )
        assert observation.object is not None
        assert observation.psfs is not None
        arrays = {"frames": observation.frames, "object": observation.object, "psfs": observation.psfs}
        conditions = {"n_photons": n_photons, "r0": r0} | pose
        like = {"dtype": self.dtype, "device": "cpu"}
        return arrays | {name: torch.tensor(value, **like) for name, value in conditions.items()}

    def _posed(self, mesh: Mesh, random: np.random.Generator) -> tuple[Tensor, dict[str, Any]]:
        """The mesh as it is seen this time, and how it is turned and lit."""
        attitude = [random.uniform(*turn) for turn in self.ranges.attitude]
        sun = _direction(math.radians(random.uniform(*self.ranges.sun_angle)), random.uniform(0, 2 * math.pi))
        image = render_mesh(mesh, self.grid.shape, attitude=attitude, sun=sun, size=self.size, device="cpu")
        return image, {"attitude": attitude, "sun": sun}

    def _own(self, index: int, random: np.random.Generator) -> tuple[Tensor, dict[str, Any]]:
        """What the caller's scene gives, checked as far as its brightness is concerned."""
        assert self.scene is not None
        image = self.scene(index, _seeded(random))
        if not isinstance(image, Tensor):
            raise TypeError(f"scene({index}, generator) gave a {type(image).__name__}: it must give a tensor (H, W)")
        light = float(image.sum())
        if not light > 0:
            raise ValueError(f"scene({index}, generator) gave {light:.3g} as its light: it must be positive")
        return image.detach().to("cpu", torch.float64), {}


def _seeded(random: np.random.Generator) -> torch.Generator:
    return torch.Generator().manual_seed(int(random.integers(2**62)))


def _direction(polar: float, azimuth: float) -> tuple[float, float, float]:
    """Unit vector at an angle `polar` from the viewer."""
    return math.sin(polar) * math.cos(azimuth), math.sin(polar) * math.sin(azimuth), math.cos(polar)


def _log_uniform(random: np.random.Generator, bounds: Range) -> float:
    return math.exp(random.uniform(math.log(bounds[0]), math.log(bounds[1])))

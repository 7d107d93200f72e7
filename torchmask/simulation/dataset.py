"""Simulated stacks as a torch Dataset, to train networks on."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, SupportsIndex

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from torchmask.atmosphere.phase import TurbulencePhase
from torchmask.grid import Grid
from torchmask.numbers import whole_number
from torchmask.optics.aperture import Aperture
from torchmask.optics.detector import Detector
from torchmask.simulation.exposures import require_instruments, simulate_observation
from torchmask.simulation.render import Mesh, load_mesh, render_mesh
from torchmask.simulation.satellite import satellite_mesh

Range = tuple[float, float]
"""Lowest and highest value; give the same one twice for a constant."""

Scene = Callable[[int, torch.Generator], Tensor]
"""Function that returns the target of a stack, (H, W), for the stack's index and a generator seeded for that stack."""


@dataclass(frozen=True)
class StackRanges:
    """Ranges of the quantities that are drawn at random for each stack.

    Angles are drawn uniformly, other quantities log-uniformly. Raises ValueError for a range that is no pair of
    numbers, not finite, in descending order, or out of bounds.

    Examples
    --------
    >>> StackRanges(n_photons=(1e6, 1e6)).r0  # constant flux, default turbulence
    (0.1, 0.25)
    """

    attitude: tuple[Range, Range, Range] = ((-180.0, 180.0), (-180.0, 180.0), (-180.0, 180.0))
    """Rotation of the target about the axes right, up and towards the viewer [degrees]."""
    sun_angle: Range = (10.0, 70.0)
    """Angle at the target between the sun and the viewer, in [0, 180]; its azimuth is uniform [degrees]."""
    n_photons: Range = (1e6, 1e8)
    """Electrons per frame, including those that fall outside the field."""
    r0: Range = (0.1, 0.25)
    """Fried parameter at the imaging wavelength [m]."""

    def __post_init__(self) -> None:
        bounds = {"sun_angle": (0.0, 180.0), "attitude": (-math.inf, math.inf)}
        for field in fields(self):
            lowest, highest = bounds.get(field.name, (np.nextafter(0.0, 1.0), math.inf))
            value = getattr(self, field.name)
            for low, high in _pairs(field.name, value):
                if not (math.isfinite(low) and math.isfinite(high) and lowest <= low <= high <= highest):
                    raise ValueError(
                        f"{field.name} is {value}: a range is (lowest, highest), both finite"
                        + (", within 0 to 180 degrees" if field.name == "sun_angle" else "")
                        + (", above 0" if field.name in ("n_photons", "r0") else "")
                    )


def _pairs(name: str, value: Any) -> list[list[float]]:
    """Return the range, or the three of an attitude, as (lowest, highest); raises ValueError for anything else."""
    wanted, needed = (2,), "it must be a range (lowest, highest), the same number twice for a constant"
    if name == "attitude":
        wanted, needed = (3, 2), "it must be three ranges (lowest, highest), about the axes right, up and to the viewer"
    try:
        numbers = np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        numbers = np.empty(0)
    if numbers.shape != wanted:
        raise ValueError(f"{name} is {value!r}: {needed}")
    return numbers.reshape(-1, 2).tolist()


class StackDataset(Dataset[dict[str, Tensor]]):
    """Stacks of short exposures of random targets in random flux and turbulence, with the truth.

    Stack i is drawn on demand and depends only on `seed` and i, whichever worker draws it and in whatever order.

    Parameters
    ----------
    aperture : Aperture
        Aperture of the telescope, of which a copy is taken: training a mask does not change the stacks.
    grid : Grid
        Pixels and wavelength of the frames.
    length : int
        Number of stacks.
    n_frames : int
        Number of exposures in a stack, T.
    ranges : StackRanges, optional
        Ranges of attitude, sunlight, flux and turbulence.
    scene : callable, optional
        Your own targets: `scene(index, generator)` returns the target of stack `index`, a tensor (H, W) on the grid's
        pixels that is at least 0 and of any brightness. Use the index to read from an archive of images, and draw
        random numbers only from the generator, so that every worker gets the same stack. By default the target is a
        mesh in random attitude and sunlight.
    path : str or Path, optional
        File of the mesh (.obj, .stl, .ply, .glb ...); the packaged satellite by default.
    size : float
        Larger side of the mesh's outline as a fraction of the field.
    outer_scale : float
        Outer scale of the turbulence [m].
    readout_noise : float
        Read-out noise [electrons rms per pixel and frame].
    seed : int
        Seed of all stacks, at least 0.
    dtype : torch.dtype
        Type of the simulation and of the tensors it returns.
    allow_overlap : bool
        Whether holes of the mask may overlap, as of `simulate_observation`.

    Raises
    ------
    ValueError
        If the length or the number of frames is below 1, the seed is negative, the mesh file is missing or damaged,
        both `path` and `scene` are given, a scene is black, or `simulate_observation` refuses an argument. Stack 0 is
        drawn at once as a check, which takes as long as drawing any one stack.
    TypeError
        If `aperture`, `grid` or `ranges` are of another type than they must be, `dtype` is neither float32 nor float64,
        or `scene` is not callable or returns something other than a tensor.

    Notes
    -----
    An item is a dict of tensors on the CPU, which the default collate function of a DataLoader can batch:

    frames : (T, H, W) [electrons]
    object : (H, W) the truth, expected electrons per pixel and frame before any blur
    psfs : (T, H, W) centred on pixel [H // 2, W // 2], cropped to the field
    n_photons : () flux [electrons per frame]
    r0 : () Fried parameter [m]
    attitude : (3,) rotation of the mesh [degrees], only without `scene`
    sun : (3,) unit vector towards the sun (right, up, towards the viewer), only without `scene`

    With the start methods "spawn" and "forkserver", a script needs the usual `if __name__ == "__main__"`, and `scene`
    must be picklable, such as a function of a module. For several meshes, use `torch.utils.data.ConcatDataset`.

    Examples
    --------
    >>> from torch.utils.data import DataLoader
    >>> from torchmask.optics.aperture import SparseAperture
    >>> mask = SparseAperture.from_catalog("golay6", mask_diameter=1.0, fill_factor=0.15)
    >>> stacks = StackDataset(mask, Grid.nyquist(1.0, 550e-9, 32), length=100, n_frames=4)
    >>> batch = next(iter(DataLoader(stacks, batch_size=2)))
    >>> batch["frames"].shape, batch["object"].shape
    (torch.Size([2, 4, 32, 32]), torch.Size([2, 32, 32]))

    With your own scenes, here three stars:

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
        allow_overlap: bool = False,
    ) -> None:
        if scene is not None and not callable(scene):
            raise TypeError(f"scene is a {type(scene).__name__}: it must be a function of an index and a generator")
        if not isinstance(ranges, StackRanges | None):
            raise TypeError(
                f"ranges is a {type(ranges).__name__}: it must be StackRanges, such as StackRanges(r0=(0.1, 0.2))"
            )
        if dtype not in (torch.float32, torch.float64):
            raise TypeError(f"dtype is {dtype}: torch.float32 or torch.float64 is needed")
        if scene is not None and path is not None:
            raise ValueError("both scene and path are given: give only one of them")
        self.detector: Detector = Detector(readout_noise)
        require_instruments(aperture, grid, self.detector)
        self.aperture: Aperture = aperture.still().to("cpu", dtype)
        self.grid = grid
        self.length: int = whole_number("length", length)
        self.n_frames: int = whole_number("n_frames", n_frames)
        self.ranges: StackRanges = ranges or StackRanges()
        self.size = size
        self.outer_scale = outer_scale
        self.seed: int = whole_number("seed", seed, least=0)
        self.dtype = dtype
        self.allow_overlap = allow_overlap
        self.scene = scene
        self._mesh = None if scene is not None else satellite_mesh() if path is None else load_mesh(path)
        self[0]  # raises errors here rather than in a worker

    def __len__(self) -> int:
        return self.length

    def __getitem__(self, index: SupportsIndex) -> dict[str, Tensor]:
        index = _one_index(index)
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
            allow_overlap=self.allow_overlap,
        )
        assert observation.object is not None
        assert observation.psfs is not None
        arrays = {"frames": observation.frames, "object": observation.object, "psfs": observation.psfs}
        conditions = {"n_photons": n_photons, "r0": r0} | pose
        like = {"dtype": self.dtype, "device": "cpu"}
        return arrays | {name: torch.tensor(value, **like) for name, value in conditions.items()}

    def _posed(self, mesh: Mesh, random: np.random.Generator) -> tuple[Tensor, dict[str, Any]]:
        """Render the mesh in a random attitude and sunlight, and return the image and both."""
        attitude = [random.uniform(*turn) for turn in self.ranges.attitude]
        sun = _direction(math.radians(random.uniform(*self.ranges.sun_angle)), random.uniform(0, 2 * math.pi))
        image = render_mesh(mesh, self.grid.shape, attitude=attitude, sun=sun, size=self.size, device="cpu")
        return image, {"attitude": attitude, "sun": sun}

    def _own(self, index: int, random: np.random.Generator) -> tuple[Tensor, dict[str, Any]]:
        """Return the image of the caller's scene, after checking its type and its brightness."""
        assert self.scene is not None
        image = self.scene(index, _seeded(random))
        if not isinstance(image, Tensor):
            raise TypeError(f"scene({index}, generator) gave a {type(image).__name__}: it must return a tensor (H, W)")
        light = float(image.sum())
        if not light > 0:
            raise ValueError(f"scene({index}, generator) gave an image with a sum of {light:.3g}: it must be positive")
        return image.detach().to("cpu", torch.float64), {}


def _one_index(index: SupportsIndex) -> int:
    """Return the index of one stack, which may be a whole number of NumPy or torch; raises TypeError otherwise."""
    if not isinstance(index, bool):
        try:
            return operator.index(index)
        except TypeError:
            pass
    raise TypeError(
        f"the index of a stack is {index!r}: it must be one whole number; torch.utils.data.Subset(stacks, indices) "
        "holds several"
    )


def _seeded(random: np.random.Generator) -> torch.Generator:
    return torch.Generator().manual_seed(int(random.integers(2**62)))


def _direction(polar: float, azimuth: float) -> tuple[float, float, float]:
    """Return the unit vector at an angle `polar` from the direction to the viewer."""
    return math.sin(polar) * math.cos(azimuth), math.sin(polar) * math.sin(azimuth), math.cos(polar)


def _log_uniform(random: np.random.Generator, bounds: Range) -> float:
    return math.exp(random.uniform(math.log(bounds[0]), math.log(bounds[1])))

"""What several files of tests stand on: reference data beside a checkout, seeds, a mask, a satellite, a binary."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from torchmask.atmosphere.phase import TurbulencePhase
from torchmask.grid import Grid
from torchmask.observation import Observation
from torchmask.optics.aperture import Aperture, SparseAperture
from torchmask.optics.detector import Detector
from torchmask.optics.psf import psf_from_samples
from torchmask.optics.zernike import ZernikePhase
from torchmask.simulation.exposures import simulate_observation
from torchmask.simulation.scene import SceneOptions, make_scene


@pytest.fixture(scope="session")
def shared() -> Path:
    """Folder of the reference data; a test that asks for it is skipped where there is none."""
    folder = Path(__file__).parents[2] / "shared"
    if not folder.is_dir():
        pytest.skip("the reference data lie beside a checkout only")
    return folder


@pytest.fixture(scope="session")
def shared_stack(shared: Path) -> Callable[[str], Observation]:
    """Reads exposures that another program has simulated, by name: skylab_1e7_mask, mgs_1e6_full and others."""
    return lambda name: Observation.load(shared / "stacks" / f"{name}.npz")


@pytest.fixture(scope="session")
def mask_facts(shared: Path) -> dict[str, Any]:
    """What the catalogue was made from, by mask."""
    return json.loads((shared / "masks.json").read_text())["masks"]


@pytest.fixture(scope="session")
def niriss(shared: Path) -> Path:
    """Folder of real exposures, ab-dor_*.fits and hd-37093_*.fits."""
    return shared / "real" / "niriss"


@pytest.fixture(scope="session")
def seeded() -> Callable[[int], torch.Generator]:
    """A fresh generator from a seed."""
    return lambda seed: torch.Generator().manual_seed(seed)


@pytest.fixture
def golay6() -> SparseAperture:
    """Six discs in 1 m, of the reference case's collecting area, one per test."""
    return SparseAperture.from_catalog("golay6", 1.0, 0.15)


@pytest.fixture(scope="session")
def observe_satellite() -> Callable[..., Observation]:
    """Draws exposures of the packaged satellite, half the field wide, with read-out noise of 1.5 electrons."""

    def observe(
        aperture: Aperture,
        grid: Grid,
        *,
        n_photons: float = 1e7,
        d_over_r0: float = 7.0,
        n_frames: int = 10,
        seed: int = 0,
    ) -> Observation:
        scene = make_scene(grid.shape, n_photons, SceneOptions(size=0.5))
        turbulence = TurbulencePhase(1 / d_over_r0, 20.0)
        generator = torch.Generator().manual_seed(seed)
        return simulate_observation(scene, aperture, grid, turbulence, Detector(1.5), n_frames, generator)

    return observe


@pytest.fixture(scope="session")
def sky_matrix() -> Callable[[float, float], np.ndarray]:
    """(2, 2) from pixels (x, y) to (east, north) [rad]: north `angle` [deg] from y, east to the left of it."""

    def matrix(angle: float, pixel_scale: float) -> np.ndarray:
        c, s = math.cos(math.radians(angle)), math.sin(math.radians(angle))
        return pixel_scale * np.array([[-c, s], [s, c]])

    return matrix


@pytest.fixture(scope="session")
def static_aberrations() -> Tensor:
    """Those that `expose_binary` puts into every exposure (7, 6) [rad rms]."""
    return 0.06 * torch.randn(7, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(0))


@pytest.fixture(scope="session")
def expose_binary(static_aberrations: Tensor) -> Callable[..., tuple[Tensor, Tensor]]:
    """Electrons and their rms of one exposure of a binary through seven holes.

    From a pupil twice as fine and an image twice as wide as those of `CompanionModel`: companion (contrast, east,
    north), star at `place` (y, x); static aberrations, and small ones of its own; the pixel's square, Poisson and
    read-out noise.
    """

    def expose(
        aperture: Aperture,
        grid: Grid,
        sky: np.ndarray,
        companion: np.ndarray,
        place: tuple[float, float],
        wavelengths: Sequence[float],
        seed: int,
    ) -> tuple[Tensor, Tensor]:
        n_pixels, own = grid.shape[0], torch.Generator().manual_seed(seed)
        change = 0.005 * torch.randn(7, 6, dtype=torch.float64, generator=own)
        total = torch.zeros(())
        for wavelength in wavelengths:
            coloured = Grid(n_pixels, grid.pixel_scale, wavelength)
            coefficients = (static_aberrations + change) * grid.wavelength / wavelength
            phase = ZernikePhase(aperture, coloured, 6, oversampling=4)(coefficients)
            total = total + psf_from_samples(aperture.samples(coloured, 4), phase) / len(wavelengths)
        nu_y, nu_x = (torch.fft.fftfreq(n, dtype=torch.float64) for n in total.shape)
        x, y = np.linalg.inv(sky) @ companion[1:]

        def at(row: float, column: float) -> Tensor:
            return torch.exp(-2j * math.pi * (nu_y[:, None] * row + nu_x * column))

        square = torch.sinc(nu_y)[:, None] * torch.sinc(nu_x)
        seen = at(*place) + companion[0] * at(place[0] + y, place[1] + x)
        image = 1e8 * torch.fft.ifft2(torch.fft.fft2(total) * square * seen).real[:n_pixels, :n_pixels]
        noise = (image.clamp(min=0) + 100**2).sqrt()
        return image + noise * torch.randn(image.shape, dtype=torch.float64, generator=own), noise

    return expose

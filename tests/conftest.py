"""What several files of tests stand on: reference data beside a checkout, seeds, a mask, exposures of the satellite."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from torchmask.atmosphere.phase import TurbulencePhase
from torchmask.grid import Grid
from torchmask.observation import Observation
from torchmask.optics.aperture import Aperture, SparseAperture
from torchmask.optics.detector import Detector
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

"""What several tests of the restoration stand on: small problems to take apart, and one whole restoration."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import pytest
import torch
from torch import Tensor

from torchmask.atmosphere.phase import TurbulencePhase
from torchmask.grid import Grid
from torchmask.observation import Observation
from torchmask.optics.aperture import Aperture, SparseAperture
from torchmask.optics.band import Band
from torchmask.optics.detector import Detector
from torchmask.restoration.aberrations import AberrationBasis, turbulent_basis
from torchmask.restoration.forward import ExposureModel
from torchmask.restoration.frames import FrameStack
from torchmask.restoration.myopic import MyopicDeconvolution
from torchmask.restoration.objective import MyopicObjective
from torchmask.restoration.result import RestorationResult
from torchmask.restoration.state import Calibration, State
from torchmask.restoration.traits import Refinement, Traits
from torchmask.restoration.variation import TotalVariation
from torchmask.simulation.exposures import simulate_observation

R0, OUTER_SCALE, READOUT = 0.25, 20.0, 1.5
N_MODES = 10  # so many that at this d/r0 what they leave out is below the noise


class Exposures(NamedTuple):
    """A model with an object, aberrations, frames and weights that have nothing to do with each other."""

    model: ExposureModel
    image: Tensor
    z: Tensor
    frames: Tensor
    precision: Tensor


@pytest.fixture(scope="session")
def random_exposures() -> Callable[..., Exposures]:
    def make(model: ExposureModel, n_frames: int = 3) -> Exposures:
        generator = torch.Generator().manual_seed(0)
        shape = (n_frames, *model.window.grid.shape)
        image = torch.rand(model.window.field.shape, dtype=torch.float64, generator=generator)
        z = 0.5 * torch.randn(n_frames, model.aberrations.n_parameters, dtype=torch.float64, generator=generator)
        frames = torch.rand(shape, dtype=torch.float64, generator=generator).to(model.dtype)
        precision = torch.rand(shape, dtype=torch.float64, generator=generator).to(model.dtype)
        return Exposures(model, image, z, frames, precision)

    return make


@pytest.fixture(scope="session")
def three_holes() -> SparseAperture:
    return SparseAperture([[0.0, 0.3], [0.3, -0.2], [-0.3, -0.15]], 0.36, 1.0)


@pytest.fixture(scope="session")
def five_holes() -> SparseAperture:
    """On a ring."""
    angles = torch.arange(5, dtype=torch.float64) * 2 * math.pi / 5
    return SparseAperture(torch.stack([angles.cos(), angles.sin()], -1) * 0.38, 0.22, 1.0)


@pytest.fixture(scope="session")
def five_hole_basis(five_holes) -> AberrationBasis:
    """Piston, tip and tilt of every hole, white under turbulence.

    On a ring modes come in pairs that are as strong, between which rounding chooses: a triangular factor is unique, so
    that the same numbers draw the same aberrations on every processor. The last piston follows from the others, and
    has to be the last row for that.
    """
    return triangular(turbulent_basis(five_holes, 3, 0, R0, OUTER_SCALE))


def triangular(basis: AberrationBasis) -> AberrationBasis:
    """Return the basis of snapshots with the same covariance whose parameters no rounding turns into each other."""
    mixing, last = basis.mixing, len(basis.mixing) - basis.n_modes
    order = [*range(last), *range(last + 1, len(mixing)), last]
    factor = torch.linalg.qr(mixing[order].T).R
    root = (factor * factor.diagonal().sign()[:, None]).T
    return AberrationBasis(root[torch.tensor(order).argsort()], basis.n_modes)


@pytest.fixture(scope="session")
def explain(five_holes, five_hole_basis) -> Callable[..., tuple[MyopicObjective, State]]:
    """Makes noisy frames of a block, whose edges lie on the pixels, and the state that explains them."""

    def make(model: ExposureModel | None = None, n_frames: int = 4, noise: float = 0.03):
        grid = Grid.nyquist(1.0, 550e-9, 32, oversampling=1.2)
        model = model or ExposureModel(five_holes, grid, five_hole_basis)
        image = torch.zeros(model.window.field.shape, dtype=torch.float64)
        image[10:19, 8:16], image[13:16, 16:25] = 6.0, 3.0
        generator, basis = torch.Generator().manual_seed(2), model.aberrations
        z = torch.randn(n_frames, basis.n_parameters, dtype=torch.float64, generator=generator)
        z = basis.with_common_of(z, z[:1])
        frames = model(image, z)
        frames = frames + noise * torch.randn(frames.shape, dtype=torch.float64, generator=generator)
        precision = torch.full((1, 1, 1), noise**-2, dtype=torch.float64)
        ones = torch.ones(n_frames, dtype=torch.float64)
        return MyopicObjective(model, frames, precision, TotalVariation()), State(
            image, z, Calibration(ones, ones, 1.0)
        )

    return make


@pytest.fixture(scope="session")
def explained(explain) -> tuple[MyopicObjective, State]:
    """Four frames and the state that explains them."""
    return explain()


def satellite(shape: tuple[int, int], n_photons: float) -> Tensor:
    """A body with two panels of different brightness and a glint."""
    image = torch.zeros(shape, dtype=torch.float64)
    row, column = shape[0] // 2, shape[1] // 2
    image[row - 4 : row + 4, column - 3 : column + 3] = 3
    image[row - 1 : row + 2, column - 11 : column - 3] = 1
    image[row - 1 : row + 2, column + 3 : column + 10] = 1.5
    image[row + 2, column + 1] = 20
    return image * (n_photons / image.sum())


@pytest.fixture(scope="session")
def observe(five_holes) -> Callable[..., Observation]:
    """Simulates end to end: no part of the model that is inverted has a share in it."""

    def make(
        aperture: Aperture | None = None,
        n_frames: int = 8,
        n_photons: float = 1e6,
        seed: int = 1,
        shape: tuple[int, int] = (48, 48),
        r0: float = R0,
    ) -> Observation:
        return simulate_observation(
            satellite(shape, n_photons),
            aperture or five_holes,
            Grid.nyquist(1.0, 550e-9, shape),
            TurbulencePhase(r0, OUTER_SCALE),
            Detector(READOUT),
            n_frames,
            generator=torch.Generator().manual_seed(seed),
        )

    return make


@pytest.fixture(scope="session")
def observation(observe) -> Observation:
    """Eight exposures of a satellite through five holes."""
    return observe()


@pytest.fixture(scope="session")
def restoring(observation) -> Callable[..., MyopicDeconvolution]:
    """The method for `observation`, which knows turbulence and noise, and of no sky, unless told otherwise."""

    def make(n_modes: int = N_MODES, **options) -> MyopicDeconvolution:
        given = {
            "r0": R0,
            "outer_scale": OUTER_SCALE,
            "readout_noise": READOUT,
        } | options
        return MyopicDeconvolution(observation.aperture, observation.grid, n_modes, **given)

    return make


@pytest.fixture(scope="session")
def restored(observation, restoring) -> RestorationResult:
    """`observation`, restored by a method that knows the turbulence and the noise."""
    return restoring().restore(observation.frames)


@pytest.fixture(scope="session")
def in_band(five_holes) -> Callable[..., ExposureModel]:
    """Makes the model of exposures through the five holes in a band, of a third of the wavelength unless told."""
    grid = Grid.nyquist(1.0, 550e-9, 32, oversampling=1.5)
    return lambda basis, width=200e-9: ExposureModel(five_holes, grid, basis, Band.top_hat(600e-9, width, 5))


@pytest.fixture(scope="session")
def wide(in_band, five_hole_basis, explain) -> tuple[MyopicObjective, State]:
    """Frames in that wide band, and the state that explains them."""
    return explain(in_band(five_hole_basis))


@pytest.fixture(scope="session")
def off() -> Callable[[MyopicObjective, State, list], State]:
    """Moves pistons by waves of that band's mean wavelength, (T, N), or (N,) in all frames."""

    def move(objective: MyopicObjective, state: State, waves: list) -> State:
        pistons = 2 * math.pi * 600 / 550 * torch.tensor(waves, dtype=torch.float64)  # [rad] at the grid's wavelength
        return replace(state, z=state.z + objective.model.aberrations.parameters_of_pistons(pistons))

    return move


@pytest.fixture(scope="session")
def traits() -> Traits:
    """Of a mask in turbulence that is told, restored in one start or more."""
    return Traits(
        many_minima=False,
        estimated=False,
        prior_on_aberrations=True,
        r0_is_open=False,
        r0=R0,
        outer_scale=OUTER_SCALE,
        max_iterations=1000,
        tolerance=0.0,
        seed=0,
        refinement=Refinement.OFF,
    )


@pytest.fixture(scope="session")
def stack_of() -> Callable[[MyopicObjective], FrameStack]:
    """Makes a stack of an objective's frames, whose noise is 0.003 of their unit."""

    def make(objective: MyopicObjective) -> FrameStack:
        return FrameStack(objective.frames, torch.ones_like(objective.frames, dtype=torch.bool), 1.0, 0.003**2)

    return make

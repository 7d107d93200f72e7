"""Same seed, same numbers, and no hidden state. docs/conventions.md, "Randomness"."""

import numpy as np
import pytest
import torch

import torchmask as tm

GRID = tm.Grid.nyquist(diameter=1.0, wavelength=550e-9, n_pixels=32)
MASK = tm.SparseAperture([[0.0, 0.3], [0.3, -0.2], [-0.3, -0.2]], 0.2, 1.0)


def mask(generator):
    return tm.SparseAperture.random(5, 1.0, 0.1, generator).centers


def screens(generator):
    return tm.TurbulencePhase(0.2, 20.0)(MASK.samples(GRID), 2, generator)


def frames(generator):
    scene = tm.make_scene(GRID.shape, 1e5, dtype=torch.float64)
    return tm.simulate_observation(
        scene, MASK, GRID, tm.TurbulencePhase(0.2, 20.0), tm.Detector(1.0), 2, generator
    ).frames


def noise(generator):
    return tm.Detector(1.0)(torch.full((8, 8), 50.0), generator)


@pytest.mark.parametrize("draw", [mask, screens, frames, noise])
def test_a_generator_decides_everything(seeded, draw):
    state = torch.get_rng_state()
    first, again, other = draw(seeded(3)), draw(seeded(3)), draw(seeded(4))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    assert torch.equal(torch.get_rng_state(), state)  # with a generator, torch's global one is left alone


@pytest.mark.parametrize("method", ["hybrid", "cma"])
def test_a_search_has_a_seed_of_its_own(method):
    criterion = tm.AsymptoticMSE(GRID, tm.PowerLawPSD(1.5, 1e6), tm.NoisePSD(1e6), n_frames=10)
    state, numpy_state = torch.get_rng_state(), np.random.get_state()[1].copy()  # noqa: NPY002
    runs = [
        tm.search_mask(criterion, 4, 1.0, 0.1, method=method, seed=seed, budget=60, refine=False).aperture.centers
        for seed in (0, 0, 1)
    ]
    assert torch.equal(runs[0], runs[1])
    assert not torch.equal(runs[0], runs[2])
    assert torch.equal(torch.get_rng_state(), state)
    assert np.array_equal(np.random.get_state()[1], numpy_state)  # noqa: NPY002


def test_a_restoration_draws_no_chance(seeded):
    observed = frames(seeded(0))
    method = tm.MyopicDeconvolution(MASK, GRID, n_modes=3, max_iterations=4)
    first, again = (method.restore(observed).object for _ in range(2))
    assert torch.equal(first, again)

"""How often the verdict on a restoration is right: 20 stacks that fit, and stacks that no restoration can explain.

For each it prints chi-square over its degrees of freedom, what modes left out are expected to add, the verdict and the
number of starts, and at the end false alarms and misses. About 20 minutes on one core; `--quick` takes every fifth.
"""

from __future__ import annotations

import argparse
import dataclasses
import warnings

import torch

from torchmask.atmosphere.phase import TurbulencePhase
from torchmask.grid import Grid
from torchmask.metrics import relative_error
from torchmask.observation import Observation
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.detector import Detector
from torchmask.restoration.myopic import MyopicDeconvolution
from torchmask.simulation.conditions import Conditions
from torchmask.simulation.exposures import simulate_observation
from torchmask.simulation.scene import SceneOptions, make_scene

GRID = Grid.nyquist(1.0, 550e-9, 64)
READOUT = 1.5
# Holes, D/r0, photons, sky in mean pixels of the object.
GOOD = [
    *((5, 5, 1e6, 0.0), (5, 7, 1e7, 0.0), (7, 5, 1e7, 0.0), (7, 7, 1e6, 0.5), (7, 10, 1e6, 0.0)),
    *((9, 5, 1e5, 0.0), (9, 6, 1e6, 0.8), (9, 7, 1e7, 0.0), (9, 7, 1e6, 0.0), (9, 10, 1e7, 0.0)),
    *((11, 5, 1e6, 0.0), (11, 7, 1e5, 0.0), (11, 7, 1e7, 0.5), (11, 8, 1e6, 0.0), (11, 10, 1e7, 0.0)),
    *((15, 7, 1e6, 0.0), (15, 10, 1e7, 0.0), (20, 7, 1e6, 0.0), (20, 10, 1e6, 0.0), (6, 8, 1e7, 0.3)),
]
WRONG = ("another mask", "mirrored", "smaller holes", "columns shuffled", "frames turned", "noise")


def observe(number: int, n_holes: int, d_over_r0: float, photons: float, sky: float) -> Observation:
    """Ten exposures of the packaged satellite, at an attitude of its own."""
    generator = torch.Generator().manual_seed(5000 + number)
    mask = SparseAperture.random(n_holes, 1.0, 0.15, generator)
    scene = make_scene(GRID.shape, photons, SceneOptions(attitude=(25.0, -30.0, 37.0 * number), size=0.6))
    conditions = Conditions(sky=sky * photons / scene.numel())
    turbulence, detector = TurbulencePhase(1 / d_over_r0, 20.0), Detector(READOUT)
    return simulate_observation(scene, mask, GRID, turbulence, detector, 10, generator, conditions=conditions)


def spoil(observation: Observation, how: str) -> Observation:
    """Return the mask and the frames after an error that no restoration can explain."""
    mask, frames = observation.aperture, observation.frames
    assert isinstance(mask, SparseAperture)
    generator = torch.Generator().manual_seed(1)
    if how == "another mask":
        mask = SparseAperture.random(mask.n_subapertures, 1.0, 0.15, generator)
    elif how == "mirrored":
        mask = mask.replace(centers=mask.centers * mask.centers.new_tensor([-1.0, 1.0]))
    elif how == "smaller holes":
        mask = mask.replace(subaperture_diameter=0.7 * mask.subaperture_diameter)
    elif how == "columns shuffled":
        frames = frames[..., torch.randperm(frames.shape[-1], generator=generator)]
    elif how == "frames turned":
        frames = torch.stack([torch.rot90(frame, number % 4) for number, frame in enumerate(frames)])
    else:
        frames = 2 * frames.mean() * torch.rand(frames.shape, dtype=frames.dtype, generator=generator)
    return dataclasses.replace(observation, aperture=mask, frames=frames)


def explained(name: str, observation: Observation) -> bool:
    """Restore, print a line and return whether the verdict is good."""
    result = MyopicDeconvolution(observation.aperture, GRID, readout_noise=READOUT).restore(observation.frames)
    verdict, truth = result.verdict, observation.object
    assert verdict is not None
    assert truth is not None
    # Nothing but noise may be restored as an object without light.
    error = relative_error(result.object, truth, 0.5) if result.object.any() else 1.0
    print(
        f"{name:32s} chi-square {verdict.chi_square:8.3f}, expected {1 + verdict.model_error:6.3f}, passes "
        f"{verdict.limit:6.3f}: {verdict.finding.value}; score {error:.3f}, "
        f"{len(result.cost)} iterations, {result.seconds:.0f} s",
        flush=True,
    )
    return verdict.explained


def main() -> None:
    """Both lists, and the two counts."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="every fifth stack")
    step = 5 if parser.parse_args().quick else 1
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")  # a mirrored mask is warned of
    good = list(enumerate(GOOD))[::step]
    alarms = sum(
        not explained(f"{case[0]} holes, D/r0 {case[1]}, {case[2]:.0e}, sky {case[3]}", observe(number, *case))
        for number, case in good
    )
    wrong = [(how, photons) for how in WRONG for photons in (1e6, 1e7)][::step]
    missed = sum(explained(f"{how}, {n:.0e}", spoil(observe(100, 9, 6, n, 0.0), how)) for how, n in wrong)
    print(f"{alarms} false alarms in {len(good)}, {missed} missed in {len(wrong)}")


if __name__ == "__main__":
    main()

"""Throughput of `restore_many` on all cores against one stack after the other on one core, in one run.

Run: python benchmarks/many.py [--stacks 8] [--frames 10] [--iterations 300]
"""

from __future__ import annotations

import argparse
import time

import torch

from torchmask.atmosphere.phase import TurbulencePhase
from torchmask.grid import Grid
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.detector import Detector
from torchmask.restoration.many import restore_many
from torchmask.restoration.myopic import MyopicDeconvolution
from torchmask.simulation.exposures import simulate_observation
from torchmask.simulation.scene import SceneOptions, make_scene


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--stacks", type=int, default=8)
    parser.add_argument("--frames", type=int, default=10)
    parser.add_argument("--iterations", type=int, default=300)
    args = parser.parse_args()
    torch.set_num_threads(1)
    grid, mask = Grid.nyquist(1.0, 550e-9, 64), SparseAperture.from_catalog("golay9", 1.0, 0.15)
    scene = make_scene(grid.shape, 1e7, SceneOptions(size=0.5))
    turbulence, detector = TurbulencePhase(1 / 7, 20.0), Detector(1.5)
    stacks = [
        simulate_observation(
            scene, mask, grid, turbulence, detector, args.frames, torch.Generator().manual_seed(seed)
        ).frames
        for seed in range(args.stacks)
    ]
    method = MyopicDeconvolution(mask, grid, max_iterations=args.iterations)
    restore_many(method, stacks[:2])  # the processes are there from then on
    seconds = {}
    for n_workers in (None, 1):
        started = time.perf_counter()
        results = restore_many(method, stacks, n_workers=n_workers)
        seconds[n_workers] = time.perf_counter() - started
        assert all(not isinstance(result, Exception) for result in results)
    print(
        f"{args.stacks} stacks of {args.frames} x 64 x 64: {seconds[1]:.1f} s one after the other on one core, "
        f"{seconds[None]:.1f} s on all, ratio {seconds[1] / seconds[None]:.2f}"
    )


if __name__ == "__main__":
    main()

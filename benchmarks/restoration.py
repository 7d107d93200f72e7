"""Cost of one evaluation of the restoration's cost and gradient against the bare FFTs that it cannot avoid.

Beside it stands the time of the minimiser's own work for one iteration.

Those are two complex FFTs (pupil to image and back) and two real ones (PSF to OTF and back) for each frame, on the same
field, in the same chunks, in the same process. Run: python benchmarks/restoration.py [--device cuda] [--stack FILE]
With a stack, a whole default restoration is timed too, and scored where the stack holds the truth.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable

import torch

from torchmask.grid import Grid
from torchmask.memory import keep_freed_memory
from torchmask.metrics import relative_error
from torchmask.observation import Observation
from torchmask.optics.aperture import Aperture, FullAperture, SparseAperture
from torchmask.restoration.cuda_graphs import graphed
from torchmask.restoration.forward import ExposureModel, Window
from torchmask.restoration.myopic import MyopicDeconvolution
from torchmask.restoration.objective import MyopicObjective
from torchmask.restoration.projected_lbfgs import ProjectedLBFGS
from torchmask.restoration.variation import TotalVariation


def seconds(function: Callable[[], object], device: str, repeats: int) -> float:
    """The median time of one call."""
    times = []
    for _ in range(repeats + 2):
        if device != "cpu":
            torch.cuda.synchronize()
        started = time.perf_counter()
        function()
        if device != "cpu":
            torch.cuda.synchronize()
        times.append(time.perf_counter() - started)
    return sorted(times[2:])[repeats // 2]


def bare_ffts(model: ExposureModel, n_frames: int) -> Callable[[], None]:
    """Two complex and two real FFTs for every frame."""
    example = model.psf(torch.zeros(1, model.aberrations.n_parameters, dtype=model.dtype, device=model.device))
    parts = [part.stop - part.start for part in model.chunks(n_frames)]
    image = example.expand(max(parts), *example.shape[1:]).clone()
    pupil = torch.complex(image, image)
    half = torch.fft.rfft2(image)

    def run() -> None:
        for size in parts:
            torch.fft.fft2(pupil[:size])
            torch.fft.ifft2(pupil[:size])
            torch.fft.rfft2(image[:size])
            torch.fft.irfft2(half[:size], s=model.window.field.shape)

    return run


def own_work(n_pixels: int, n_others: int, args: argparse.Namespace) -> None:
    """Print the minimiser's own time for an iteration, which does not depend on the model's data type.

    That of a simple cost, and of the first iterations without all pairs, is included.
    """
    weights = torch.logspace(0, 3, n_pixels + n_others, dtype=torch.float64, device=args.device)
    target = torch.randn(len(weights), dtype=torch.float64, device=args.device)  # half of the pixels end at their bound
    lower = torch.full_like(target, -torch.inf)
    lower[:n_pixels] = 0
    done = []

    def cost(x: torch.Tensor) -> tuple[float, torch.Tensor]:
        slope = weights * (x - target)
        return float(slope @ (x - target)) / 2, slope

    def descend() -> None:
        done.append(ProjectedLBFGS()(cost, torch.zeros_like(target), lower, max_iterations=100).n_iterations)

    time_of_all = seconds(descend, args.device, 5)
    print(f"minimiser, {n_pixels} pixels and {n_others} others   {1e3 * time_of_all / done[0]:5.2f} ms an iteration")


def compare(name: str, aperture: Aperture, n_modes: int, n_pixels: int, dtype: torch.dtype, args: argparse.Namespace):
    """Print one row of the table."""
    n_frames = args.frames
    model = ExposureModel(
        aperture.to(args.device), Grid.nyquist(1.0, 550e-9, n_pixels), n_modes, dtype=dtype, device=args.device
    )
    image = torch.rand(model.window.field.shape, dtype=torch.float64, device=args.device)
    z = torch.randn(n_frames, model.aberrations.n_parameters, dtype=torch.float64, device=args.device)
    frames = torch.rand(n_frames, n_pixels, n_pixels, dtype=dtype, device=args.device)
    precision = torch.ones(1, 1, 1, dtype=dtype, device=args.device)

    objective = MyopicObjective(model, frames, precision, TotalVariation())
    evaluator = objective.evaluator(objective.neutral_calibration())
    as_in_a_descent = graphed(lambda *given: evaluator(*given)[:3], image.device)

    def evaluate() -> None:
        as_in_a_descent(image, z)

    ours = seconds(evaluate, args.device, args.repeats)
    bare = seconds(bare_ffts(model, n_frames), args.device, args.repeats)
    print(
        f"{name:5s} {n_modes:4d} modes {n_frames:3d} x {n_pixels:3d}^2 on {model.window.field.shape[0]}^2 "
        f"{str(dtype)[6:]:8s} bare {1e3 * bare:7.2f} ms   cost and gradient {1e3 * ours:7.2f} ms   "
        f"ratio {ours / bare:5.2f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--frames", type=int, default=20)
    parser.add_argument("--repeats", type=int, default=21)
    parser.add_argument("--stack", help="an .npz file that Observation.load reads")
    args = parser.parse_args()
    angle = torch.arange(11, dtype=torch.float64) * 2 * math.pi / 11
    mask = SparseAperture(torch.stack([angle.cos(), angle.sin()], -1) * 0.44, 0.117, 1.0)
    keep_freed_memory()  # as a restoration does
    print(f"torch {torch.__version__}, {args.device}, {torch.get_num_threads()} threads")
    for n_pixels in (128, 256):
        for dtype in (torch.float64, torch.float32):
            compare("mask", mask, 6, n_pixels, dtype, args)
            compare("full", FullAperture(1.0), 231, n_pixels, dtype, args)
        n_field = math.prod(Window.around(Grid.nyquist(1.0, 550e-9, n_pixels)).field.shape)
        own_work(n_field, args.frames * (66 - 1), args)
    if args.stack:
        stack = Observation.load(args.stack)
        for dtype in (torch.float64, torch.float32):
            method = MyopicDeconvolution(stack.aperture, stack.grid, dtype=dtype, device=args.device)
            result = method.restore(stack.frames)
            truth = "" if stack.object is None else f", score {relative_error(result.object, stack.object, 0.5):.4f}"
            print(f"{args.stack} {str(dtype)[6:]}{truth}\n{result.summary()}")


if __name__ == "__main__":
    main()

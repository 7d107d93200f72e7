"""MSE_a beside its rivals, in one run: seconds, ratios and errors.

    python benchmarks/criterion.py                   # on all cores
    python benchmarks/criterion.py --threads 1
    python benchmarks/criterion.py --device cuda --dtype float32
    python benchmarks/criterion.py --smoke           # the smallest sizes only

direct: every one of the N (N - 1) / 2 baselines over the whole frequency grid, by the textbook formula, in place, mask
by mask as far as the cache holds no more; its gradient is written by hand as well, from slopes that the value leaves.
Wiener: the mean squared error for 20 OTFs drawn with random pistons and made by FFT, which tends to MSE_a; the last
column is its own noise and, on small grids, the sampling of the pupil.
Both are linear in the population. Times are medians over at least a second's repeats, or one run that takes longer.
Errors are relative, the largest of the population, against the direct evaluation in float64.

A second table has the criterion under turbulence over MSE_a, in turns in the same run, medians of the ratios of five
rounds: holes of 0.8 r0, an instant at one wavelength, and an exposure of tau0 in 7 wavelengths over 20 %.
"""

from __future__ import annotations

import itertools
import math
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import torch
import tyro
from torch import Tensor

from torchmask.atmosphere.seeing import Seeing
from torchmask.design.criterion import AsymptoticMSE, wiener_mse
from torchmask.design.turbulent import TurbulentMSE
from torchmask.grid import Grid
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.band import Band
from torchmask.optics.otf import OTF
from torchmask.spectra import NoisePSD, PowerLawPSD

N_FRAMES, FILL_FACTOR = 20, 0.15
N_ROUNDS = 5


@dataclass(frozen=True)
class Config:
    """Sizes are those of the reference case; its mask of 1 m is sampled at Nyquist."""

    device: str = "cpu"
    dtype: Literal["float64", "float32"] = "float64"
    threads: int | None = None
    """Number of threads; None leaves it to torch."""
    clock: Literal["wall", "cpu"] = "wall"
    """On a machine that others use as well, count seconds of the processor, with one thread."""
    n_subapertures: tuple[int, ...] = (6, 11, 20)
    n_pixels: tuple[int, ...] = (64, 128, 256)
    populations: tuple[int, ...] = (1, 32)
    seconds: float = 1.0
    """Time spent on each measurement."""
    smoke: bool = False


def median_seconds(run: Callable[[], object], config: Config) -> float:
    """Median time of `run` over `config.seconds` of repeats; the first is thrown away if there are more."""
    clock = time.perf_counter if config.clock == "wall" else time.process_time
    device = torch.device(config.device)
    times: list[float] = []
    while not times or sum(times) < config.seconds:
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        start = clock()
        run()
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        times.append(clock() - start)
    return statistics.median(times[1:] or times)


def random_mask(n: int, population: int, dtype: torch.dtype, device: torch.device) -> SparseAperture:
    """Holes at random in the disc; they may overlap, which costs the same."""
    diameter = math.sqrt(FILL_FACTOR / n)
    uniform = torch.rand(2, population, n, generator=torch.Generator().manual_seed(n), dtype=torch.float64)
    radius, angle = (1 - diameter) / 2 * uniform[0].sqrt(), 2 * math.pi * uniform[1]
    centers = torch.stack([radius * angle.cos(), radius * angle.sin()], -1)
    return SparseAperture(centers, diameter, 1.0, dtype=dtype, device=device)


class Direct:
    """MSE_a by its equation over the whole grid."""

    def __init__(self, criterion: AsymptoticMSE, diameter: float) -> None:
        self.cutoff = criterion.grid.cutoff(diameter)
        self.period = criterion.grid.period
        self.nu_y, self.nu_x = criterion.grid.frequencies(torch.float64, criterion.object_psd.device)
        self.ratio = criterion.noise_psd / (criterion.n_frames * criterion.object_psd)
        self.weight = criterion.noise_psd / (criterion.n_frames * self.ratio.numel())

    def to(self, dtype: torch.dtype) -> Direct:
        for name in ("nu_y", "nu_x", "ratio", "weight"):
            setattr(self, name, getattr(self, name).to(dtype))
        return self

    def otf(self, baseline: Tensor) -> tuple[Tensor, ...]:
        """OTF (..., G, G) shifted by baselines (..., 2) [cycles/pixel], and what its slope is made of."""
        x = self.nu_x - baseline[..., None, None, 0]
        y = self.nu_y - baseline[..., None, None, 1]
        x, y = (x - x.round()) / self.cutoff, (y - y.round()) / self.cutoff
        rho = (x * x + y * y).clamp_(max=1)
        root = torch.rsub(rho, 1).sqrt_()
        rho.sqrt_()
        otf = torch.acos(rho).addcmul_(rho, root, value=-1).mul_(2 / math.pi)
        return otf, root, rho, x, y

    def value(self, centers: Tensor) -> Tensor:
        """MSE_a of masks (B, N, 2)."""
        n, transfer = centers.shape[1], self._central(centers)
        half = torch.zeros_like(transfer)
        for i in range(n):
            for j in range(i):
                otf = self.otf((centers[:, i] - centers[:, j]) / self.period)[0]
                half.addcmul_(otf, otf)
        transfer += (half + _opposite(half)) / n**2
        return (self.weight / (transfer + self.ratio)).sum((-2, -1))

    def gradient(self, centers: Tensor) -> tuple[Tensor, Tensor]:
        """MSE_a of one mask (N, 2), and its gradient."""
        n, transfer = len(centers), self._central(centers)
        pairs = torch.tril_indices(n, n, -1, device=centers.device)
        half = torch.zeros_like(transfer)
        slopes = []
        for i, j in pairs.T.tolist():
            otf, root, rho, x, y = self.otf((centers[i] - centers[j]) / self.period)
            half.addcmul_(otf, otf)
            slope = otf.mul_(root).div_(rho.masked_fill_(rho == 0, 1))  # d OTF^2 = -(8/pi) slope (x dx + y dy)
            slopes.append((slope, x[0], y[:, 0]))
        transfer += (half + _opposite(half)) / n**2
        inverse = 1 / (transfer + self.ratio)
        by_half = self.weight * inverse * inverse
        by_half = by_half + _opposite(by_half)
        by_baseline = []
        for slope, x, y in slopes:
            slope *= by_half
            by_baseline.append(torch.stack([slope.sum(0) @ x, slope.sum(1) @ y]))
        moved = torch.stack(by_baseline) * (-8 / math.pi / (n**2 * self.cutoff * self.period))
        gradient = torch.zeros_like(centers).index_add_(0, pairs[0], moved).index_add_(0, pairs[1], moved, alpha=-1)
        return (self.weight * inverse).sum(), gradient

    def values(self, centers: Tensor) -> Tensor:
        masks = max(1, 2**16 // self.ratio.numel()) if centers.device.type == "cpu" else len(centers)
        return torch.cat([self.value(chunk) for chunk in centers.split(masks)])

    def gradients(self, centers: Tensor) -> tuple[Tensor, Tensor]:
        values, gradients = zip(*(self.gradient(mask) for mask in centers), strict=True)
        return torch.stack(values), torch.stack(gradients)

    def _central(self, centers: Tensor) -> Tensor:
        """N^2 |h|^2 for every mask: the baseline of a sub-aperture with itself."""
        return (self.otf(centers.new_zeros(2))[0] ** 2).repeat(*centers.shape[:-2], 1, 1)


def _opposite(image: Tensor) -> Tensor:
    return image.flip(-2, -1).roll((1, 1), (-2, -1))


def wiener(mask: SparseAperture, criterion: AsymptoticMSE, pistons: Tensor) -> Tensor:
    """Wiener MSE of every mask for OTFs with `pistons` (frame, N), mask by mask: the OTFs of all are large."""
    values = []
    for centers in mask.centers:
        layer = OTF(SparseAperture(centers, mask.subaperture_diameter, mask.mask_diameter), criterion.grid)
        phase = pistons[..., None].expand(*pistons.shape, layer.samples().weights.shape[-1])
        values.append(wiener_mse(layer(phase), criterion.object_psd, criterion.noise_psd))
    return torch.stack(values)


def with_gradient(criterion: AsymptoticMSE, moving: SparseAperture) -> tuple[Tensor, Tensor]:
    """Values of a population whose centres are to be differentiated, and their gradients."""
    value = criterion(moving)
    return value.detach(), torch.autograd.grad(value.sum(), moving.centers)[0]


def measure_turbulent(config: Config, n: int, n_pixels: int, population: int) -> str:
    """One row of the table of the criterion under turbulence."""
    device, dtype = torch.device(config.device), getattr(torch, config.dtype)
    grid, psds = Grid.nyquist(1.0, 550e-9, n_pixels), (PowerLawPSD(1.5, 1e7), NoisePSD(1e7))
    mask = random_mask(n, population, dtype, device)
    moving = SparseAperture(torch.nn.Parameter(mask.centers), mask.subaperture_diameter, 1.0)
    r0, band = mask.subaperture_diameter / 0.8, Band.top_hat(550e-9, 110e-9, 7)
    tau0 = Seeing(r0, wind=10.0).tau0
    block = replace(config, seconds=config.seconds / N_ROUNDS)
    criteria = [
        AsymptoticMSE(grid, *psds, N_FRAMES),
        TurbulentMSE(grid, *psds, N_FRAMES, r0=r0),
        TurbulentMSE(grid, *psds, N_FRAMES, r0, math.inf, tau0, 10.0, band.wavelengths, band.shares),
    ]
    criteria = [criterion.to(device) for criterion in criteria]
    tables = [median_seconds(lambda run=criterion: run(mask), replace(config, seconds=0.0)) for criterion in criteria]
    rounds = []
    for _ in range(N_ROUNDS):  # in turns, as a machine that others use as well has its fast and slow minutes
        with torch.no_grad():
            values = [median_seconds(lambda run=criterion: run(mask), block) for criterion in criteria]
        both = [median_seconds(lambda run=criterion: with_gradient(run, moving), block) for criterion in criteria]
        rounds.append((values, both))
    columns = [1e3 * statistics.median(values[0] for values, _ in rounds)]
    for number in (1, 2):
        columns.append(statistics.median(values[number] / values[0] for values, _ in rounds))
        columns.append(statistics.median(both[number] / both[0] for _, both in rounds))
        columns.append(statistics.median(both[number] / values[number] for values, both in rounds))
        columns.append(tables[number] - statistics.median(values[number] for values, _ in rounds))
    return f"| {n} | {n_pixels} | {population} | {' | '.join(f'{column:.2f}' for column in columns)} |"


def measure(config: Config, n: int, n_pixels: int, population: int) -> str:
    """One row of the table."""
    device, dtype = torch.device(config.device), getattr(torch, config.dtype)
    grid = Grid.nyquist(1.0, 550e-9, n_pixels)
    criterion = AsymptoticMSE(grid, PowerLawPSD(1.5, 1e7), NoisePSD(1e7), N_FRAMES).to(device)
    mask = random_mask(n, population, dtype, device)
    moving = SparseAperture(torch.nn.Parameter(mask.centers), mask.subaperture_diameter, 1.0)
    pistons = 2 * math.pi * torch.rand(N_FRAMES, n, generator=torch.Generator().manual_seed(1), dtype=dtype)
    pistons = pistons.to(device)

    def seconds(run: Callable[[], object]) -> float:
        return median_seconds(run, config)

    with torch.no_grad():
        value, gradient = Direct(criterion, mask.subaperture_diameter).gradients(mask.centers.double())
        direct = Direct(criterion, mask.subaperture_diameter).to(dtype)
        direct_value = seconds(lambda: direct.values(mask.centers))
        direct_both = seconds(lambda: direct.gradients(mask.centers))
        fast_value = seconds(lambda: criterion(mask))
        wiener_value = seconds(lambda: wiener(mask, criterion, pistons))
        drawn = float((wiener(mask, criterion, pistons) / value - 1).mean())
    fast_both = seconds(lambda: with_gradient(criterion, moving))
    ours, our_gradient = with_gradient(criterion, moving)
    error = float((ours / value - 1).abs().max())
    slope_error = float(((our_gradient - gradient).norm(dim=(1, 2)) / gradient.norm(dim=(1, 2))).max())
    return (
        f"| {n} | {n_pixels} | {population} | {1e3 * direct_value:.1f} | {1e3 * fast_value:.2f} | "
        f"{direct_value / fast_value:.0f} | {1e3 * direct_both:.1f} | {1e3 * fast_both:.2f} | "
        f"{direct_both / fast_both:.0f} | {fast_both / fast_value:.2f} | {1e3 * wiener_value:.1f} | "
        f"{wiener_value / fast_value:.0f} | {error:.0e} | {slope_error:.0e} | {100 * drawn:+.1f} |"
    )


def main(config: Config) -> None:
    if config.device.startswith("cuda") and not torch.cuda.is_available():
        sys.exit(f"criterion: device is {config.device}, but torch {torch.__version__} sees no CUDA device here")
    if config.threads is not None:
        torch.set_num_threads(config.threads)
    if config.smoke:
        config = replace(config, n_subapertures=(6,), n_pixels=(64,), populations=(1, 4), seconds=0.05)
    measure(replace(config, seconds=0.0), 3, 64, 1)  # what is imported or compiled at a first call
    where = torch.cuda.get_device_name(config.device) if config.device.startswith("cuda") else "CPU"
    print(f"{where}, {torch.get_num_threads()} threads, {config.dtype}, torch {torch.__version__}; milliseconds\n")
    print(
        "| N | G | masks | direct | fast | ratio | direct, gradient | fast, gradient | ratio | gradient / value | "
        "Wiener | ratio | error | of gradient | Wiener above [%] |\n" + "|---" * 15 + "|"
    )
    sizes = list(itertools.product(config.n_subapertures, config.n_pixels, config.populations))
    for size in sizes:
        print(measure(config, *size), flush=True)
    columns = ["over MSE_a", "the same with gradient", "gradient / value", "tables [s]"]
    names = columns + [f"band, exposure: {name}" for name in columns]
    print(f"\n| N | G | masks | MSE_a | {' | '.join(names)} |\n" + "|---" * 12 + "|")
    for size in sizes:
        print(measure_turbulent(config, *size), flush=True)


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))

"""Train a small network on simulated stacks, and hold it against the best linear restoration.

    python experiments/train_restorer.py               # a minute of training on one core, after half a minute of stacks
    python experiments/train_restorer.py --smoke       # everything, tiny, in seconds

Each stack of a `StackDataset` (the satellite in a random pose, sunlight, flux and turbulence) becomes its multi-frame
Wiener estimate with the true PSFs and the mean power spectrum of the training objects. A few convolutions learn what
to add to it. Scores on stacks that were never trained on: relative error up to the diffraction limit, 0 is perfect.
Log, figure, network and scores go to a new folder.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.utils.data import DataLoader

from torchmask.cli.options import ExperimentOptions
from torchmask.cli.program import run_script
from torchmask.cli.run import Run, new_run
from torchmask.grid import Grid
from torchmask.io import atomic_write, write_json
from torchmask.metrics import lowpass, relative_error
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.overlaps import check_overlaps
from torchmask.record import Callback, Record
from torchmask.restoration.wiener import multiframe_wiener
from torchmask.simulation.dataset import StackDataset, StackRanges
from torchmask.viz.comparison import comparison_figure

DIAMETER = 1.0  # of the mask [m]
WAVELENGTH = 550e-9
READOUT_NOISE = 1.5  # electrons rms per pixel


@dataclass(frozen=True, kw_only=True)
class Options(ExperimentOptions):
    """Options of the network and its stacks."""

    mask: str = "golay9"
    """Name of a Golay array of the catalogue."""
    fill_factor: float = 0.15
    """Collecting area N d^2 / D^2."""
    ranges: StackRanges = field(default_factory=StackRanges)
    """Ranges of the values that differ between stacks."""
    n_pixels: int = 64
    """Number of pixels per side of the image."""
    n_frames: int = 8
    """Number of short exposures in a stack."""
    n_train: int = 256
    """Number of stacks to train on."""
    n_held_out: int = 32
    """Number of held-out stacks for the scores."""
    channels: int = 24
    """Number of channels of the hidden layers."""
    depth: int = 5
    """Number of convolutions."""
    epochs: int = 12
    """Number of passes over the training stacks."""
    batch_size: int = 8
    """Number of stacks in a step of the optimiser."""
    learning_rate: float = 2e-3
    """Maximum learning rate of Adam."""
    workers: int = 2
    """Number of processes that draw stacks."""
    seed: int = 0
    """Seed of stacks, network and training."""


class Restorer(nn.Module):
    """What to add to a linear estimate (B, 1, H, W), seen beside the mean frame: input (B, 2, H, W)."""

    def __init__(self, channels: int, depth: int) -> None:
        super().__init__()
        sizes = [2, *[channels] * (depth - 1), 1]
        layers: list[nn.Module] = []
        for size, following in pairwise(sizes):
            layers += [nn.Conv2d(size, following, 3, padding=1, padding_mode="replicate"), nn.SiLU()]
        self.layers = nn.Sequential(*layers[:-1])
        nn.init.zeros_(layers[-2].weight)  # type: ignore[arg-type]
        nn.init.zeros_(layers[-2].bias)  # type: ignore[arg-type]

    def forward(self, images: Tensor) -> Tensor:
        return images[:, :1] + self.layers(images)


def draw(stacks: StackDataset, workers: int, callback: Callback) -> dict[str, Tensor]:
    """All stacks, one after another along the first axis."""
    items = []
    for item in DataLoader(stacks, batch_size=None, num_workers=workers):
        items.append(item)
        callback(Record("stacks", len(items), len(stacks), {"photons": float(item["n_photons"])}))
    return {name: torch.stack([item[name] for item in items]) for name in items[0]}


def linear_restorations(data: dict[str, Tensor], n_train: int, cutoff: float) -> tuple[Tensor, Tensor]:
    """Inputs (B, 2, H, W), multi-frame Wiener estimate and mean frame, and targets (B, 1, H, W), of mean 1 each.

    Of the PSFs what fell outside the field is missing; the object's power spectrum is the mean of the training objects.
    """
    photons = data["n_photons"][:, None, None]
    pixels = math.prod(data["object"].shape[-2:])
    unit = photons / pixels
    truth = data["object"] / unit
    power = (torch.fft.fft2(truth[:n_train]).abs() ** 2).mean(0)
    otfs = torch.fft.fft2(torch.fft.ifftshift(data["psfs"], dim=(-2, -1)))
    noise = (photons + pixels * READOUT_NOISE**2) / unit**2
    frames = data["frames"] / unit[:, None]
    stacks = zip(frames, otfs, noise, strict=True)
    linear = torch.stack([multiframe_wiener(stack, transfer, power, level) for stack, transfer, level in stacks])
    return torch.stack([linear, frames.mean(1)], dim=1), lowpass(truth, cutoff)[:, None]


def turned(images: Tensor, targets: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Return the same pairs turned by a random multiple of 90 degrees, and perhaps mirrored: eight times the stacks."""
    quarter, mirror = (int(torch.randint(n, (), generator=generator)) for n in (4, 2))
    both = torch.rot90(torch.cat([images, targets], dim=1), quarter, dims=(-2, -1))
    both = both.flip(-1) if mirror else both
    return both[:, :-1], both[:, -1:]


def power_error(estimate: Tensor, target: Tensor) -> Tensor:
    """Return the mean over the batch of the squared error, as a share of the target's power."""
    return (((estimate - target) ** 2).sum((1, 2, 3)) / (target**2).sum((1, 2, 3))).mean()


def train(
    network: Restorer,
    training: tuple[Tensor, Tensor],
    held_out: tuple[Tensor, Tensor],
    options: Options,
    callback: Callback,
) -> None:
    """Minimise the relative error by Adam; the one-cycle schedule ends at a vanishing learning rate."""
    generator = torch.Generator().manual_seed(options.seed)
    per_epoch = math.ceil(len(training[0]) / options.batch_size)
    n_steps = options.epochs * per_epoch
    optimizer = torch.optim.Adam(network.parameters(), lr=options.learning_rate)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, options.learning_rate, total_steps=n_steps)
    for step in range(1, n_steps + 1):
        if step % per_epoch == 1 or per_epoch == 1:
            order = torch.randperm(len(training[0]), generator=generator).split(options.batch_size)
        chosen = order[(step - 1) % per_epoch]
        images, targets = turned(training[0][chosen], training[1][chosen], generator)
        loss = power_error(network(images), targets)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        scalars, arrays = {"loss": loss.item()}, {}
        if step % per_epoch == 0:
            with torch.no_grad():
                restored = network(held_out[0])
            scalars["held_out_loss"] = power_error(restored, held_out[1]).item()
            arrays = {"linear": held_out[0][0, 0], "restored": restored[0, 0], "truth": held_out[1][0, 0]}
        callback(Record("training", step, n_steps, scalars, arrays))


def scores(images: Tensor, targets: Tensor, cutoff: float) -> list[float]:
    """Return the library's score of each image (B, H, W)."""
    return [relative_error(image, target[0], cutoff) for image, target in zip(images, targets, strict=True)]


def compare(
    restored: Tensor, held_out: tuple[Tensor, Tensor], cutoff: float, log: Callable[[str, float], None]
) -> dict[str, float]:
    """Return the mean scores on the held-out stacks, and the share of them on which the network beats its input."""
    images = {"mean frame": held_out[0][:, 1], "Wiener": held_out[0][:, 0], "network": restored}
    each = {name: scores(values, held_out[1], cutoff) for name, values in images.items()}
    table = {name: sum(values) / len(values) for name, values in each.items()}
    better = sum(a < b for a, b in zip(each["network"], each["Wiener"], strict=True))
    for name, value in table.items():
        log(f"summary/{name.replace(' ', '_')}/score", value)
    log("summary/improved", better / len(restored))
    return table | {"improved": better / len(restored)}


def restorer(options: Options, output: Run) -> dict[str, float]:
    """Draw, train, score; returns the table."""
    grid = Grid.nyquist(DIAMETER, WAVELENGTH, options.n_pixels)
    mask = SparseAperture.from_catalog(options.mask, DIAMETER, options.fill_factor)
    check_overlaps(mask)
    cutoff = grid.cutoff(DIAMETER)
    count = options.n_train + options.n_held_out
    stacks = StackDataset(
        mask, grid, count, options.n_frames, options.ranges, readout_noise=READOUT_NOISE, seed=options.seed
    )
    torch.manual_seed(options.seed)
    network = Restorer(options.channels, options.depth)
    data = draw(stacks, options.workers, output.callback)
    images, targets = linear_restorations(data, options.n_train, cutoff)
    training = images[: options.n_train], targets[: options.n_train]
    held_out = images[options.n_train :], targets[options.n_train :]
    train(network, training, held_out, options, output.callback)
    with torch.no_grad():
        restored = network(held_out[0])[:, 0]
    with atomic_write(output.directory / "network.pt") as file:
        torch.save(network.state_dict(), file)
    exposure, truth = data["frames"][options.n_train, 0], data["object"][options.n_train]
    pictures = {"Wiener": (exposure, held_out[0][0, 0]), "network": (exposure, restored[0])}
    output.logger.figure("comparison", comparison_figure(truth, pictures, cutoff, grid.pixel_scale))
    table = compare(restored, held_out, cutoff, output.logger.scalar)
    write_json(output.directory / "scores.json", table)
    return table


def check(options: Options) -> None:
    """Raise ValueError for numbers that must be at least 1."""
    for name in ("n_train", "n_held_out", "n_frames", "channels", "epochs", "batch_size"):
        if getattr(options, name) < 1:
            raise ValueError(f"{name} is {getattr(options, name)}: it must be at least 1")
    if options.depth < 2:
        raise ValueError(f"depth is {options.depth}: an input and an output layer are needed, at least 2")
    if options.workers < 0:
        raise ValueError(f"workers is {options.workers}: it must not be negative; 0 draws in this process")


def run(options: Options) -> None:
    """Train in a new folder, in which an interrupted run leaves its results so far."""
    if options.smoke:
        tiny = {"n_pixels": 32, "n_frames": 2, "n_train": 24, "n_held_out": 4, "channels": 8, "depth": 4}
        options = replace(options, **tiny, epochs=40, workers=0)
    check(options)
    with new_run("train_restorer", options, options.seed) as output:
        table = restorer(options, output)
        improved = round(table.pop("improved") * options.n_held_out)
        output.summary.extend(f"{name:12s} {value:.4f}" for name, value in table.items())
        output.summary.append(
            f"The network is better than its input on {improved} of {options.n_held_out} stacks it was not trained on."
        )


def main(argv: Sequence[str] | None = None) -> int:
    """Return the exit status."""
    return run_script("train_restorer", run, Options, __doc__, argv)


if __name__ == "__main__":
    sys.exit(main())

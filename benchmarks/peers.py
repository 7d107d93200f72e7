"""This library beside its peers on the same stacks: score, structural similarity and seconds.

    python benchmarks/peers.py ../shared/stacks/*.npz      # stacks with their truth, as Observation.save writes them
    python benchmarks/peers.py                             # two stacks of the packaged satellite, simulated here
    python benchmarks/peers.py --smoke                     # everything, tiny, in seconds

Needs the extra `torchmask[bench]`. This library runs once, with its defaults, and knows the frames and the instrument.
Every peer may choose its settings, and whether to clip at 0, with the truth at hand, and is told r0: the table gives
the best score it reaches, and the seconds of that one run. Peers: torchmfbd, which models a full pupil and nothing
else; shift-and-add; and scikit-image's Richardson-Lucy and unsupervised Wiener on shift-and-add, with the PSF that
shift-and-add has on average in such turbulence. The multi-frame Wiener estimate knows the true PSFs of all frames.
The table, as markdown and JSON, goes to a new folder, runs/<name>/.
"""

from __future__ import annotations

import contextlib
import dataclasses
import io
import logging
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from torch import Tensor

from torchmask.atmosphere.phase import TurbulencePhase
from torchmask.grid import Grid
from torchmask.io import atomic_write, write_json
from torchmask.metrics import relative_error, ssim
from torchmask.observation import Observation
from torchmask.optics.aperture import FullAperture, SparseAperture
from torchmask.optics.detector import Detector
from torchmask.restoration.baselines import average_psf, shift_and_add
from torchmask.restoration.myopic import MyopicDeconvolution
from torchmask.restoration.wiener import multiframe_wiener
from torchmask.simulation.exposures import simulate_observation
from torchmask.simulation.scene import SceneOptions, make_scene
from torchmask.spectra import NoisePSD, PowerLawPSD

OURS, LIMIT = "torchmask", "multi-frame Wiener, true PSFs"
WANTED_LEAD = 1.5  # over the best peer that does not know the PSFs
_ARCSEC = 206265.0  # torchmfbd's own number of arc seconds in a radian
_CUTOFFS = (
    0.5,
    0.6,
    0.7,
    0.8,
    0.85,
    0.9,
    0.95,
    1.0,
)  # of torchmfbd's Fourier filter over the diffraction limit
_PSF_SEED = 12345  # of the average PSF of shift-and-add


@dataclass(frozen=True)
class Config:
    """Everything a run depends on."""

    stacks: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Stacks of exposures with their truth (.npz); none: a mask and a full pupil, simulated here."""
    cutoff: float = 0.5
    """Of the score: D pixel_scale / wavelength [cycles/pixel]."""
    mfbd_iterations: int = 500
    """Of torchmfbd."""
    smoke: bool = False
    """Everything tiny, to see that it runs."""
    name: str | None = None
    """Folder of the run below `runs`; None: date and time."""
    runs: Path = Path("runs")
    """Where run folders are made."""


@dataclass(frozen=True)
class Candidate:
    """One image that a method offers."""

    settings: str
    image: Tensor
    seconds: float


Method = Callable[[Observation, Config], Iterator[Candidate]]


def this_library(observation: Observation, config: Config) -> Iterator[Candidate]:
    """Defaults only."""
    started = time.perf_counter()
    limit: dict[str, Any] = {"max_iterations": 10} if config.smoke else {}
    result = MyopicDeconvolution(observation.aperture, observation.grid, **limit).restore(observation.frames)
    yield Candidate("defaults", result.object, time.perf_counter() - started)


@dataclass(frozen=True)
class MFBDSettings:
    """Of torchmfbd: Karhunen-Loeve modes without piston, step of Adam, regularisation of the division by the OTFs."""

    n_modes: int
    step: float
    noise: float


# The best of those tried: 44 to 135 modes, steps of 0.02 to 0.1, noise of 1e-4 to 1e-2 and its own estimate, starts
# of 0 to 0.3 rad rms, apodisation, slower schedules up to 1000 iterations and a joint estimation of the object.
MFBD_SETTINGS = (
    MFBDSettings(65, 0.1, 1e-3),
    MFBDSettings(90, 0.05, 1e-3),
    MFBDSettings(90, 0.05, 1e-4),
    MFBDSettings(135, 0.05, 1e-3),
)
_MFBD_START = 0.1  # rms of the first coefficients [rad]


def mfbd(observation: Observation, config: Config) -> Iterator[Candidate]:
    """torchmfbd, each setting with several cut-offs of its Fourier filter."""
    if observation.aperture.n_subapertures > 1 or len(set(observation.grid.shape)) > 1:
        return
    for settings in MFBD_SETTINGS:
        started = time.perf_counter()
        with _quiet(), torch.random.fork_rng():
            torch.manual_seed(0)
            images = _run_mfbd(observation, settings, 5 if config.smoke else config.mfbd_iterations)
        seconds = time.perf_counter() - started
        for cutoff, image in images.items():
            text = f"{settings.n_modes} KL modes, step {settings.step:g}, noise {settings.noise:g}, cut-off {cutoff:g}"
            yield Candidate(text, image, seconds)


def _run_mfbd(observation: Observation, settings: MFBDSettings, iterations: int) -> dict[float, Tensor]:
    import torchmfbd  # pyright: ignore[reportMissingImports] -- only in the bench extra

    aperture, grid = observation.aperture, observation.grid
    deconvolution = torchmfbd.Deconvolution(
        {
            "telescope": {
                "diameter": 100 * aperture.outer_diameter,  # [cm]
                "central_obscuration": 100 * aperture.outer_diameter * aperture.central_obstruction,
                "spider": 0,
            },
            "images": {
                "n_pixel": grid.shape[0],
                "pix_size": grid.pixel_scale * _ARCSEC,
                "apodization_border": 0,
                "remove_gradient_apodization": False,
            },
            "object1": {
                "wavelength": 1e10 * grid.wavelength,  # [Angstrom]
                "image_filter": "tophat",
                "cutoff": [0.85, 0.9],
            },
            "optimization": {
                "gpu": -1,
                "transform": "none",
                "softplus_scale": 1.0,
                "lr_obj": settings.step,
                "lr_modes": settings.step,
            },
            "regularization": {"iuwt1": {"variable": "object", "lambda": 0.0, "nbands": 5}},
            "psf": {"model": "kl", "nmax_modes": settings.n_modes},
            "initialization": {"object": "contrast", "modes_std": _MFBD_START},
            "annealing": {"type": "linear", "start_pct": 0.0, "end_pct": 0.6},
        }
    )
    frames = (observation.frames / observation.frames.mean()).float()[None]
    deconvolution.add_frames(frames, sigma=torch.full(frames.shape[:2], settings.noise))
    deconvolution.deconvolve(n_iterations=iterations)
    images = {}
    for cutoff in _CUTOFFS:
        deconvolution.update_object(cutoffs=[[cutoff - 0.05, cutoff]])
        images[cutoff] = deconvolution.obj[0][0].double().clone()
    return images


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """An empty working directory for the files that torchmfbd leaves, and none of its messages."""
    disabled, dtype = logging.root.manager.disable, torch.get_default_dtype()
    logging.disable(logging.CRITICAL)
    silence = io.StringIO()
    try:
        with (
            tempfile.TemporaryDirectory() as folder,
            contextlib.chdir(folder),
            contextlib.redirect_stderr(silence),
            contextlib.redirect_stdout(silence),
        ):
            yield
    finally:
        logging.disable(disabled)
        torch.set_default_dtype(dtype)


def average_star(observation: Observation) -> np.ndarray:
    """The PSF of shift-and-add in this turbulence."""
    assert observation.r0 is not None
    turbulence = TurbulencePhase(observation.r0, observation.outer_scale or 20 * observation.aperture.mask_diameter)
    generator = torch.Generator().manual_seed(_PSF_SEED)
    return average_psf(observation.aperture, observation.grid, turbulence, generator).numpy()


def added(observation: Observation, config: Config) -> Iterator[Candidate]:
    """Shift-and-add alone."""
    started = time.perf_counter()
    yield Candidate("", shift_and_add(observation.frames), time.perf_counter() - started)


def richardson_lucy(observation: Observation, config: Config) -> Iterator[Candidate]:
    """scikit-image's, stopped after several numbers of iterations."""
    from skimage.restoration import richardson_lucy

    psf = average_star(observation)
    for iterations in (3,) if config.smoke else (5, 10, 20, 40, 80, 160, 320, 640, 1280):
        started = time.perf_counter()
        image = shift_and_add(observation.frames)
        image = image.clamp(min=1e-6 * float(image.max()))
        restored = richardson_lucy((image / image.max()).numpy(), psf, num_iter=iterations, clip=False)
        yield Candidate(f"{iterations} iterations", torch.from_numpy(restored), time.perf_counter() - started)


def unsupervised_wiener(observation: Observation, config: Config) -> Iterator[Candidate]:
    """scikit-image's, which finds its own regularisation."""
    from skimage.restoration import unsupervised_wiener

    psf, started = average_star(observation), time.perf_counter()
    image = shift_and_add(observation.frames)
    restored, _ = unsupervised_wiener((image / image.max()).numpy(), psf, clip=False, rng=0)
    yield Candidate("", torch.from_numpy(np.asarray(restored)), time.perf_counter() - started)


def known_psfs(observation: Observation, config: Config) -> Iterator[Candidate]:
    """The multi-frame Wiener estimate with the true PSFs, for several power laws of the object."""
    assert observation.psfs is not None
    frames, grid = observation.frames.double(), observation.grid
    photons = float(frames.sum((1, 2)).mean())
    middle = [-(side // 2) for side in grid.shape]
    for exponent in (1.0, 1.5, 2.0, 2.5, 3.0, 3.5):
        started = time.perf_counter()
        otfs = torch.fft.fft2(observation.psfs.double().roll(middle, dims=(-2, -1)))
        object_psd, noise_psd = PowerLawPSD(exponent, photons), NoisePSD(photons, observation.readout_noise or 0.0)
        image = multiframe_wiener(frames, otfs, object_psd, noise_psd)
        yield Candidate(f"exponent {exponent:g}", image, time.perf_counter() - started)


METHODS: dict[str, Method] = {
    OURS: this_library,
    "torchmfbd": mfbd,
    "Richardson-Lucy on shift-and-add": richardson_lucy,
    "unsupervised Wiener on shift-and-add": unsupervised_wiener,
    "shift-and-add": added,
    LIMIT: known_psfs,
}


def best(name: str, candidates: Iterator[Candidate], truth: Tensor | None, cutoff: float) -> dict[str, Any] | None:
    """The candidate of the best score, clipped at 0 if that helps; None without candidates."""
    row: dict[str, Any] | None = None
    for candidate in candidates:
        for image in (candidate.image, candidate.image.clamp(min=0)):
            value = relative_error(image, truth, cutoff)
            if row is None or value < row["score"]:
                row = {"method": name, "score": value, "ssim": ssim(image, truth, cutoff)}
                row |= {"seconds": candidate.seconds, "settings": candidate.settings}
    return row


def compare(name: str, observation: Observation, config: Config) -> list[dict[str, Any]]:
    """A row for each method that applies to a stack."""
    rows = []
    for method, function in METHODS.items():
        print(f"{name}: {method} ...", end=" ", file=sys.stderr, flush=True)
        row = best(method, function(observation, config), observation.object, config.cutoff)
        print("does not apply" if row is None else f"{row['score']:.4f}", file=sys.stderr, flush=True)
        if row is not None:
            rows.append({"stack": name} | row)
    return rows


def lead(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """How far this library is ahead on one stack: the score of the best peer without the PSFs over its own."""
    ours = next(row for row in rows if row["method"] == OURS)
    peer = min((row for row in rows if row["method"] not in (OURS, LIMIT)), key=lambda row: row["score"])
    limit = next(row for row in rows if row["method"] == LIMIT)
    return {
        "stack": ours["stack"],
        "best_peer": peer["method"],
        "lead": peer["score"] / ours["score"],
        "over_limit": ours["score"] / limit["score"],
    }


def load(path: Path) -> Observation:
    """A stack with all that a comparison needs. Raises ValueError if its truth is missing."""
    observation = Observation.load(path)
    missing = [name for name in ("object", "psfs", "r0") if getattr(observation, name) is None]
    if missing:
        raise ValueError(f"{path} lacks {', '.join(missing)}: methods cannot be compared without the truth")
    return observation


def simulated(config: Config) -> dict[str, Observation]:
    """The packaged satellite through nine holes and through a full pupil that reaches as far, D/r0 = 7."""
    n_pixels, n_frames, photons = (48, 3, 1e6) if config.smoke else (128, 20, 1e7)
    mask, grid = SparseAperture.from_catalog("golay9", 1.0, 0.15), Grid.nyquist(1.0, 550e-9, n_pixels)
    stacks = {}
    for name, aperture in (("satellite_mask", mask), ("satellite_full", FullAperture(mask.extent))):
        scene = make_scene(grid.shape, photons * aperture.area / mask.area, SceneOptions(size=0.5))
        generator = torch.Generator().manual_seed(0)
        turbulence, detector = TurbulencePhase(1 / 7, 20.0), Detector(1.5)
        stacks[name] = simulate_observation(scene, aperture, grid, turbulence, detector, n_frames, generator)
    return stacks


def versions() -> dict[str, str]:
    """Of everything that was compared. Raises ValueError if the extra is not installed."""
    try:
        return {name: version(name) for name in ("torchmask", "torchmfbd", "scikit-image", "torch", "numpy", "scipy")}
    except PackageNotFoundError as error:
        raise ValueError(f"{error.name} is not installed: pip install 'torchmask[bench]'") from error


def markdown(rows: Sequence[Mapping[str, Any]], leads: Sequence[Mapping[str, Any]], used: Mapping[str, str]) -> str:
    """The table, and what it says."""
    lines = [
        "| stack | method | score | SSIM | seconds | settings, chosen with the truth except for torchmask's |",
        "|---|---|---|---|---|---|",
    ]
    for row in rows:
        lines.append(
            f"| {row['stack']} | {row['method']} | {row['score']:.4f} | {row['ssim']:.3f} | {row['seconds']:.1f} | "
            f"{row['settings']} |"
        )
    lines.append("")
    for item in leads:
        reached = "reached" if item["lead"] >= WANTED_LEAD else "NOT reached"
        lines.append(
            f"- {item['stack']}: {item['lead']:.2f} times better than the best peer without the PSFs "
            f"({item['best_peer']}); {WANTED_LEAD:g} is {reached}. {item['over_limit']:.2f} times the score of the "
            "Wiener estimate with the true PSFs."
        )
    listed = ", ".join(f"{name} {number}" for name, number in used.items())
    lines += ["", f"{listed}; {torch.get_num_threads()} threads of {os.cpu_count()} cores."]
    return "\n".join(lines) + "\n"


def main(config: Config) -> int:
    """Run in a new folder."""
    directory = config.runs / (config.name or datetime.now().strftime("peers-%Y%m%d-%H%M%S"))
    try:
        if directory.exists():
            raise ValueError(f"{directory} exists and is not overwritten: choose another --name")
        used = versions()
        stacks = {path.stem: load(path) for path in config.stacks} or simulated(config)
        rows, leads = [], []
        for name, observation in stacks.items():
            own = compare(name, observation, config)
            rows += own
            leads.append(lead(own))
    except ValueError as error:
        print(f"peers: {error}", file=sys.stderr)
        return 2
    directory.mkdir(parents=True)
    record = {"versions": used, "threads": torch.get_num_threads(), "config": dataclasses.asdict(config)}
    write_json(directory / "peers.json", record | {"rows": rows, "leads": leads})
    text = markdown(rows, leads, used)
    with atomic_write(directory / "peers.md") as file:
        file.write(text.encode())
    print(text, f"written to {directory}", sep="\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Config, description=__doc__)))

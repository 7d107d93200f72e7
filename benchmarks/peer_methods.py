"""The methods that `peers` compares: each yields the images it offers for a stack, with the seconds they took."""

from __future__ import annotations

import contextlib
import io
import logging
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchmask.atmosphere.phase import TurbulencePhase
from torchmask.observation import Observation
from torchmask.restoration.baselines import average_psf, shift_and_add
from torchmask.restoration.myopic import MyopicDeconvolution
from torchmask.restoration.wiener import multiframe_wiener
from torchmask.spectra import NoisePSD, PowerLawPSD

OURS, LIMIT = "torchmask", "multi-frame Wiener, true PSFs"
_ARCSEC = 206265.0  # torchmfbd's own number of arc seconds in a radian
_CUTOFFS = (0.5, 0.6, 0.7, 0.8, 0.85, 0.9, 0.95, 1.0)  # of torchmfbd's filter over the diffraction limit
_PSF_SEED = 12345  # of the average PSF of shift-and-add


@dataclass(frozen=True)
class Candidate:
    """One image that a method offers."""

    settings: str
    image: Tensor
    seconds: float


@dataclass(frozen=True)
class Effort:
    """iterations : of this library and of Richardson-Lucy, None for what each needs; mfbd_iterations : of torchmfbd."""

    iterations: int | None = None
    mfbd_iterations: int = 500


Method = Callable[[Observation, Effort], Iterator[Candidate]]


def this_library(observation: Observation, effort: Effort) -> Iterator[Candidate]:
    """Defaults only."""
    started = time.perf_counter()
    limit: dict[str, Any] = {} if effort.iterations is None else {"max_iterations": effort.iterations}
    result = MyopicDeconvolution(observation.aperture, observation.grid, **limit).restore(observation.frames)
    yield Candidate("defaults", result.object, time.perf_counter() - started)


@dataclass(frozen=True)
class MFBDSettings:
    """Settings of torchmfbd: Karhunen-Loeve modes without piston, step of Adam, noise that regularises its division."""

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


def mfbd(observation: Observation, effort: Effort) -> Iterator[Candidate]:
    """torchmfbd, each setting with several cut-offs of its Fourier filter."""
    if not observation.aperture.is_full or len(set(observation.grid.shape)) > 1:
        return
    for settings in MFBD_SETTINGS:
        started = time.perf_counter()
        with _quiet(), torch.random.fork_rng():
            torch.manual_seed(0)
            images = _run_mfbd(observation, settings, effort.mfbd_iterations)
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
                "central_obscuration": 100 * aperture.outer_diameter * aperture.shape.parameters.get("obstruction", 0),
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


def added(observation: Observation, effort: Effort) -> Iterator[Candidate]:
    """Shift-and-add alone."""
    started = time.perf_counter()
    yield Candidate("", shift_and_add(observation.frames), time.perf_counter() - started)


def richardson_lucy(observation: Observation, effort: Effort) -> Iterator[Candidate]:
    """scikit-image's, stopped after several numbers of iterations."""
    from skimage.restoration import richardson_lucy

    psf = average_star(observation)
    for iterations in [effort.iterations] if effort.iterations else (5, 10, 20, 40, 80, 160, 320, 640, 1280):
        started = time.perf_counter()
        image = shift_and_add(observation.frames)
        image = image.clamp(min=1e-6 * float(image.max()))
        restored = richardson_lucy((image / image.max()).numpy(), psf, num_iter=iterations, clip=False)
        yield Candidate(f"{iterations} iterations", torch.from_numpy(restored), time.perf_counter() - started)


def unsupervised_wiener(observation: Observation, effort: Effort) -> Iterator[Candidate]:
    """scikit-image's, which finds its own regularisation."""
    from skimage.restoration import unsupervised_wiener

    psf, started = average_star(observation), time.perf_counter()
    image = shift_and_add(observation.frames)
    restored, _ = unsupervised_wiener((image / image.max()).numpy(), psf, clip=False, rng=0)
    yield Candidate("", torch.from_numpy(np.asarray(restored)), time.perf_counter() - started)


def known_psfs(observation: Observation, effort: Effort) -> Iterator[Candidate]:
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

"""The methods that `peers` compares: each yields the images it offers for a stack, with the seconds they took."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from peer_mfbd import MFBD_SETTINGS, best_start
from scipy.optimize import minimize
from torch import Tensor

from torchmask.atmosphere.phase import TurbulencePhase
from torchmask.observation import Observation
from torchmask.restoration.background import Background
from torchmask.restoration.baselines import average_psf, shift_and_add
from torchmask.restoration.myopic import MyopicDeconvolution
from torchmask.restoration.objective import MyopicObjective
from torchmask.restoration.variation import TotalVariation
from torchmask.restoration.wiener import multiframe_wiener
from torchmask.spectra import NoisePSD, PowerLawPSD

OURS, LIMIT = "torchmask", "multi-frame Wiener, true PSFs"
_PSF_SEED = 12345  # of the average PSF of shift-and-add


@dataclass(frozen=True)
class Candidate:
    """One image that a method offers."""

    settings: str
    image: Tensor
    seconds: float


@dataclass(frozen=True)
class Effort:
    """How long each method may work.

    iterations : of this library, of plain L-BFGS-B and of Richardson-Lucy, None for what each needs
    mfbd_iterations, mfbd_starts : of torchmfbd
    """

    iterations: int | None = None
    mfbd_iterations: int = 500
    mfbd_starts: int = 3


Method = Callable[[Observation, Effort], Iterator[Candidate]]


def this_library(observation: Observation, effort: Effort) -> Iterator[Candidate]:
    """Defaults only."""
    started = time.perf_counter()
    limit: dict[str, Any] = {} if effort.iterations is None else {"max_iterations": effort.iterations}
    result = MyopicDeconvolution(observation.aperture, observation.grid, **limit).restore(observation.frames)
    yield Candidate("defaults", result.object, time.perf_counter() - started)


def mfbd(observation: Observation, effort: Effort) -> Iterator[Candidate]:
    """torchmfbd, each setting with several cut-offs of its Fourier filter."""
    if not observation.aperture.is_full or len(set(observation.grid.shape)) > 1:
        return
    for settings in MFBD_SETTINGS:
        started = time.perf_counter()
        kept = best_start(observation, settings, effort.mfbd_iterations, effort.mfbd_starts)
        seconds = time.perf_counter() - started
        for cutoff, image in kept.images.items():
            text = (
                f"{settings.n_modes} KL modes, step {settings.step:g}, noise {settings.noise:g}, cut-off {cutoff:g}; "
                f"of {effort.mfbd_starts} starts that of the lowest loss"
            )
            yield Candidate(text, image, seconds)


# Units of the object [mean pixels], which balance the steps of object and aberrations, and numbers of corrections. In
# units of 1 it is far from its end after as many iterations.
_PLAIN_SETTINGS = ((10.0, 10), (30.0, 10), (10.0, 20), (30.0, 20))


def plain_lbfgs(observation: Observation, effort: Effort) -> Iterator[Candidate]:
    """The seed method: SciPy's L-BFGS-B on this library's cost, from the mean frame and zero aberrations."""
    is_full, iterations = observation.aperture.is_full, effort.iterations or 1000
    n_modes, weight = (66, 3.0) if is_full else (6, 1.0)
    for unit, corrections in _PLAIN_SETTINGS:
        started = time.perf_counter()
        method = MyopicDeconvolution(
            observation.aperture,
            observation.grid,
            n_modes,
            observation.r0,
            observation.outer_scale,
            observation.readout_noise,
            background=Background.NONE,
            prior=TotalVariation(weight),
            dtype=torch.float64,  # as SciPy's own
        )
        image = _descend(method.objective(observation.frames), unit, corrections, iterations)
        text = f"{n_modes} modes, mu = {weight:g}, {iterations} iterations, {corrections} corrections, unit {unit:g}"
        yield Candidate(text, image, time.perf_counter() - started)


def _descend(objective: MyopicObjective, unit: float, corrections: int, iterations: int) -> Tensor:
    """Return the object (H, W) after that many iterations on object / unit >= 0 and whitened aberrations."""
    window, evaluate = objective.model.window, objective.evaluator(objective.neutral_calibration())
    image = window.embed(objective.frames.mean(0).clamp(min=0)).double()
    shape, n = image.shape, image.numel()

    def split(x: np.ndarray) -> tuple[Tensor, Tensor]:
        vector = torch.from_numpy(x)
        return unit * vector[:n].view(shape), vector[n:].view_as(objective.centre)

    def cost(x: np.ndarray) -> tuple[float, np.ndarray]:
        value, by_image, by_z, _ = evaluate(*split(x))
        return float(value), torch.cat([unit * by_image.flatten(), by_z.flatten()]).numpy()

    start = torch.cat([image.flatten() / unit, torch.zeros_like(objective.centre).flatten()]).numpy()
    bounds = [(0.0, None)] * n + [(None, None)] * (len(start) - n)
    # Without tolerances all iterations are made.
    options = {"maxiter": iterations, "maxfun": 10 * iterations, "maxcor": corrections, "ftol": 0.0, "gtol": 0.0}
    found = minimize(cost, start, jac=True, method="L-BFGS-B", bounds=bounds, options=options)
    return window.crop(split(found.x)[0]).clone()


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
    "plain joint L-BFGS-B": plain_lbfgs,
    "torchmfbd": mfbd,
    "Richardson-Lucy on shift-and-add": richardson_lucy,
    "unsupervised Wiener on shift-and-add": unsupervised_wiener,
    "shift-and-add": added,
    LIMIT: known_psfs,
}

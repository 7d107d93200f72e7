"""torchmfbd, run as a peer: its settings, several random starts, and the one that its own loss prefers."""

from __future__ import annotations

import contextlib
import io
import logging
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from torchmask.observation import Observation

CUTOFFS = (0.5, 0.6, 0.7, 0.8, 0.85, 0.9, 0.95, 1.0)  # of its filter over the diffraction limit
_ARCSEC = 206265.0  # its own number of arc seconds in a radian


@dataclass(frozen=True)
class MFBDSettings:
    """Settings of torchmfbd.

    n_modes : number of Karhunen-Loeve modes without piston, which must fill a radial degree
    step : step of Adam
    noise : noise that regularises its division
    start : rms of each random first coefficient [rad]
    """

    n_modes: int
    step: float
    noise: float
    start: float = 0.1


# The best of those tried: 44 to 230 modes, steps of 0.02 to 0.1, noise of 1e-4 to 1e-2 and its own estimate, starts of
# 0 to 0.3 rad rms, apodisation, slower schedules up to 1000 iterations and a joint estimation of the object. 230 modes
# without piston are the 231 of this library; fewer are often better, and steps of 0.1 are too long for so many.
MFBD_SETTINGS = (
    MFBDSettings(230, 0.05, 1e-3),
    MFBDSettings(135, 0.05, 1e-3),
    MFBDSettings(90, 0.05, 1e-4),
)


@dataclass(frozen=True)
class MFBDStart:
    """The result of one start: its final loss, and the image (H, W) for each cut-off of the filter."""

    loss: float
    images: dict[float, Tensor]


def best_start(observation: Observation, settings: MFBDSettings, iterations: int, n_starts: int) -> MFBDStart:
    """Return the start of the lowest loss out of `n_starts` random ones."""
    starts = []
    with quietly(), torch.random.fork_rng():
        for seed in range(n_starts):
            torch.manual_seed(seed)
            starts.append(run_start(observation, settings, iterations))
    return min(starts, key=lambda start: start.loss)


def run_start(observation: Observation, settings: MFBDSettings, iterations: int) -> MFBDStart:
    """One start from random coefficients, drawn by torch's own generator."""
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
            "initialization": {"object": "contrast", "modes_std": settings.start},
            "annealing": {"type": "linear", "start_pct": 0.0, "end_pct": 0.6},
        }
    )
    frames = (observation.frames / observation.frames.mean()).float()[None]
    deconvolution.add_frames(frames, sigma=torch.full(frames.shape[:2], settings.noise))
    deconvolution.deconvolve(n_iterations=iterations)
    # Its record `loss` is never filled. This is the loss before the last step; the object has no regularisation.
    loss = float(deconvolution.loss_mse_local.detach())  # pyright: ignore[reportAttributeAccessIssue]
    images = {}
    for cutoff in CUTOFFS:
        deconvolution.update_object(cutoffs=[[cutoff - 0.05, cutoff]])
        images[cutoff] = deconvolution.obj[0][0].double().clone()
    return MFBDStart(loss, images)


@contextlib.contextmanager
def quietly() -> Iterator[None]:
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

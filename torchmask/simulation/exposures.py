"""The end-to-end simulation of a stack of short exposures.

It shares no model with the inversion: the turbulent phase is sampled within each sub-aperture rather than
expanded in modes, on a pupil raster four times as fine, whose image is four times as wide as the field, and light that
leaves the field is lost.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchmask.atmosphere.phase import TurbulencePhase
from torchmask.grid import Grid
from torchmask.observation import PHASE_OVERSAMPLING, Observation
from torchmask.optics.aperture import Aperture
from torchmask.optics.detector import Detector, image_formation
from torchmask.optics.psf import psf_from_samples
from torchmask.record import Callback, Record

_CHUNK = 2**21  # pixels of unfolded PSFs held at once


def simulate_observation(
    scene: Tensor,
    aperture: Aperture,
    grid: Grid,
    turbulence: TurbulencePhase | None,
    detector: Detector,
    n_frames: int,
    generator: torch.Generator | None = None,
    *,
    keep_phases: bool = False,
    callback: Callback | None = None,
) -> Observation:
    """Draw short exposures of a scene, end to end.

    Parameters
    ----------
    scene : (H, W) tensor
        Expected electrons per pixel and frame before any blur; its sum is the number of photons that the aperture
        collects in a frame. All of it lies within the field.
    aperture : Aperture
        One aperture, without leading axes.
    grid : Grid
    turbulence : TurbulencePhase or None
        None for a perfect atmosphere.
    detector : Detector
    n_frames : int
    generator : torch.Generator, optional
        Seeds one stream for the screens and one for the noise: another flux or read-out noise leaves the screens as
        they were.
    keep_phases : bool
        Whether the observation keeps the phase of every frame's wavefront (`Observation.phases`), to compare with a
        restored one; flat ones for a perfect atmosphere.
    callback : callable, optional
        Receives a `Record` of stage "simulation" after each chunk of frames, with the frames so far.

    Returns
    -------
    Observation
        Of the scene's dtype and device, detached; phases have the dtype of the aperture, in which they were drawn.

    Raises
    ------
    ValueError
        If the scene does not fit the grid, is negative, black or not finite, the aperture is a population,
        `n_frames` is below 1, or the grid samples the aperture too coarsely.

    Examples
    --------
    >>> from torchmask.optics.aperture import SparseAperture
    >>> from torchmask.optics.zernike import ZernikePhase
    >>> mask = SparseAperture([[0.0, 0.3], [0.3, -0.2], [-0.3, -0.2]], 0.2, 1.0)
    >>> scene = torch.zeros(32, 32, dtype=torch.float64); scene[12:20, 14:18] = 1000.0
    >>> observation = simulate_observation(
    ...     scene, mask, Grid.nyquist(1.0, 550e-9, 32), TurbulencePhase(0.15, 20.0), Detector(1.5), n_frames=4,
    ...     generator=torch.Generator().manual_seed(0))
    >>> observation.frames.shape
    torch.Size([4, 32, 32])

    How far the phases of a restoration's coefficients are from the truth, both on the same samples, [rad] rms over the
    open pupil and free of each frame's mean piston, which no image shows:

    >>> observation = simulate_observation(
    ...     scene, mask, Grid.nyquist(1.0, 550e-9, 32), TurbulencePhase(0.15, 20.0), Detector(1.5), n_frames=4,
    ...     keep_phases=True)
    >>> coefficients = torch.zeros(4, 3, 6, dtype=torch.float64)  # of a restoration: (frame, hole, mode)
    >>> phase = ZernikePhase(mask, observation.grid, n_modes=6, oversampling=PHASE_OVERSAMPLING)
    >>> wrong = phase(coefficients) - observation.phases
    >>> weights = mask.samples(observation.grid, PHASE_OVERSAMPLING).weights
    >>> wrong = wrong - (weights * wrong).sum((1, 2), keepdim=True) / weights.sum()
    >>> rms = ((weights * wrong**2).sum((1, 2)) / weights.sum()).sqrt()
    >>> rms.shape
    torch.Size([4])
    """
    scene = scene.detach()
    _check(scene, aperture, grid, n_frames)
    device = None if generator is None else generator.device
    screens_seed, noise_seed = torch.randint(2**62, (2,), generator=generator, device=device).tolist()
    noise = torch.Generator().manual_seed(noise_seed)
    with torch.no_grad():
        samples = aperture.samples(grid, PHASE_OVERSAMPLING)
        phases = None
        if turbulence is not None:
            phases = turbulence(samples, n_frames, torch.Generator().manual_seed(screens_seed))
        chunk = max(1, _CHUNK // math.prod(samples.raster))
        frames, psfs = [], []
        for first in range(0, n_frames, chunk):
            count = min(chunk, n_frames - first)
            phase = None if phases is None else phases[first : first + count]
            unfolded = psf_from_samples(samples, phase).to(scene).expand(count, *samples.raster)
            frames.append(detector(image_formation(scene, unfolded), noise))
            psfs.append(_centre(unfolded, grid.shape))
            if callback is not None:
                light = {"kept_light": float(frames[-1].sum() / (count * scene.sum()))}
                callback(Record("simulation", first + count, n_frames, light, {"frames": torch.cat(frames)}))
    if keep_phases and phases is None:
        phases = samples.weights.new_zeros(n_frames, *samples.weights.shape)
    return Observation(
        frames=torch.cat(frames),
        aperture=aperture.still(),  # a mask that trains on does not change the past
        grid=grid,
        readout_noise=detector.readout_noise,
        object=scene,
        psfs=torch.cat(psfs),
        r0=None if turbulence is None else float(turbulence.r0),
        outer_scale=None if turbulence is None else float(turbulence.outer_scale),
        n_photons=float(scene.sum()),
        phases=phases.to(scene.device) if keep_phases and phases is not None else None,
    )


def _check(scene: Tensor, aperture: Aperture, grid: Grid, n_frames: int) -> None:
    if tuple(scene.shape) != grid.shape:
        raise ValueError(f"scene has shape {tuple(scene.shape)}: the grid needs {grid.shape}")
    if not scene.is_floating_point():
        raise ValueError(f"scene has dtype {scene.dtype}: it must be floating point, in electrons per frame")
    if not bool(torch.isfinite(scene).all()):
        raise ValueError("scene holds values that are not finite")
    if float(scene.min()) < 0:
        raise ValueError(f"scene holds negative light ({float(scene.min()):.3g} electrons): clip it at 0")
    if float(scene.sum()) == 0:
        raise ValueError("scene is black: scale it so that its sum is the number of photons per frame")
    if aperture.centers.ndim != 2:
        raise ValueError(f"aperture is a population {tuple(aperture.centers.shape[:-2])}: simulate one at a time")
    if n_frames != int(n_frames) or n_frames < 1:
        raise ValueError(f"n_frames is {n_frames}: it must be a whole number of at least 1")


def _centre(psfs: Tensor, shape: tuple[int, int]) -> Tensor:
    """Crop PSFs with their origin at [0, 0] to `shape`, the origin at its middle."""
    middle = (shape[0] // 2, shape[1] // 2)
    return psfs.roll(middle, dims=(-2, -1))[..., : shape[0], : shape[1]].clone()

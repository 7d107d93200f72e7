"""End-to-end simulation of a stack of short exposures.

It shares no model with the inversion. The turbulent phase is sampled within each sub-aperture rather than expanded in
modes, on a pupil raster four times as fine, so that the image is four times as wide as the field, and light that leaves
the field is lost.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torchmask.atmosphere.screens import draw_seed
from torchmask.grid import Grid
from torchmask.memory import require_memory
from torchmask.numbers import whole_number
from torchmask.observation import Observation
from torchmask.optics.aperture import Aperture
from torchmask.optics.detector import Detector, image_formation
from torchmask.optics.overlaps import require_apart
from torchmask.plain import require_type
from torchmask.record import Callback, Record
from torchmask.simulation.conditions import Conditions
from torchmask.simulation.exposed_psf import ExposedPSF
from torchmask.simulation.field import SPACING, FieldPoint, field_points
from torchmask.simulation.wavefronts import (
    Turbulence,
    Wavefront,
    exposure_delays,
    isoplanatic_angle,
    wavefronts,
    with_layers,
)

_CHUNK = 2**21  # pixels of unfolded PSFs whose frames are processed together
_MIDDLE = (0.0, 0.0)  # direction [rad] of the middle of the field


def simulate_observation(
    scene: Tensor,
    aperture: Aperture,
    grid: Grid,
    turbulence: Turbulence,
    detector: Detector,
    n_frames: int,
    generator: torch.Generator | None = None,
    *,
    conditions: Conditions | None = None,
    told: Aperture | None = None,
    keep_phases: bool = False,
    allow_overlap: bool = False,
    callback: Callback | None = None,
) -> Observation:
    """Simulate short exposures of a scene, end to end.

    Parameters
    ----------
    scene : (H, W) tensor
        Expected electrons per pixel and frame before any blur, none of them outside the field. The sum is the number
        of photons that the aperture collects in a frame.
    aperture : Aperture
        One aperture, without leading axes.
    grid : Grid
        Pixels and wavelength of the frames.
    turbulence : TurbulencePhase, LayeredPhase or None
        Random phase of the atmosphere; None for a perfect one. With layers at height the PSF varies over the field.
    detector : Detector
        Pixels and noise of the detector.
    n_frames : int
        Number of exposures.
    generator : torch.Generator, optional
        Source of randomness. It seeds separate streams for the screens and for the noise, so the screens do not depend
        on the flux or the read-out noise.
    conditions : Conditions, optional
        Sky, transparency, exposure time and band. By default, monochromatic snapshots on a black sky.
    told : Aperture, optional
        Aperture that the observer believes was used, if it differs from `aperture`. The observation then has it as its
        `aperture` and the real one as its `true_aperture`.
    keep_phases : bool
        Whether the observation keeps the phase of every frame in the middle of the field (`Observation.phases`), for
        comparison with a restored one. Only for monochromatic snapshots.
    allow_overlap : bool
        Whether holes of the mask may overlap, as in some real masks; light in overlaps counts twice.
    callback : callable, optional
        Receives a `Record` of stage "simulation" after each frame, with the share of the scene's light that falls into
        the field, and after each chunk of frames the frames so far.

    Returns
    -------
    Observation
        Frames and truth with the dtype and device of the scene, detached; phases have the dtype of the aperture. Where
        gradients are to flow, chain `psf_from_samples`, `image_formation` and `Detector(noise="gaussian")`.

    Raises
    ------
    ValueError
        If the scene does not fit the grid or is negative, black or not finite; the aperture is a population; its holes
        overlap by more than a millionth of its diameter and `allow_overlap` is not given; `n_frames` is below 1; the
        grid samples the aperture too coarsely at the shortest wavelength; `exposure_time` is given but the turbulence
        has no wind, or it exceeds the time between frames or a thousand times tau0; or `keep_phases` is combined with
        `exposure_time`, `band` or `told`.
    TypeError
        If the scene is no tensor, or `aperture`, `grid`, `detector` or `generator` of another type than it must be.

    Examples
    --------
    >>> from torchmask.optics.aperture import SparseAperture
    >>> from torchmask.atmosphere.phase import TurbulencePhase
    >>> from torchmask.observation import PHASE_OVERSAMPLING
    >>> from torchmask.optics.zernike import ZernikePhase
    >>> mask = SparseAperture([[0.0, 0.3], [0.3, -0.2], [-0.3, -0.2]], 0.2, 1.0)
    >>> scene = torch.zeros(32, 32, dtype=torch.float64); scene[12:20, 14:18] = 1000.0
    >>> observation = simulate_observation(
    ...     scene, mask, Grid.nyquist(1.0, 550e-9, 32), TurbulencePhase(0.15, 20.0), Detector(1.5), n_frames=4,
    ...     generator=torch.Generator().manual_seed(0))
    >>> observation.frames.shape
    torch.Size([4, 32, 32])

    The rms error [rad] of restored phases over the open pupil, without the mean piston of each frame, which no image
    shows:

    >>> observation = simulate_observation(
    ...     scene, mask, Grid.nyquist(1.0, 550e-9, 32), TurbulencePhase(0.15, 20.0), Detector(1.5), n_frames=4,
    ...     keep_phases=True)
    >>> coefficients = torch.zeros(4, 3, 6, dtype=torch.float64)  # from a restoration: (frame, hole, mode)
    >>> phase = ZernikePhase(mask, observation.grid, n_modes=6, oversampling=PHASE_OVERSAMPLING)
    >>> wrong = phase(coefficients) - observation.phases
    >>> weights = mask.samples(observation.grid, PHASE_OVERSAMPLING).weights
    >>> wrong = wrong - (weights * wrong).sum((1, 2), keepdim=True) / weights.sum()
    >>> rms = ((weights * wrong**2).sum((1, 2)) / weights.sum()).sqrt()
    >>> rms.shape
    torch.Size([4])
    """
    conditions = conditions or Conditions()
    _check_types(scene, generator)
    require_instruments(aperture, grid, detector)
    scene = scene.detach()
    n_frames = whole_number("n_frames", n_frames)
    _check(scene, aperture, grid)
    require_apart(aperture, allow_overlap)
    require_memory("n_frames", n_frames, 2.0 * n_frames * scene.numel() * scene.element_size())  # frames and PSFs
    turbulence = with_layers(turbulence, grid.wavelength)
    delays = exposure_delays(turbulence, conditions.exposure_time)
    if keep_phases and (len(delays) > 1 or conditions.band is not None or told is not None):
        raise ValueError(
            "keep_phases needs monochromatic snapshots through a known aperture: leave out exposure_time, band and "
            "told, or keep_phases"
        )
    device = None if generator is None else generator.device
    screens_seed, noise_seed = torch.randint(2**62, (2,), generator=generator, device=device).tolist()
    noise = torch.Generator().manual_seed(noise_seed)
    with torch.no_grad():
        optics = ExposedPSF(aperture, grid, conditions.band, detector.pixel)
        points = field_points(scene, grid, SPACING * isoplanatic_angle(turbulence))
        transmission = _draw_transmission(n_frames, conditions.transparency_scatter, generator).to(scene)
        screens = torch.Generator().manual_seed(screens_seed)
        stream = wavefronts(turbulence, optics.samples, n_frames, delays, screens)
        frames, psfs, phases = scene.new_empty(n_frames, *grid.shape), scene.new_empty(n_frames, *grid.shape), []
        chunk, kept = max(1, _CHUNK // math.prod(optics.samples.raster)), 0.0
        for first in range(0, n_frames, chunk):
            now = range(first, min(first + chunk, n_frames))
            for t, wavefront in zip(now, stream, strict=False):
                frames[t], psfs[t] = _expose(points, optics, wavefront, scene)
                if keep_phases:
                    phases += wavefront(_MIDDLE)
                kept += float(frames[t].sum() / scene.sum())
                if callback is not None and t + 1 < now.stop:
                    callback(Record("simulation", t + 1, n_frames, {"kept_light": kept / (t + 1)}))
            expected = transmission[first : now.stop, None, None] * frames[first : now.stop] + conditions.sky
            frames[first : now.stop] = detector(expected, noise)
            if callback is not None:
                light, arrays = {"kept_light": kept / now.stop}, {"frames": frames[: now.stop]}
                callback(Record("simulation", now.stop, n_frames, light, arrays))
    return Observation(
        frames=frames,
        aperture=(told or aperture).still(),  # a copy, because the caller's mask may be trained later
        grid=grid,
        readout_noise=detector.readout_noise,
        object=scene,
        psfs=psfs,
        r0=None if turbulence is None else float(turbulence.r0),
        outer_scale=None if turbulence is None else float(turbulence.outer_scale),
        n_photons=float(scene.sum()),
        phases=_stack_phases(phases, optics.samples.weights).to(scene.device) if keep_phases else None,
        background=conditions.sky,
        transmission=transmission,
        true_aperture=None if told is None else aperture.still(),
        pixel=detector.pixel,
        header={"XPOSURE": conditions.exposure_time} if conditions.exposure_time else {},
    )


def _expose(
    points: Sequence[FieldPoint], optics: ExposedPSF, wavefront: Wavefront, scene: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the expected image (H, W) of one frame without sky, and the centred PSF of the middle of the field."""
    images, centred = [], None
    for direction, light in points:
        psf = optics(wavefront(direction)).to(scene)
        images.append(image_formation(light, psf))
        if direction == _MIDDLE:
            centred = psf
    if centred is None:
        centred = optics(wavefront(_MIDDLE)).to(scene)
    return functools.reduce(torch.add, images), _centre(centred, (scene.shape[0], scene.shape[1]))


def _draw_transmission(n_frames: int, scatter: float, generator: torch.Generator | None) -> Tensor:
    """Draw the transmission (n_frames,) of each frame, log-normal with mean 1, from a stream of its own."""
    if scatter == 0:
        return torch.ones(n_frames, dtype=torch.float64, device="cpu")
    own = torch.Generator().manual_seed(draw_seed(generator))
    normal = torch.randn(n_frames, generator=own, dtype=torch.float64, device="cpu")
    return torch.exp(scatter * normal - scatter**2 / 2)


def _stack_phases(phases: Sequence[Tensor | None], like: Tensor) -> Tensor:
    return torch.stack([torch.zeros_like(like) if phase is None else phase for phase in phases])


def require_instruments(aperture: Any, grid: Any, detector: Any) -> None:
    """Raise TypeError unless these are an aperture, a grid and a detector."""
    require_type("aperture", aperture, Aperture, "SparseAperture.from_catalog('golay6', 1.0, 0.15)")
    require_type("grid", grid, Grid, "Grid.nyquist(1.0, 550e-9, 128)")
    require_type("detector", detector, Detector, "Detector(readout_noise=1.5)")


def _check_types(scene: Any, generator: Any) -> None:
    if not isinstance(scene, Tensor):
        raise TypeError(f"scene is a {type(scene).__name__}: it must be a tensor (H, W), such as torch.tensor(scene)")
    if not isinstance(generator, torch.Generator | None):
        raise TypeError(
            f"generator is {generator!r}: it must be a torch.Generator, such as torch.Generator().manual_seed(0)"
        )


def _check(scene: Tensor, aperture: Aperture, grid: Grid) -> None:
    if tuple(scene.shape) != grid.shape:
        raise ValueError(f"scene has shape {tuple(scene.shape)}: the grid needs {grid.shape}")
    if scene.dtype not in (torch.float32, torch.float64):
        raise ValueError(f"scene has dtype {scene.dtype}: it must be float32 or float64, in electrons per frame")
    if not bool(torch.isfinite(scene).all()):
        raise ValueError("scene holds values that are not finite")
    if float(scene.min()) < 0:
        raise ValueError(f"scene holds negative light ({float(scene.min()):.3g} electrons): clip it at 0")
    if float(scene.sum()) == 0:
        raise ValueError("scene is black: scale it so that its sum is the number of photons per frame")
    if aperture.centers.ndim != 2:
        raise ValueError(f"aperture is a population {tuple(aperture.centers.shape[:-2])}: simulate one at a time")


def _centre(psfs: Tensor, shape: tuple[int, int]) -> Tensor:
    """Crop PSFs with their origin at [0, 0] to `shape`, with the origin in the middle."""
    middle = (shape[0] // 2, shape[1] // 2)
    return psfs.roll(middle, dims=(-2, -1))[..., : shape[0], : shape[1]].clone()

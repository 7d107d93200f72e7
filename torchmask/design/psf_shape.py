"""The point-spread function of a mask in closed form, its width and its side lobes.

It is the squared transform of a hole times the squared mean of the holes' phasors. Frequencies are angles on the sky
divided by the wavelength [1/m].
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter
from scipy.optimize import minimize

from torchmask.optics.pupil import Aperture

Array = NDArray[np.float64]

_DIRECTIONS = 180  # directions in which the width is measured
_BLOCK = 2**20  # array elements processed at a time


def mask_psf(frequency: Array, centers: Array, aperture: Aperture) -> Array:
    """Return the PSF, relative to its peak, at `frequency` (..., 2) [1/m]."""
    phasors = np.exp(-2j * np.pi * (frequency @ centers.T)).mean(-1)
    intensity: Array = phasors.real**2 + phasors.imag**2
    return _hole_power(frequency, aperture) * intensity


def _hole_power(frequency: Array, aperture: Aperture) -> Array:
    """Return the PSF of a single hole relative to its peak."""
    return np.abs(aperture.shape.amplitude(frequency, aperture.subaperture_diameter)) ** 2


def psf_widths(centers: Array, aperture: Aperture) -> Array:
    """Return the full width at half maximum in directions all around [1/m]."""
    angles = np.arange(_DIRECTIONS) * np.pi / _DIRECTIONS
    directions = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    # The PSF of a hole as wide as its diameter drops to one half within 0.52 / d, that of a narrower one further out.
    # Steps much smaller than a fringe find the first crossing.
    limit, step = 0.6 / aperture.subaperture_diameter, 0.02 / aperture.extent
    below = np.zeros((1, 0), dtype=bool)
    while not below.any(axis=1).all():
        radii = np.arange(1, math.ceil(limit / step) + 1) * step
        below = np.stack([mask_psf(radii[:, None] * e, centers, aperture) for e in directions]) < 0.5
        limit *= 2
    high = step * (below.argmax(axis=1) + 1)
    low = high - step
    for _ in range(40):
        middle = (low + high) / 2
        above = mask_psf(middle[:, None] * directions, centers, aperture) >= 0.5
        low, high = np.where(above, middle, low), np.where(above, high, middle)
    return np.asarray(low + high, dtype=np.float64)


def peak_side_lobe(centers: Array, aperture: Aperture) -> float:
    """Return the highest local maximum of the PSF besides the one at 0."""
    scale = aperture.extent
    highest = 0.0
    for start, value in _grid_maxima(centers, aperture, 1 / (6 * scale)):
        if value < 0.8 * highest:
            break  # with six samples per fringe, a maximum is not that much higher than its best sample
        result = minimize(lambda f: -float(mask_psf(f / scale, centers, aperture)), start * scale, method="BFGS")
        if np.abs(result.x - start * scale).max() < 0.25:  # otherwise it climbed to another maximum
            highest = max(highest, -float(result.fun))
    return highest


def _grid_maxima(centers: Array, aperture: Aperture, step: float) -> Iterator[tuple[Array, float]]:
    """Iterate over the PSF's local maxima on a grid, except the origin, the highest first: (frequency [1/m], value)."""
    n = math.ceil(2.5 / aperture.subaperture_diameter / step)
    x = np.arange(-n, n + 1) * step
    found = []
    rows = max(1, _BLOCK // len(x))
    for bottom in range(0, n + 1, rows):
        y = np.arange(bottom - 1, min(bottom + rows, n + 1) + 1) * step  # with one more row on either side
        columns = np.exp(-2j * np.pi * x[:, None] * centers[:, 0])
        phasors = (np.exp(-2j * np.pi * y[:, None] * centers[:, 1]) @ columns.T) / len(centers)
        plane = np.stack(np.broadcast_arrays(x, y[:, None]), axis=-1)
        psf = np.abs(phasors) ** 2 * _hole_power(plane, aperture)
        peak = (psf == maximum_filter(psf, size=3)) & (np.abs(plane) > step / 2).any(-1)
        peak[[0, -1]] = False
        found += zip(plane[peak], psf[peak].tolist(), strict=True)
    return iter(sorted(found, key=lambda maximum: -maximum[1]))

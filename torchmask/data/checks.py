"""Checks of the options and of the files of which `read_observation` makes a stack."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from torchmask.data import keywords
from torchmask.data.calibration import SELECTIONS
from torchmask.data.fits import FITSImages
from torchmask.grid import ARCSEC
from torchmask.numbers import require_wavelength
from torchmask.optics.sky import pixel_matrix
from torchmask.optics.sky_scale import is_same, warn_of_other_scales
from torchmask.plain import require_plain

_WIDEST = 0.01  # [rad], above the pixels of any image, and below most numbers of arcseconds

# Cards of the parallactic angle [degrees]: of Keck and many others, and of ESO at the start and the end of a file.
_PARALLACTIC = ("PARANG", "ESO TEL PARANG START", "ESO TEL PARANG END")

_POSITIVE = {
    "wavelength": "m",
    "design_wavelength": "m",
    "pixel_scale": "rad",
    "design_pixel_scale": "rad",
    "gain": "electrons per adu",
    "exposure_time": "s",
    "saturation": "the unit of the file",
}


def check_options(
    positive: Mapping[str, float | None],
    readout_noise: float | None,
    keep: float | None,
    keep_by: str,
    unit: str | None,
) -> None:
    """Raise ValueError if an option is out of range, TypeError if one is of a wrong type.

    `positive` has the options in `_POSITIVE` by name; all arguments are as those of `read_observation`.
    """
    if not isinstance(unit, str | None):
        raise TypeError(f"unit is a {type(unit).__name__}: it must be text, such as {str(unit)!r} or 'electron'")
    for name, what in _POSITIVE.items():
        require_plain(name, value := positive[name])
        if value is not None and not (math.isfinite(value) and value > 0):
            raise ValueError(f"{name} is {value}: it must be finite and positive, in {what}")
        if "wavelength" in name:
            require_wavelength(name, value)
        if value is not None and "pixel_scale" in name and value > _WIDEST:
            raise ValueError(
                f"{name} is {value}: it must be an angle in rad, at most {_WIDEST}; {value:g} arcsec are "
                f"{value * ARCSEC:.4g} rad"
            )
    require_plain("readout_noise", readout_noise)
    if readout_noise is not None and not (math.isfinite(readout_noise) and readout_noise >= 0):
        raise ValueError(f"readout_noise is {readout_noise}: it must be finite and at least 0, in electrons rms")
    if keep is not None and not 0 < keep <= 1:
        raise ValueError(f"keep is {keep}: it must be a fraction of the frames, above 0 and at most 1")
    if keep_by not in SELECTIONS:
        raise ValueError(f"keep_by is {keep_by!r}: it must be {' or '.join(SELECTIONS)}")
    if keep is None and keep_by != SELECTIONS[0]:
        raise ValueError(f"keep_by is {keep_by!r}, but all frames are kept: give keep, the fraction of the best, too")


def check_alike(files: Sequence[FITSImages], wavelengths: Sequence[float], scales: Sequence[float]) -> None:
    """Raise ValueError unless all files have one filter, wavelength, pixel scale and shape."""
    kinds: tuple[tuple[str, Sequence[Any], Any], ...] = (
        ("filters", [str(file.header.get("FILTER", "")).strip() for file in files], str),
        ("wavelengths", wavelengths, lambda value: f"{value:.5g} m"),
        ("pixel scales", scales, lambda value: f"{value / ARCSEC:.5g} arcsec"),
        ("image shapes", [file.values.shape[1:] for file in files], str),
    )
    for what, values, format_value in kinds:
        for file, value in zip(files, values, strict=True):
            alike = abs(value / values[0] - 1) < 1e-3 if isinstance(value, float) else value == values[0]
            if not alike:
                raise ValueError(
                    f"the files mix {what}: {files[0].path} has {format_value(values[0])} and {file.path} "
                    f"{format_value(value)}; read them separately"
                )


def check_given_scale(files: Sequence[FITSImages], given: float | None) -> None:
    """Warn of the first file whose header contradicts the pixel scale [rad] that is given, and how many others do."""
    if given is None:
        return
    stated = [keywords.stated_scales(file.header) for file in files]
    wrong = [any(scale and not is_same(scale, given) for scale in scales.values()) for scales in stated]
    if any(wrong):
        first, rest = wrong.index(True), sum(wrong) - 1
        also = f" (and {rest} other files)" if rest else ""
        warn_of_other_scales(files[first].path, given, stated[first], also, stacklevel=4)


def check_rotation(files: Sequence[FITSImages], size: int) -> None:
    """Raise ValueError if a file is rotated or mirrored relative to the first by more than half a pixel at a corner.

    The first is the first with sky coordinates. Warns if some have none.
    """
    matrices = [pixel_matrix(file.header) for file in files]
    placed = [(file, matrix) for file, matrix in zip(files, matrices, strict=True) if matrix is not None]
    for file, matrix in placed[1:]:
        first, reference = placed[0]
        moved = np.abs((np.linalg.inv(reference) @ matrix - np.eye(2)) @ [[1, 1], [1, -1]]).max() * size / 2
        if moved > 0.5:
            raise ValueError(
                f"the files mix orientations: the corner of {file.path} lies {moved:.1f} pixels from that of "
                f"{first.path} on the sky; read files of different orientations separately"
            )
    if 0 < len(placed) < len(files):
        lacking = [file.path.name for file, matrix in zip(files, matrices, strict=True) if matrix is None]
        warnings.warn(
            f"only {len(placed)} of {len(files)} files have sky coordinates: those of {placed[0][0].path.name} are "
            f"taken for all, so see that {', '.join(lacking[:4])}{' and others' * (len(lacking) > 4)} lie on the sky "
            "as it does",
            stacklevel=3,
        )


def check_field_rotation(files: Sequence[FITSImages], shape: tuple[int, int], resolution: float) -> None:
    """Warn if the sky may have turned in the field (H, W): if the parallactic angle moves a corner by half a
    `resolution` [pixels]."""
    angles = {name: [file.header.get(name) for file in files] for name in _PARALLACTIC}
    told = [a for values in angles.values() for a in values if isinstance(a, int | float) and math.isfinite(a)]
    turned, radius = _arc(told), math.hypot(*shape) / 2
    moved = 2 * radius * math.sin(math.radians(turned) / 2)
    if moved <= resolution / 2:
        return
    most = 2 * math.degrees(math.asin(min(1.0, resolution / 4 / radius)))
    names = ", ".join(name for name, values in angles.items() if any(value is not None for value in values))
    warnings.warn(
        f"the parallactic angle ({names}) changes by {turned:.1f} degrees among these frames: unless a derotator or an "
        f"equatorial mount held the sky still, it turned by as much, the corner of the field by {moved:.1f} pixels, "
        f"and the restoration is blurred. Restore shorter runs by themselves then, each of up to {most:.1f} degrees; "
        "frames of a full pupil may be turned to one orientation instead, those of a mask not, as its pattern would "
        "turn with them",
        stacklevel=3,
    )


def _arc(angles: Sequence[float]) -> float:
    """Return the shortest arc that holds all angles [degrees], at most half a turn; 0 if there are none."""
    around = np.sort(np.mod(angles, 360.0))
    if not around.size:
        return 0.0
    gaps = np.diff(around, append=around[0] + 360)
    return min(180.0, 360.0 - float(gaps.max()))

"""Which frames of a stack hold light: those of a closed shutter and negative ones are left out, clouds are told.

Frames (T, H, W) are NumPy arrays, `valid` (T, H, W) is True where a pixel can be trusted. Frames are numbered from 0.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np

_UNLIT = 0.05  # of the light of the other frames: what is left of it is noise and an uneven dark
_CLEAR = 5.0  # times its own noise: light that others can be compared with
_CLOUD = 0.5  # of the light of the other frames
_OUTLIER = 5.0  # times the scatter of the logarithm of the light
_SIGMA = 1.4826  # standard deviation over median absolute deviation, of normal numbers
_FEWEST = 3  # frames that can tell what is usual


def usable_frames(frames: np.ndarray, valid: np.ndarray, skip: Sequence[int] = ()) -> np.ndarray:
    """Numbers of the frames that are not to be skipped and hold light, in their order.

    Warns of frames that are left out because they have no valid pixel, their light is not positive or they are unlit,
    and of frames that stay although a cloud seems to have passed.

    Raises ValueError if `skip` names a frame that is not there, or no frame is left.
    """
    wrong = [number for number in skip if not 0 <= number < len(frames)]
    if wrong:
        raise ValueError(f"skip names frame {wrong[0]}, but the stack has {len(frames)}, counted from 0")
    kept = np.setdiff1d(np.arange(len(frames)), list(skip))
    if not kept.size:
        raise ValueError(f"skip leaves none of the {len(frames)} frames")
    total = np.where(valid, frames, 0.0).sum((1, 2))
    kept = _leave_out(kept, np.logical_not(valid.any((1, 2))), "have no valid pixel")
    kept = _leave_out(kept, np.asarray(total <= 0), "hold no light: the sum of their valid pixels is not positive")
    unlit = np.zeros(len(frames), dtype=bool)
    unlit[kept] = find_unlit(frames[kept], valid[kept])
    kept = _leave_out(kept, unlit, "show nothing of what the others show, as with a closed shutter")
    clouded = kept[find_clouds(frames[kept], valid[kept])]
    if clouded.size:
        warnings.warn(
            f"frames {clouded.tolist()} have less than half the light of the others, as through a cloud; skip leaves "
            "them out",
            stacklevel=3,
        )
    return kept


def _leave_out(kept: np.ndarray, bad: np.ndarray, why: str) -> np.ndarray:
    """The frames `kept` that are not `bad`, with a warning that names the others. Raises ValueError if all are."""
    lost = kept[bad[kept]]
    if lost.size == kept.size:
        raise ValueError(f"frames {lost.tolist()} {why}, and no other is left")
    if lost.size:
        warnings.warn(
            f"frames {lost.tolist()} {why}: they are left out, and what follows counts the {kept.size - lost.size} "
            "that are left",
            stacklevel=4,
        )
    return kept[~bad[kept]]


def frame_light(frames: np.ndarray, valid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What each frame holds above the median of its border (T,), and the standard deviation that noise gives it (T,).

    A constant, such as a sky or a bias, does not count. The noise is that of the border's pixels, without photon noise
    of the light itself.
    """
    border = np.zeros(frames.shape[1:], dtype=bool)
    border[[0, -1]] = border[:, [0, -1]] = True
    light, noise = np.zeros(len(frames)), np.zeros(len(frames))
    for number, (frame, good) in enumerate(zip(frames, valid, strict=True)):
        rim = frame[border & good]
        level = float(np.median(rim)) if rim.size else 0.0
        spread = _SIGMA * float(np.median(np.abs(rim - level))) if rim.size else 0.0
        count = int(good.sum())
        light[number] = float((frame[good] - level).sum())
        # the pixels' own noise, and that of the level, a median, which is taken off them all
        noise[number] = spread * np.sqrt(count + np.pi / 2 * count**2 / max(rim.size, 1))
    return light, noise


def find_unlit(frames: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """(T,) True for frames that have next to no light above their border and nothing of the mean image's structure.

    A star that was moved far keeps its light, and an object as wide as the field its structure: neither is unlit.
    None is where the frames are too faint, or fewer than three, to tell.
    """
    light, noise = frame_light(frames, valid)
    usual = float(np.median(light))
    if len(frames) < _FEWEST or not usual > _CLEAR * float(np.median(noise)):
        return np.zeros(len(frames), dtype=bool)
    return (light < _UNLIT * usual) & (_likeness(frames, valid) < _UNLIT)


def _likeness(frames: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """(T,) how strongly the mean image stands in each frame, beside a constant: 1 in the mean over frames."""
    lit = np.where(valid, frames, 0.0)
    mean = lit.sum(0) / np.maximum(valid.sum(0), 1)
    found = np.zeros(len(frames))
    for number, (frame, good) in enumerate(zip(frames, valid, strict=True)):
        pattern = mean[good] - mean[good].mean()
        found[number] = pattern @ frame[good] / max(pattern @ pattern, np.finfo(float).tiny)
    return found


def find_clouds(frames: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """(T,) True for frames with less than half the usual light, if that is far beyond the scatter of the others."""
    light, noise = frame_light(frames, valid)
    usual = float(np.median(light))
    if len(frames) < _FEWEST or not usual > _CLEAR * float(np.median(noise)):
        return np.zeros(len(frames), dtype=bool)
    share = np.log(np.maximum(light / usual, np.finfo(float).tiny))
    scatter = _SIGMA * float(np.median(np.abs(share)))
    return share < min(np.log(_CLOUD), -_OUTLIER * scatter)

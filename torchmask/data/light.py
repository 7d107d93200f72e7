"""Selection of the frames that hold light, and detection of clouds.

Frames (T, H, W) are NumPy arrays; `valid` (T, H, W) is True where a pixel is trustworthy.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np
import torch

from torchmask.data import keywords
from torchmask.data.fits import FITSImages
from torchmask.observation import Observation, number_frames

_UNLIT = 0.05  # fraction of the usual light below which a frame is unlit; an uneven dark may leave some
_CLEAR = 5.0  # signal-to-noise ratio of the usual light that allows a comparison
_CLOUD = 0.5  # fraction of the usual light below which a frame may be clouded
_OUTLIER = 5.0  # scatters of the logarithm of the light beyond which a frame is an outlier
_SIGMA = 1.4826  # standard deviation over median absolute deviation of a normal distribution
_FEWEST = 3  # smallest number of frames that define what is usual


def usable_frames(
    frames: np.ndarray, valid: np.ndarray, skip: Sequence[int] = (), numbers: Sequence[int] = ()
) -> np.ndarray:
    """Return the positions of the frames that hold light and are not in `skip`, in ascending order.

    `skip` and all messages name frames by `numbers` (T,), or by their positions, from 0, if none are given.

    Warns about frames that are left out because they have no valid pixel, no positive sum or no light of the target,
    and about frames that are kept although a cloud seems to have passed.

    Raises ValueError if `skip` names a frame that does not exist, or no frame is left.
    """
    named = np.array(number_frames(numbers, len(frames)))
    wrong = [number for number in skip if number not in named]
    if wrong:
        raise ValueError(
            f"skip names frame {wrong[0]}, but the stack has {len(frames)} frames, with numbers from {named.min()} to "
            f"{named.max()}"
        )
    kept = np.flatnonzero(~np.isin(named, list(skip)))
    if not kept.size:
        raise ValueError(f"skip leaves none of the {len(frames)} frames")
    total = np.where(valid, frames, 0.0).sum((1, 2))
    kept = _leave_out(kept, named, np.logical_not(valid.any((1, 2))), "have no valid pixel")
    kept = _leave_out(kept, named, total <= 0, "hold no light: the sum of their valid pixels is not positive")
    unlit = np.zeros(len(frames), dtype=bool)
    unlit[kept] = find_unlit(frames[kept], valid[kept])
    kept = _leave_out(kept, named, unlit, "show nothing of what the others show, as with a closed shutter")
    clouded = kept[find_clouds(frames[kept], valid[kept])]
    if clouded.size:
        warnings.warn(
            f"frames {named[clouded].tolist()} have less than half the light of the others, as through a cloud: "
            "they stay unless you skip them",
            stacklevel=3,
        )
    return kept


def opened_files(
    files: Sequence[FITSImages], skip: Sequence[int]
) -> tuple[list[FITSImages], tuple[int, ...], list[int]]:
    """Return the files taken with an open shutter, the numbers of their frames, and those to skip among these.

    Warns about other files; raises ValueError if there are only those.
    """
    closed = {file.path: keywords.closed_shutter(file.header) for file in files}
    told = "; ".join(f"{path}: {why}" for path, why in closed.items() if why)
    opened = [file for file in files if not closed[file.path]]
    if not opened:
        raise ValueError(f"no file holds light ({told}): give exposures of the target")
    if told:
        warnings.warn(f"files without light are left out ({told}); to subtract a dark, give dark", stacklevel=3)
    starts = np.cumsum([0] + [len(file.values) for file in files])
    dark = {
        number
        for file, start in zip(files, starts, strict=False)
        if closed[file.path]
        for number in range(start, start + len(file.values))
    }
    numbers = tuple(number for number in range(starts[-1]) if number not in dark)
    return opened, numbers, [number for number in skip if number not in dark]


def clouded_frames(observation: Observation) -> list[int]:
    """Return the `frame_numbers` of an observation's frames that seem to have been taken through a cloud."""
    frames = observation.frames
    valid = torch.isfinite(frames) if observation.valid is None else observation.valid.expand_as(frames)
    clouded = np.flatnonzero(find_clouds(frames.numpy(force=True), valid.numpy(force=True)))
    return [observation.frame_numbers[position] for position in clouded]


def _leave_out(kept: np.ndarray, named: np.ndarray, bad: np.ndarray, why: str) -> np.ndarray:
    """Return the frames `kept` that are not `bad`, with a warning that names the others. ValueError if none is left."""
    lost = named[kept[bad[kept]]]
    if lost.size == kept.size:
        raise ValueError(f"frames {lost.tolist()} {why}, and no other is left")
    if lost.size:
        warnings.warn(
            f"frames {lost.tolist()} {why}: they are left out, and {kept.size - lost.size} remain",
            stacklevel=4,
        )
    return kept[~bad[kept]]


def frame_light(frames: np.ndarray, valid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the light of each frame above the median of its border (T,), and its standard deviation (T,).

    A constant, such as a sky or a bias, cancels. The standard deviation follows from the noise of the border's pixels
    and does not include the photon noise of the light itself.
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
        # noise of the pixels, and of the level, a median, that is subtracted from all of them
        noise[number] = spread * np.sqrt(count + np.pi / 2 * count**2 / max(rim.size, 1))
    return light, noise


def find_unlit(frames: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Return (T,) True for frames with almost no light above their border and no trace of the mean image.

    Both conditions are needed: a star that has moved far keeps its light, and an object as wide as the field keeps its
    structure. All are False if the frames are too faint, or fewer than three.
    """
    light, noise = frame_light(frames, valid)
    usual = float(np.median(light))
    if len(frames) < _FEWEST or not usual > _CLEAR * float(np.median(noise)):
        return np.zeros(len(frames), dtype=bool)
    return (light < _UNLIT * usual) & (_likeness(frames, valid) < _UNLIT)


def _likeness(frames: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Return the amplitude (T,) of the mean image in each frame, besides a constant; its mean over frames is 1."""
    lit = np.where(valid, frames, 0.0)
    mean = lit.sum(0) / np.maximum(valid.sum(0), 1)
    found = np.zeros(len(frames))
    for number, (frame, good) in enumerate(zip(frames, valid, strict=True)):
        pattern = mean[good] - mean[good].mean()
        found[number] = pattern @ frame[good] / max(pattern @ pattern, np.finfo(float).tiny)
    return found


def find_clouds(frames: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Return (T,) True for frames with less than half the usual light, if that is far outside the usual scatter."""
    light, noise = frame_light(frames, valid)
    usual = float(np.median(light))
    if len(frames) < _FEWEST or not usual > _CLEAR * float(np.median(noise)):
        return np.zeros(len(frames), dtype=bool)
    share = np.log(np.maximum(light / usual, np.finfo(float).tiny))
    scatter = _SIGMA * float(np.median(np.abs(share)))
    return share < min(np.log(_CLOUD), -_OUTLIER * scatter)

"""Steps from raw images to frames: dark and flat correction, bad pixels, finding the target, frame selection, drift.

All functions take and return NumPy arrays: frames (T, H, W), and `valid` (T, H, W), True where a pixel is trustworthy.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from torchmask.io import extra
from torchmask.optics.bad_pixels import fill_bad_pixels

SELECTIONS = ("sharpness", "flux")


def calibrate(
    values: np.ndarray,
    valid: np.ndarray,
    dark: np.ndarray | None = None,
    flat: np.ndarray | None = None,
    bad_pixels: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Correct raw images: (values - dark) / flat, with the flat divided by its median over good pixels.

    Parameters
    ----------
    values : (T, H, W) array
        Raw images.
    valid : (T, H, W) array
        Which pixels are valid.
    dark : (H, W) array, optional
        Dark image in the units of `values`.
    flat : (H, W) array, optional
        Flat field, of any scale.
    bad_pixels : (H, W) array, optional
        Bad-pixel map, not 0 where a pixel is bad.

    Returns
    -------
    values : (T, H, W) array
        Corrected images, with 0 in place of values that are not finite.
    valid : (T, H, W) array
        Which pixels are valid in the images, the dark, the flat and the bad-pixel map.
    sensitivity : (H, W) array
        Normalised flat, by which the images were divided.

    Raises
    ------
    ValueError
        If a shape differs from that of the images, the bad-pixel map marks every pixel, or the flat is positive on no
        good pixel.
    """
    for name, image in (("dark", dark), ("flat", flat), ("bad_pixels", bad_pixels)):
        if image is not None and image.shape != values.shape[1:]:
            raise ValueError(f"{name} has shape {image.shape}: it must be that of the images, {values.shape[1:]}")
    good = np.ones(values.shape[1:], dtype=bool) if bad_pixels is None else bad_pixels == 0
    if not good.any():
        raise ValueError("bad_pixels marks every pixel as bad: give a map that is 0 on good pixels, perhaps inverted")
    sensitivity = np.ones(values.shape[1:])
    if dark is not None:
        good &= np.isfinite(dark)
        values = values - np.nan_to_num(dark)
    if flat is not None:
        lit = np.isfinite(flat) & (flat > 0)
        good &= lit
        if not good.any():
            raise ValueError("flat is positive on no good pixel: check flat and bad_pixels")
        sensitivity = np.where(lit, flat, 1.0) / np.median(flat[good])
        values = values / sensitivity
    return np.where(np.isfinite(values), values, 0.0), valid & good, sensitivity


def find_target(frames: np.ndarray, valid: np.ndarray, blur: float) -> tuple[int, int]:
    """Return (row, column) where the mean frame, blurred by a Gaussian of `blur` pixels rms, is brightest."""
    from scipy.ndimage import gaussian_filter

    mean = gaussian_filter(_filled(frames, valid).mean(0), blur, mode="nearest")
    row, column = np.unravel_index(mean.argmax(), mean.shape)
    return int(row), int(column)


def crop_corner(shape: tuple[int, int], target: tuple[int, int], size: int) -> tuple[int, int]:
    """Return the first (row, column) of a `size` x `size` field with `target` on its pixel [size // 2, size // 2].

    Raises ValueError if the target lies outside the image, or the field reaches beyond it; the message gives the
    rows and columns that there are, or the largest size that fits.
    """
    if not (0 <= target[0] < shape[0] and 0 <= target[1] < shape[1]):
        raise ValueError(
            f"target is {tuple(target)}, which lies outside the image: its rows are 0 to {shape[0] - 1}, its columns 0 "
            f"to {shape[1] - 1}"
        )
    corner = (target[0] - size // 2, target[1] - size // 2)
    if min(corner) < 0 or corner[0] + size > shape[0] or corner[1] + size > shape[1]:
        # Number of pixels before the target, and from the target on, in the tighter direction.
        before = min(target)
        after = min(shape[0] - target[0], shape[1] - target[1])
        largest = min(2 * before + 1, 2 * after)
        raise ValueError(
            f"crop is {size}, but the target at row {target[0]}, column {target[1]} of an image of {shape[0]} x "
            f"{shape[1]} pixels leaves at most {largest}"
        )
    return corner


def frame_flux(frames: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Return the sum (T,) of the valid pixels of each frame."""
    return np.where(valid, frames, 0.0).sum((1, 2))


def frame_sharpness(frames: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Return the sharpness (T,) of each frame, S1 of Muller & Buffington (1974).

    It is the sum of the squares of the valid pixels divided by the square of their sum.
    """
    lit = np.where(valid, frames, 0.0)
    return (lit**2).sum((1, 2)) / lit.sum((1, 2)) ** 2


def best_frames(frames: np.ndarray, valid: np.ndarray, keep: float, keep_by: str = "sharpness") -> np.ndarray:
    """Return the indices, in ascending order, of the fraction `keep` of frames with the highest flux or sharpness.

    At least one frame is kept. Raises ValueError if `keep` is not in (0, 1] or `keep_by` is unknown.
    """
    if keep_by not in SELECTIONS:
        raise ValueError(f"keep_by is {keep_by!r}: it must be {' or '.join(SELECTIONS)}")
    if not 0 < keep <= 1:
        raise ValueError(f"keep is {keep}: it must be a fraction of the frames, above 0 and at most 1")
    score = (frame_flux if keep_by == "flux" else frame_sharpness)(frames, valid)
    count = max(1, round(keep * len(frames)))
    return np.sort(np.argsort(-score, kind="stable")[:count])


def frame_drift(frames: np.ndarray, valid: np.ndarray | None = None, upsampling: int = 100) -> np.ndarray:
    """Return the shift (x, y) of each frame from the first, (T, 2) [pixels], by cross-correlation.

    Parameters
    ----------
    frames : (T, H, W) array
        Images.
    valid : (T, H, W) array, optional
        Which pixels are valid.
    upsampling : int
        Resolution: shifts are multiples of 1 / upsampling pixels (Guizar-Sicairos et al. 2008, by scikit-image).

    Notes
    -----
    The correlation is periodic, so light that enters or leaves the field biases it: keep the target inside.
    """
    with extra("data"):
        from skimage.registration import phase_cross_correlation

    frames = np.asarray(frames, dtype=float)
    filled = frames if valid is None else _filled(frames, valid)
    # scikit-image's default, whitening, would amplify the noise beyond the mask's cut-off.
    plain: dict[str, Any] = {"normalization": None, "upsample_factor": upsampling}
    shifts = [phase_cross_correlation(filled[0], frame, **plain)[0] for frame in filled]
    return -np.array(shifts)[:, ::-1] + 0.0  # no negative zeros


def _filled(frames: np.ndarray, valid: np.ndarray) -> np.ndarray:
    return fill_bad_pixels(torch.tensor(frames), torch.tensor(valid, dtype=torch.bool)).numpy()

"""FITS cubes that are not what an option asks for, told by their shape."""

from __future__ import annotations

from pathlib import Path

from torchmask.data.fits import read_fits
from torchmask.observation import Observation
from torchmask.optics.pupil import pupil_raster


def require_one_map(path: Path | None) -> None:
    """Raise ValueError if a file for --bad-pixels holds several images, as a stack given by mistake does."""
    if path is None:
        return
    count, rows, columns = read_fits(path).values.shape
    if count > 1:
        raise ValueError(
            f"--bad-pixels {path} is a cube of {count} images of {rows} x {columns} pixels: give one image, which is "
            "not 0 where a pixel is bad"
        )


def require_wide_frames(observation: Observation, path: Path) -> None:
    """Raise ValueError if frames are far too narrow for the mask, perhaps because their axes are in another order.

    The message says what was read. Whatever else makes frames too narrow is refused later, by what they are used for;
    as a restoration pads them, those that would do in a field twice as wide pass here.
    """
    try:
        pupil_raster(observation.aperture.subaperture_diameter, observation.grid, 2)
    except ValueError as error:
        count, rows, columns = read_fits(path).values.shape
        if columns < rows / 2 or count > min(rows, columns):
            raise ValueError(
                f"{path} was read as {count} frames of {rows} x {columns} pixels, which are too narrow for this mask: "
                "take a wider image, or, if another axis counts frames, make it the third one of the file (NAXIS3), "
                "which NumPy has first"
            ) from error

"""FITS cubes that are not what an option asks for, told by their shape."""

from __future__ import annotations

from pathlib import Path

from torchmask.data.fits import read_fits


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

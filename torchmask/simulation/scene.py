"""Scenes for the telescope, in expected electrons per pixel: a packaged satellite, any mesh, or an image."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from torchmask.io import extra, load_npz
from torchmask.simulation.render import load_mesh, render_mesh, rows_and_columns
from torchmask.simulation.satellite import satellite_mesh

IMAGE_SUFFIXES = (".npz", ".png", ".fits")
OBLIQUE_VIEW = (25.0, -30.0, 15.0)
OBLIQUE_SUN = (-0.5, 0.6, 0.7)

_ROUNDING = 1e-9  # rounding error of the interpolation weights of a rotated image


@dataclass(frozen=True)
class SceneOptions:
    """Target of a scene, with its attitude, sunlight and size.

    Raises ValueError if `size` lies outside (0, 1]; `make_scene` checks the rest.

    Examples
    --------
    >>> small, turned = SceneOptions(size=0.3), SceneOptions(attitude=(0.0, 90.0, 0.0))
    >>> scene = make_scene((64, 64), n_photons=1e7, options=small)
    >>> max(int((scene > 0).any(axis).sum()) for axis in (0, 1))  # lit rows or columns, 0.3 x 64 rounded up
    20
    """

    path: Path | None = None
    """Mesh (.obj, .stl, .ply, .glb ...) or image (.npz with key image, .png, .fits); None: the packaged satellite."""
    attitude: tuple[float, float, float] | None = None
    """Rotation about the axes right, up, towards the viewer [degrees]; None: 25 -30 15, or 0 0 0 for images,
    which rotate only about the last axis."""
    sun: tuple[float, float, float] | None = None
    """Direction of the sun (right, up, towards the viewer), of any length, for meshes only; None: -0.5 0.6 0.7."""
    size: float = 0.7
    """Larger side of the target as a fraction of the field; of an image, that of its lit part, whose black margins do
    not count, and in which a lit pixel becomes a square. A single lit pixel is a point, a star, whatever the size."""

    def __post_init__(self) -> None:
        if not 0 < self.size <= 1:
            raise ValueError(f"size is {self.size}: it is a fraction of the field, above 0 and at most 1")


def make_scene(
    shape: int | tuple[int, int],
    n_photons: float,
    options: SceneOptions | None = None,
    *,
    dtype: torch.dtype | None = None,
    device: torch.device | str | None = None,
) -> Tensor:
    """Make the scene of a target on a black sky, in expected electrons per pixel and frame before any blur.

    Parameters
    ----------
    shape : int or (int, int)
        Rows and columns of the field (`grid.shape`); one number means a square.
    n_photons : float
        Sum of the scene [electrons per frame], including light that blur will carry out of the field.
    options : SceneOptions, optional
        Target, attitude, sunlight and size.
    dtype : torch.dtype, optional
        Type of the scene, float64 by default.
    device : torch.device, optional
        Device of the scene.

    Returns
    -------
    Tensor
        (rows, columns), non-negative, background exactly 0, row 0 at the top; the target's outline is centred.

    Raises
    ------
    ValueError
        If `shape` is not one or two whole numbers of at least 1; `n_photons` is not finite and positive; the file is
        missing, damaged or of an unknown kind; the target is empty, negative or not finite; no light reaches the
        viewer; or `sun`, or a rotation out of its plane, is given for an image.

    Examples
    --------
    >>> scene = make_scene((64, 64), n_photons=1e7)
    >>> round(float(scene.sum())), bool(scene.min() == 0)
    (10000000, True)
    """
    options, shape = options or SceneOptions(), rows_and_columns(shape)
    if not (math.isfinite(n_photons) and n_photons > 0):
        raise ValueError(f"n_photons is {n_photons}: it must be finite and positive, electrons per frame")
    if options.path is not None and Path(options.path).suffix.lower() in IMAGE_SUFFIXES:
        image = _pose(load_image(options.path), shape, options)
    else:
        mesh = satellite_mesh() if options.path is None else load_mesh(options.path)
        attitude, sun = options.attitude or OBLIQUE_VIEW, options.sun or OBLIQUE_SUN
        image = render_mesh(mesh, shape, attitude=attitude, sun=sun, size=options.size)
    return (image * (n_photons / image.sum())).to(dtype=dtype, device=device)


def load_image(path: str | Path) -> Tensor:
    """Read an image (rows, columns), float64, whose values are proportional to light.

    In an .npz file the image has the key `image`; in a .fits file it is the first two-dimensional array, row 0 as
    stored; in a .png file red, green and blue are averaged and multiplied by the opacity, without gamma correction.

    Raises
    ------
    ValueError
        If the file is missing, damaged or of another kind, or the image is not two-dimensional, has values that are
        negative or not finite, or is black.
    """
    path = Path(path)
    readers = {".npz": _read_npz, ".png": _read_png, ".fits": _read_fits}
    if path.suffix.lower() not in readers:
        raise ValueError(f"{path} is of an unknown kind: give a file that ends in {', '.join(readers)}")
    if not path.is_file():
        raise ValueError(f"there is no image file {path}")
    image = np.asarray(readers[path.suffix.lower()](path), dtype=np.float64)
    if image.ndim != 2:
        raise ValueError(f"the image in {path} has shape {image.shape}: (rows, columns) are needed")
    if not np.isfinite(image).all():
        raise ValueError(f"the image in {path} holds values that are not finite: replace them, for instance by 0")
    if image.min() < 0:
        raise ValueError(
            f"the image in {path} holds negative light ({image.min():.3g}): subtract the background and clip"
        )
    if not image.any():
        raise ValueError(f"the image in {path} is black")
    return torch.from_numpy(image)


def _read_npz(path: Path) -> np.ndarray:
    return load_npz(path, required=["image"])["image"]


def _read_png(path: Path) -> np.ndarray:
    with extra("data"):
        import imageio.v3 as imageio  # comes with scikit-image

    try:
        image = np.asarray(imageio.imread(path.read_bytes(), plugin="pillow", extension=".png"), dtype=np.float64)
    except Exception as error:  # the underlying readers raise many kinds of exceptions
        raise ValueError(f"{path} cannot be read as a PNG image: {error}") from error
    if image.ndim == 3 and image.shape[-1] in (2, 4):
        image = image[..., :-1] * image[..., -1:]
    return image.mean(-1) if image.ndim == 3 else image


def _read_fits(path: Path) -> np.ndarray:
    with extra("data"):
        from astropy.io import fits

    try:
        with path.open("rb") as file, fits.open(file, memmap=False) as units:
            arrays = [
                unit.data for unit in units if isinstance(unit, fits.PrimaryHDU | fits.ImageHDU | fits.CompImageHDU)
            ]
            images = [array for array in arrays if array is not None and array.ndim == 2]
    except Exception as error:  # damaged headers raise many kinds of exceptions
        raise ValueError(f"{path} cannot be read as FITS: {error}") from error
    if not images:
        raise ValueError(f"{path} holds no two-dimensional image")
    return images[0]


def _pose(image: Tensor, shape: tuple[int, int], options: SceneOptions) -> Tensor:
    """Rotate an image, crop it to its lit part, resample it to its fraction of the field, and centre it on black.

    A single lit pixel is a point, which has no size, on pixel [H // 2, W // 2].
    """
    with extra("data"):
        from kornia.geometry.transform import resize, rotate

    about_x, about_y, angle = options.attitude or (0.0, 0.0, 0.0)
    if about_x or about_y or options.sun:
        raise ValueError(
            f"attitude {options.attitude} and sun {options.sun} do not suit the image {options.path}: an image rotates "
            "only in its plane (0 0 angle) and has no sun; give a mesh for more"
        )
    if image.count_nonzero() == 1:
        point = image.new_zeros(shape)
        point[shape[0] // 2, shape[1] // 2] = 1.0
        return point
    image = image[None, None]
    if angle:
        margin = math.ceil((math.hypot(*image.shape[-2:]) - min(image.shape[-2:])) / 2)
        image = rotate(pad(image, (margin,) * 4), image.new_tensor([angle]))
        image = image * (image > _ROUNDING * image.max())  # black stays black
    rows, columns = (torch.nonzero(image.sum(dim=axis).squeeze()).flatten() for axis in (-1, -2))
    target = image[..., int(rows[0]) : int(rows[-1]) + 1, int(columns[0]) : int(columns[-1]) + 1]
    scale = options.size * min(shape[0] / target.shape[-2], shape[1] / target.shape[-1])
    height, width = (max(1, round(scale * length)) for length in target.shape[-2:])
    resampled = resize(target, (height, width), antialias=scale < 1)[0, 0].clamp(min=0)
    top, left = (shape[0] - height) // 2, (shape[1] - width) // 2
    return pad(resampled, (left, shape[1] - width - left, top, shape[0] - height - top))

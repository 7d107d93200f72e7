"""Orthographic rendering of triangle meshes: hidden surfaces, cast shadows, diffuse light and glints.

The viewer looks down the -z axis: x is to the right, y is up, z points at the viewer.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchmask.io import extra
from torchmask.memory import require_memory
from torchmask.numbers import whole_number

Array = NDArray[np.float64]

_SAMPLES = 1024  # minimum samples on the longer side of a rendering, before they are averaged into pixels
_BYTES = 25  # of memory for each sample: nearness, index of the face, light, and whether there is any
_FRAGMENTS = 1 << 21  # samples processed together
_EDGE_ON = 1e-9  # a face whose normal is this close to the image plane is seen edge-on and skipped
_MAX_SLOPE = 10.0  # limit on the slope of a face towards the sun, in the tolerance of the shadow test


class Mesh(NamedTuple):
    """Triangles and their reflectance.

    triangles : (F, 3, 3) corners (x, y, z) in any unit of length; faces are two-sided, so either winding will do
    albedo : (F,) Lambertian reflectance
    specular : (F,) strength of the specular reflection
    shininess : (F,) exponent of the specular lobe: the larger, the sharper the glint
    """

    triangles: Array
    albedo: Array
    specular: Array
    shininess: Array


def load_mesh(path: str | Path) -> Mesh:
    """Read a mesh with trimesh (.obj with its .mtl, .stl, .ply, .glb, .off ...).

    The albedo of a face is the mean of the red, green and blue of its material (textures are not read), or of the
    face's own colour if the file has no materials. Faces are matt: `specular` is 0.

    Raises
    ------
    ValueError
        If the file is missing, cannot be read, has no triangle, or has a corner that is not finite.
    """
    with extra("data"):
        import trimesh

    path = Path(path)
    if not path.is_file():
        raise ValueError(f"there is no mesh file {path}")
    try:
        parts = [p for p in trimesh.load_scene(path, process=False).dump() if isinstance(p, trimesh.Trimesh)]
    except Exception as error:  # each format has its own reader, with its own exceptions
        raise ValueError(f"{path} cannot be read as a mesh: {error}") from error
    if not sum(len(part.faces) for part in parts):
        raise ValueError(f"the mesh {path} is empty: it needs at least one triangle")
    triangles = np.concatenate([np.asarray(part.triangles, dtype=float) for part in parts])
    if not np.isfinite(triangles).all():
        raise ValueError(f"the mesh {path} has corners that are not finite: repair the file")
    albedo = np.concatenate([_albedo(part) for part in parts])
    matt = np.zeros(len(triangles))
    return Mesh(triangles, albedo, matt, matt + 1)


def _albedo(part: Any) -> Array:
    material = getattr(part.visual, "material", None)
    colours = part.visual.face_colors if material is None else material.main_color
    return np.broadcast_to(np.asarray(colours, dtype=float)[..., :3].mean(-1) / 255, len(part.faces))


def rows_and_columns(shape: int | tuple[int, int]) -> tuple[int, int]:
    """Return rows and columns of an image; one number means a square, as of a `Grid`.

    Raises ValueError unless they are whole numbers of at least 1, and TypeError if they are no numbers.

    >>> rows_and_columns(32), rows_and_columns((24.0, 32))
    ((32, 32), (24, 32))
    """
    sides = tuple(shape) if isinstance(shape, Sequence) else (shape, shape)
    if len(sides) != 2:
        raise ValueError(f"shape is {shape}: it must be (rows, columns), or one number for a square")
    note = ", as shape is (rows, columns)"
    return whole_number("rows", sides[0], note=note), whole_number("columns", sides[1], note=note)


def render_mesh(
    mesh: Mesh,
    shape: int | tuple[int, int],
    *,
    attitude: Sequence[float] = (0.0, 0.0, 0.0),
    sun: Sequence[float] = (0.0, 0.0, 1.0),
    size: float = 0.7,
    ambient: float = 0.05,
    dtype: torch.dtype | None = None,
    device: torch.device | str | None = None,
) -> Tensor:
    """Render the radiance of a sunlit mesh as a distant viewer sees it.

    Each face reflects `albedo (ambient + n.s) + specular (n.h)^shininess`, with s the direction of the sun and h
    midway between sun and viewer (Blinn 1977). In shadow, only `albedo ambient` remains. Hidden surfaces and shadows
    are found by z-buffers with at least 4 x 4 samples per pixel, which are averaged.

    Parameters
    ----------
    mesh : Mesh
        Triangles and their reflectance.
    shape : int or (int, int)
        Rows and columns of the image; one number means a square.
    attitude : (float, float, float)
        Rotation [degrees] about the fixed axes x (to the right), then y (up), then z (towards the viewer,
        anticlockwise in the image).
    sun : (float, float, float)
        Direction of the sun, (x, y, z) in the viewer's frame, of any length.
    size : float
        Larger side of the mesh's outline as a fraction of the field, in (0, 1]; the outline is centred.
    ambient : float
        Ambient light relative to that of the sun.
    dtype : torch.dtype, optional
        Type of the image, float64 by default.
    device : torch.device, optional
        Device of the image.

    Returns
    -------
    Tensor
        (rows, columns), non-negative, in arbitrary units, row 0 at the top, background exactly 0.

    Raises
    ------
    ValueError
        If `shape` is not one or two whole numbers of at least 1, the mesh has no extent, the attitude is not finite,
        the sun is not a direction, `size` lies outside (0, 1], `ambient` is negative, or no light reaches the viewer.

    Examples
    --------
    >>> plate = Mesh(np.array([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]]), np.ones(1), np.zeros(1), np.ones(1))
    >>> image = render_mesh(plate, (16, 16), size=0.5, ambient=0.0)
    >>> round(float(image.sum()))  # half of 8 x 8 pixels
    32
    """
    shape = rows_and_columns(shape)
    rotation, towards_sun = _check_view(attitude, sun)
    if not 0 < size <= 1:
        raise ValueError(f"size is {size}: it is a fraction of the field, above 0 and at most 1")
    if not (math.isfinite(ambient) and ambient >= 0):
        raise ValueError(f"ambient is {ambient}: it must be finite and not negative")
    samples = max(4, math.ceil(_SAMPLES / max(shape)))
    raster = (shape[0] * samples, shape[1] * samples)
    require_memory("n_pixels", max(shape), _BYTES * math.prod(raster), power=2)
    triangles = _to_raster(mesh.triangles @ rotation.T, raster, size)
    depth, face = _z_buffer(triangles, raster)

    seen = face >= 0
    rows, columns = np.nonzero(seen)
    normals = _normals(triangles)
    points = np.stack([columns + 0.5, rows + 0.5, depth[seen]], axis=-1, dtype=np.float64)
    # Rows run downwards, so the raster's y axis is the reverse of the viewer's.
    sun_raster = towards_sun * (1, -1, 1)
    lit = _sunlit(triangles, points, normals[face[seen]], sun_raster)
    diffuse, glint = _reflect(mesh, normals, sun_raster)
    light = np.zeros(raster)
    light[seen] = mesh.albedo[face[seen]] * ambient + lit * (diffuse + glint)[face[seen]]
    image = light.reshape(shape[0], samples, shape[1], samples).mean(axis=(1, 3))
    if not image.any():
        raise ValueError("the rendering is black because no reflecting face is lit: change sun or attitude")
    return torch.as_tensor(image, dtype=dtype or torch.float64, device=device)


def _check_view(attitude: Sequence[float], sun: Sequence[float]) -> tuple[Array, Array]:
    """Return the rotation matrix of the attitude and the unit vector towards the sun."""
    from scipy.spatial.transform import Rotation

    angles, direction = np.asarray(attitude, dtype=float), np.asarray(sun, dtype=float)
    if angles.shape != (3,) or not np.isfinite(angles).all():
        raise ValueError(f"attitude is {attitude}: it must be three finite angles, in degrees")
    length = np.linalg.norm(direction)
    if direction.shape != (3,) or not np.isfinite(length) or length == 0:
        raise ValueError(f"sun is {sun}: it must be a finite direction (x, y, z) that is not zero")
    return Rotation.from_euler("xyz", angles, degrees=True).as_matrix(), direction / length


def _to_raster(triangles: Array, raster: tuple[int, int], size: float) -> Array:
    """Scale and centre the triangles so that x is the column, y the row (downwards) and z the nearness, in samples."""
    low, high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
    extent = high - low
    if not (np.isfinite(extent).all() and extent[:2].max() > 0):
        raise ValueError("the mesh has no finite outline: its corners must be finite and not all in one place")
    with np.errstate(divide="ignore"):
        scale = size * min(raster[1] / extent[0], raster[0] / extent[1])
    centred = (triangles - (low + high) / 2) * scale * (1, -1, 1)
    return centred + (raster[1] / 2, raster[0] / 2, 0)


def _normals(triangles: Array) -> Array:
    """Return the unit normals (F, 3) on the viewer's side; zero for a face without area."""
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    return normals / np.where(length > 0, length, 1) * np.where(normals[:, 2:] < 0, -1, 1)


def _reflect(mesh: Mesh, normals: Array, sun: Array) -> tuple[Array, Array]:
    """Return the diffuse and the specular light, (F,) each, of every face as if the sun reached it."""
    incidence = np.clip(normals @ sun, 0, None)
    halfway = sun + (0, 0, 1)
    halfway = halfway / max(float(np.linalg.norm(halfway)), 1e-12)
    glint = mesh.specular * np.clip(normals @ halfway, 0, 1) ** mesh.shininess * (incidence > 0)
    return mesh.albedo * incidence, glint


def _sunlit(triangles: Array, points: Array, normals: Array, sun: Array) -> NDArray[np.bool_]:
    """Return which of the points (P, 3), on faces with `normals` (P, 3), see the sun, from a z-buffer seen by the sun.

    The buffer is read at the nearest sample, where a face of slope t towards the sun may differ from the point by
    t / sqrt(2) samples. Anything nearer to the sun than that, plus a margin, is another face and casts a shadow.
    """
    across = np.cross(sun, (0.0, 1.0, 0.0) if abs(sun[1]) < 0.9 else (1.0, 0.0, 0.0))
    across /= np.linalg.norm(across)
    axes = np.stack([across, np.cross(sun, across), sun], axis=-1)
    faces, points = triangles @ axes, points @ axes
    low, high = faces.min(axis=(0, 1)), faces.max(axis=(0, 1))
    scale = min(1.0, 2 * _SAMPLES / (high - low)[:2].max())  # a mesh seen end-on may be much longer than its image
    faces, points = (faces - low) * scale, (points - low) * scale
    side = np.ceil((high - low)[:2] * scale).astype(int) + 1
    depth, _ = _z_buffer(faces, (side[1], side[0]))
    columns, rows = np.clip(points[:, :2].astype(int), 0, side - 1).T
    cosine = np.clip(np.abs(normals @ sun), 1e-12, 1)
    slope = np.minimum(np.sqrt(1 - cosine**2) / cosine, _MAX_SLOPE)
    return points[:, 2] >= depth[rows, columns] - (0.5 + slope)


def _z_buffer(triangles: Array, raster: tuple[int, int]) -> tuple[Array, NDArray[np.int64]]:
    """Return the nearness and the index of the nearest face at every sample, -inf and -1 where there is none.

    `triangles` (F, 3, 3) are (column, row, nearness) in samples, within the raster; samples lie at half-integers.
    """
    depth = np.full(raster[0] * raster[1], -np.inf)
    nearest = np.full(raster[0] * raster[1], -1)
    slopes = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    faces = np.flatnonzero(np.abs(slopes[:, 2]) > _EDGE_ON * np.linalg.norm(slopes, axis=-1))
    lowest, highest = triangles[..., 2].min(-1), triangles[..., 2].max(-1)
    # A face covers at most its bounding box; batches of limited total area limit the memory.
    work = np.cumsum(np.prod(np.ptp(triangles[faces, :, :2], axis=1) + 1, axis=-1))
    for batch in np.split(faces, np.flatnonzero(np.diff(work // _FRAGMENTS)) + 1):
        face, row, column = _fragments(triangles, batch)
        origin, slope = triangles[face, 0], slopes[face]
        rise = slope[:, 0] * (column + 0.5 - origin[:, 0]) + slope[:, 1] * (row + 0.5 - origin[:, 1])
        z = np.clip(origin[:, 2] - rise / slope[:, 2], lowest[face], highest[face])
        sample = row * raster[1] + column
        np.maximum.at(depth, sample, z)
        wins = z == depth[sample]
        nearest[sample[wins]] = face[wins]
    return depth.reshape(raster), nearest.reshape(raster)


def _fragments(triangles: Array, faces: NDArray[np.int64]) -> tuple[NDArray[np.int64], ...]:
    """Return (face, row, column) of every sample that each face covers: its rows, then the span of each row."""
    y = triangles[faces, :, 1]
    which, row = _ranges(np.ceil(y.min(-1) - 0.5), np.floor(y.max(-1) - 0.5))
    face = faces[which]
    left, right = np.full(len(row), np.inf), np.full(len(row), -np.inf)
    for start, end in ((0, 1), (1, 2), (2, 0)):
        (x0, y0), (x1, y1) = triangles[face, start, :2].T, triangles[face, end, :2].T
        height = y1 - y0
        along = (row + 0.5 - y0) / np.where(height == 0, np.inf, height)
        crosses = (along >= 0) & (along <= 1) & (height != 0)
        x = x0 + along * (x1 - x0)
        left, right = np.where(crosses, np.minimum(left, x), left), np.where(crosses, np.maximum(right, x), right)
    # Rounding must not open a gap between two faces that share an edge.
    which, column = _ranges(np.ceil(left - 0.5 - 1e-9), np.floor(right - 0.5 + 1e-9))
    return face[which], row[which], column


def _ranges(first: Array, last: Array) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the integers from first[i] to last[i] for all i, concatenated, preceded by the i of each."""
    with np.errstate(invalid="ignore"):
        count = np.nan_to_num(np.clip(last - first + 1, 0, None), nan=0, posinf=0).astype(np.int64)
    which = np.repeat(np.arange(len(count)), count)
    within = np.arange(len(which)) - np.repeat(np.cumsum(count) - count, count)
    return which, first[which].astype(np.int64) + within

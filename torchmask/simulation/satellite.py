"""A satellite as 3-D geometry, the packaged scene, so that a first run needs no file."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from torchmask.io import extra
from torchmask.simulation.render import Array, Mesh


class _Material(NamedTuple):
    albedo: float
    specular: float
    shininess: float


_FOIL = _Material(0.55, 0.5, 12)  # golden insulation, whose wrinkles give it a broad lobe
_SEAM = _Material(0.22, 0.1, 12)
_WHITE = _Material(0.85, 0.05, 5)  # paint of dish and instruments
_RADIATOR = _Material(0.75, 0.8, 60)
_CELL = _Material(0.10, 0.9, 40)  # dark, behind glass
_GRID = _Material(0.45, 0.2, 20)  # the substrate that shows between cells
_METAL = _Material(0.60, 1.5, 25)
_DARK = _Material(0.06, 0.05, 5)


def satellite_mesh() -> Mesh:
    """Return a communication satellite in metres: bus, two solar wings, dish, booms, nozzle and instruments.

    The wings stretch along x, about 9 m from tip to tip; the dish opens towards +z and the nozzle towards -y. Wings and
    dish are turned slightly against the bus so that they catch the sun at different times.

    Examples
    --------
    >>> mesh = satellite_mesh()
    >>> bool(np.ptp(mesh.triangles[..., 0]) > np.ptp(mesh.triangles[..., 1]))  # longest along the wings
    True
    """
    parts = [*_bus(), *_wing(1), *_wing(-1), *_dish(), *_booms(), *_nozzle(), *_instruments()]
    counts = [len(triangles) for triangles, _ in parts]
    materials = np.repeat(np.array([material for _, material in parts], dtype=float), counts, axis=0)
    return Mesh(np.concatenate([triangles for triangles, _ in parts]), *materials.T)


_Part = tuple[Array, _Material]


def _bus() -> list[_Part]:
    """Return a box of 1.8 x 2.4 x 1.6 m, clad in tiles of foil with seams, with radiators on the -x and +x faces."""
    half = np.array([0.9, 1.2, 0.8])
    parts: list[_Part] = []
    for axis in range(3):
        across, up = (2, 1) if axis == 0 else (0, 2) if axis == 1 else (0, 1)
        tile = _RADIATOR if axis == 0 else _FOIL
        for side in (-1, 1):
            corner = -half
            corner[axis] *= -side
            edges = np.zeros((2, 3))
            edges[0, across], edges[1, up] = 2 * half[across], 2 * half[up]
            parts += _tiles(corner, edges[0], edges[1], cells=(3, 4 if up == 1 else 3), gap=0.05, tile=tile, seam=_SEAM)
    return parts


def _wing(side: int) -> list[_Part]:
    """Return a yoke and three panels of cells on the +x (`side` 1) or -x (-1) face, pitched by 25 degrees about x."""
    pitch = np.radians(25.0)
    chord = np.array([0.0, np.cos(pitch), -np.sin(pitch)])
    width, length, gap = 1.8, 1.05, 0.12
    root = np.array([0.9 * side, 0.0, 0.0])
    start = root + [0.5 * side, 0, 0]
    parts = [_rod(root, start + chord * end * width / 2, 0.035, _METAL) for end in (-0.7, 0.7)]
    for panel in range(3):
        corner = start + [side * panel * (length + gap), 0, 0] - chord * width / 2
        parts += _tiles(corner, np.array([side * length, 0, 0]), chord * width, (2, 4), 0.10, _CELL, _GRID)
        if panel:
            hinge = corner - [side * gap, 0, 0]
            parts += [_rod(hinge + chord * width * at, corner + chord * width * at, 0.03, _METAL) for at in (0.2, 0.8)]
    return parts


def _dish() -> list[_Part]:
    """Return a paraboloid on an arm above the bus, with a feed on three struts."""
    radius, depth = 1.1, 0.36
    r = np.linspace(0.0, radius, 9)
    turn = _rotation((-35.0, 25.0, 0.0), (0.15, 2.15, 0.3))
    feed = np.array([0, 0, 0.95])
    rim = [radius * 0.95 * np.array([np.cos(a), np.sin(a), 0]) + [0, 0, depth] for a in np.radians([90, 210, 330])]
    parts: list[_Part] = [(_revolve(np.stack([r, depth * (r / radius) ** 2], -1), 48), _WHITE)]
    parts += [_rod(point, feed, 0.025, _METAL) for point in rim]
    parts.append((_revolve(np.array([[0, 0.8], [0.12, 0.8], [0.2, 1.1], [0, 1.1]]), 16), _DARK))
    parts = [(triangles @ turn[:3, :3].T + turn[:3, 3], material) for triangles, material in parts]
    return [*parts, _rod(np.array([0.0, 1.2, 0.0]), turn[:3, 3], 0.06, _METAL)]


def _booms() -> list[_Part]:
    """Return a magnetometer boom with a box at its end, and two whip aerials."""
    tip = np.array([-1.6, 3.2, 1.1])
    return [
        _rod(np.array([-0.85, 1.15, 0.7]), tip, 0.04, _METAL),
        _box(tip, (0.28, 0.28, 0.28), _WHITE),
        _rod(np.array([0.85, -1.15, 0.75]), np.array([1.7, -2.5, 1.5]), 0.03, _METAL),
        _rod(np.array([-0.85, -1.15, 0.75]), np.array([-1.6, -2.4, 1.6]), 0.03, _METAL),
    ]


def _nozzle() -> list[_Part]:
    """Return the apogee engine below the bus."""
    turn = _rotation((90.0, 0.0, 0.0), (0.0, -1.2, 0.0))
    bell = np.array([[0.2, 0.0], [0.15, 0.15], [0.30, 0.4], [0.45, 0.75]])
    return [(_revolve(bell, 24) @ turn[:3, :3].T + turn[:3, 3], _METAL)]


def _instruments() -> list[_Part]:
    """Return two telescopes, a box of electronics and a sun sensor on the +z face."""
    parts: list[_Part] = []
    for x, y, radius, length in ((-0.35, 0.5, 0.3, 0.7), (0.42, 0.72, 0.17, 0.5)):
        turn = _rotation((0.0, 0.0, 0.0), (x, y, 0.8))
        tube = np.array([[radius, 0.0], [radius, length], [0.7 * radius, length], [0.7 * radius, 0.1], [0, 0.1]])
        triangles = _revolve(tube, 24) @ turn[:3, :3].T + turn[:3, 3]
        parts.append((triangles, _WHITE))
    return [
        *parts,
        _box((0.35, -0.4, 0.95), (0.7, 0.5, 0.3), _RADIATOR),
        _box((-0.48, -0.65, 0.88), (0.3, 0.4, 0.16), _DARK),
    ]


def _tiles(
    corner: Array, along: Array, up: Array, cells: tuple[int, int], gap: float, tile: _Material, seam: _Material
) -> list[_Part]:
    """Return a flat panel from `corner` with edges `along` and `up`, cut into cells with seams of `gap` cells' width.

    Tiles and seams are cut from one plane, because overlapping coplanar faces would be ambiguous in the z-buffer.
    """
    lines = [
        np.concatenate([[0.0], *([(k + gap / 2) / n, (k + 1 - gap / 2) / n] for k in range(n)), [1.0]]) for n in cells
    ]
    quads: dict[bool, list[Array]] = {True: [], False: []}
    for i, (u0, u1) in enumerate(zip(lines[0], lines[0][1:], strict=False)):
        for j, (v0, v1) in enumerate(zip(lines[1], lines[1][1:], strict=False)):
            a, b, c, d = (corner + along * u + up * v for u, v in ((u0, v0), (u1, v0), (u1, v1), (u0, v1)))
            quads[bool(i % 2 and j % 2)] += [np.stack([a, b, c]), np.stack([a, c, d])]
    return [(np.stack(quads[True]), tile), (np.stack(quads[False]), seam)]


def _revolve(profile: Array, sections: int) -> Array:
    """Return the triangles (F, 3, 3) of the profile (radius, height) revolved about z."""
    with extra("data"):
        import trimesh

    return np.asarray(trimesh.creation.revolve(profile, sections=sections).triangles, dtype=float)


def _rod(start: Array, end: Array, radius: float, material: _Material) -> _Part:
    with extra("data"):
        import trimesh

    return np.asarray(trimesh.creation.cylinder(radius, sections=8, segment=(start, end)).triangles, float), material


def _box(centre: Any, extents: tuple[float, float, float], material: _Material) -> _Part:
    with extra("data"):
        import trimesh

    return np.asarray(trimesh.creation.box(extents).triangles, dtype=float) + np.asarray(centre), material


def _rotation(degrees: tuple[float, float, float], origin: tuple[float, float, float]) -> Array:
    """Return the homogeneous transform that turns about the axes x, y, z in that order, then moves to `origin`."""
    with extra("data"):
        import trimesh

    transform = trimesh.transformations.euler_matrix(*np.radians(degrees))
    transform[:3, 3] = origin
    return transform

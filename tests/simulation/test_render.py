"""Rendering against brute force, closed forms of light and area, and an independent renderer."""

import math

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import maximum_filter, minimum_filter

from torchmask.simulation import render
from torchmask.simulation.render import Mesh, load_mesh, render_mesh
from torchmask.simulation.satellite import satellite_mesh

UP = (0.0, 0.0, 1.0)


def matt(triangles, albedo=1.0):
    triangles = np.asarray(triangles, dtype=float)
    ones = np.ones(len(triangles))
    return Mesh(triangles, albedo * ones, 0 * ones, ones)


def joined(*meshes):
    return Mesh(*(np.concatenate(parts) for parts in zip(*meshes, strict=True)))


def plate(width, height, centre=(0, 0, 0), albedo=1.0):
    """A rectangle facing +z."""
    x, y = width / 2, height / 2
    corners = np.array([[-x, -y, 0], [x, -y, 0], [x, y, 0], [-x, y, 0]]) + centre
    return matt(corners[[[0, 1, 2], [0, 2, 3]]], albedo)


def solid(shape, centre=(0, 0, 0), albedo=1.0):
    return matt(shape.triangles + np.asarray(centre), albedo)


@settings(max_examples=20, derandomize=True, deadline=None)
@given(seed=st.integers(0, 2**31), count=st.integers(1, 30))
def test_z_buffer_agrees_with_casting_a_ray_at_every_triangle(seed, count):
    side = 24
    triangles = np.random.default_rng(seed).uniform(0, side, (count, 3, 3))
    depth, face = render._z_buffer(triangles, (side, side))
    a, b, c = np.moveaxis(triangles, 1, 0)

    def cross(s, t):
        return s[..., 0] * t[..., 1] - s[..., 1] * t[..., 0]

    double = cross(b - a, c - a)
    for row in range(side):
        for column in range(side):
            p = np.array([column + 0.5, row + 0.5])
            u = cross(p - a[:, :2], c - a) / double
            v = cross(b - a, p - a[:, :2]) / double
            inside = np.minimum(np.minimum(u, v), 1 - u - v)
            z = np.where(inside >= 0, a[:, 2] + u * (b - a)[:, 2] + v * (c - a)[:, 2], -np.inf)
            if np.abs(inside).min() < 1e-6:
                continue  # on an edge either answer is right
            assert face[row, column] == (z.argmax() if z.max() > -np.inf else -1)
            assert depth[row, column] == z.max() or abs(depth[row, column] - z.max()) < 1e-9


@pytest.mark.parametrize("n_pixels", [16, 64, 300])
def test_light_of_a_facing_polygon_is_its_area(n_pixels):
    # Each sample on the rim counts as in or out. Its error is at most half a sample; as independent errors, 4 sigma.
    corners = [[math.cos(a), math.sin(a), 0] for a in np.arange(5) * 2 * math.pi / 5 + 0.3]
    mesh = matt([[corners[0], corners[k], corners[k + 1]] for k in (1, 2, 3)], albedo=0.4)
    image = render_mesh(mesh, (n_pixels, n_pixels), sun=UP, size=0.8, ambient=0.0)
    extent = np.ptp(np.array(corners), axis=0).max()
    scale = 0.8 * n_pixels / extent
    samples = max(4, math.ceil(1024 / n_pixels))
    rim = 5 * 2 * math.sin(math.pi / 5) * scale * samples
    area = 5 / 2 * math.sin(2 * math.pi / 5) * scale**2
    assert abs(float(image.sum()) - 0.4 * area) < 0.4 * 4 * 0.5 * math.sqrt(rim) / samples**2
    assert float(image.max()) == pytest.approx(0.4, rel=1e-12)


def test_near_hides_far_whatever_the_order_of_the_faces():
    far, near = plate(4, 4, albedo=0.2), plate(2, 2, (0, 0, 1), albedo=0.9)
    for mesh in (joined(far, near), joined(near, far)):
        image = render_mesh(mesh, (64, 64), sun=UP, size=0.5, ambient=0.0)
        assert image[32, 32] == pytest.approx(0.9)
        assert image[32, 18] == pytest.approx(0.2)
        assert image[0, 0] == 0
    behind = render_mesh(joined(far, near), (64, 64), attitude=(0, 180, 0), sun=UP, size=0.5, ambient=0.0)
    assert behind[32, 32] == pytest.approx(0.2)


@pytest.mark.parametrize("tilt", [0.0, 20.0, 50.0, 75.0])
@pytest.mark.parametrize("sun", [(0, 0, 1), (1, 0, 1), (0.3, -0.8, 0.5), (0, 1, -0.2)])
def test_lambert_and_two_sided_faces(tilt, sun):
    normal = np.array([math.sin(math.radians(tilt)), 0, math.cos(math.radians(tilt))])
    incidence = max(0.0, float(normal @ sun) / np.linalg.norm(sun))
    mesh = plate(2, 2, albedo=0.5)
    turned = Mesh(mesh.triangles[:, ::-1], *mesh[1:])
    for winding in (mesh, turned):
        image = render_mesh(winding, (32, 32), attitude=(0, tilt, 0), sun=sun, size=0.6, ambient=0.1)
        assert float(image[16, 16]) == pytest.approx(0.5 * (0.1 + incidence), rel=1e-12)


def test_a_glint_flares_where_the_face_mirrors_the_sun():
    mesh = plate(2, 2, albedo=0.0)._replace(specular=np.full(2, 3.0), shininess=np.full(2, 40.0))
    sun = (math.sin(math.radians(60)), 0, math.cos(math.radians(60)))
    for tilt in (30.0, 25.0, 36.0):
        image = render_mesh(mesh, (32, 32), attitude=(0, tilt, 0), sun=sun, size=0.6)
        expected = 3.0 * math.cos(math.radians(tilt - 30)) ** 40
        assert float(image[16, 16]) == pytest.approx(expected, rel=1e-9)
    with pytest.raises(ValueError, match="black"):  # lit from behind
        render_mesh(mesh, (32, 32), sun=(1.0, 0.0, -0.1))


@pytest.mark.parametrize("phase", [0.0, 40.0, 90.0, 130.0])
@pytest.mark.parametrize("subdivisions", [3, 4])
def test_phase_curve_of_a_lambertian_sphere(phase, subdivisions):
    # Closed form (Lambert sphere): 2/3 R^2 (sin a + (pi - a) cos a). A convex body casts no shadow on what faces the
    # sun: any speckle of the shadow test would darken it. Equilateral faces of 4 pi / F have sides s = sqrt(4 / sqrt(3)
    # 4 pi / F); flat faces fall short of the sphere by s^2 / 8 in radius and turn normals by s / 2: below s^2 in light.
    ball = trimesh.creation.icosphere(subdivisions=subdivisions)
    a = math.radians(phase)
    direction = (math.sin(a) * 0.6, math.sin(a) * 0.8, math.cos(a))
    image = render_mesh(solid(ball), (128, 128), sun=direction, size=0.9, ambient=0.0)
    radius = 0.9 * 128 / 2
    expected = 2 / 3 * radius**2 * (math.sin(a) + (math.pi - a) * math.cos(a))
    chord = math.sqrt(4 / math.sqrt(3) * 4 * math.pi / len(ball.faces))
    assert abs(float(image.sum()) / expected - 1) < chord**2
    assert float(image.max()) <= 1 + 1e-12


def test_a_shadow_falls_where_geometry_puts_it():
    # A plate of 1 x 1 at height 2 over a floor of 8 x 8, sun at 45 degrees towards +x: the shadow is moved by -2.
    mesh = joined(plate(8, 8, albedo=0.5), plate(1, 1, (1, 0, 2), albedo=0.5))
    image = render_mesh(mesh, (80, 80), sun=(1, 0, 1), size=0.8, ambient=0.1)  # 8 pixels per unit
    lit, dark = 0.5 * (0.1 + math.sqrt(0.5)), 0.5 * 0.1
    # x = -1.5 .. -0.5, y = -0.5 .. 0.5: columns 28 .. 35, rows 36 .. 43. The bias and the nearest sample of the shadow
    # map move its edge by at most (0.5 + 1 + 1) samples of 1/13 pixel, so pixels that touch the edge are left out.
    torch.testing.assert_close(image[37:43, 29:35], torch.full((6, 6), dark, dtype=torch.float64))
    torch.testing.assert_close(image[37:43, 37:43], torch.full((6, 6), lit, dtype=torch.float64))
    around = image.clone()
    around[35:45, 27:37] = lit
    torch.testing.assert_close(around[8:72, 8:72], torch.full((64, 64), lit, dtype=torch.float64))
    missing = (lit * 64 * 64 - image.sum()) / (lit - dark)
    assert abs(float(missing) - 64) < 4 * 8 * 2.5 / 13


def test_axes_of_image_and_attitude():
    # A long rod to the right, a ball above it, a cube towards the viewer: each brighter than the last.
    rod = solid(trimesh.creation.box((2, 0.2, 0.2)), (1, 0, 0), 0.2)
    ball = solid(trimesh.creation.box((0.4, 0.4, 0.4)), (0, 2, 0), 0.5)
    cube = solid(trimesh.creation.box((0.4, 0.4, 0.4)), (0, 0, 2), 1.0)
    mesh = joined(rod, ball, cube)

    def centroid(albedo, **view):
        image = render_mesh(mesh, (96, 96), sun=UP, size=0.8, ambient=0.0, **view)
        rows, columns = torch.nonzero((image - albedo).abs() < 1e-9, as_tuple=True)
        return float(rows.double().mean()), float(columns.double().mean())

    cube_at, ball_at, rod_at = (centroid(albedo) for albedo in (1.0, 0.5, 0.2))
    assert ball_at[0] < cube_at[0] - 20  # +y is up, row 0 at the top
    assert rod_at[1] > cube_at[1] + 10  # +x is to the right
    # About z by 90 degrees: +x goes up. About y: +z comes to the right. About x: +z goes down.
    turned = {axis: tuple(90.0 * (k == axis) for k in range(3)) for axis in range(3)}
    assert centroid(0.2, attitude=turned[2])[0] < centroid(1.0, attitude=turned[2])[0] - 10
    assert centroid(1.0, attitude=turned[1])[1] > centroid(0.5, attitude=turned[1])[1] + 20
    assert centroid(1.0, attitude=turned[0])[0] > centroid(0.2, attitude=turned[0])[0] + 20


def test_turning_the_target_turns_the_image():
    mesh, sun = satellite_mesh(), np.array([-0.4, 0.5, 0.8])
    upright = render_mesh(mesh, (64, 64), attitude=(20, -30, 10), sun=sun)
    # x to the right and y up, turned anticlockwise: (x, y) goes to (-y, x). The sun turns along.
    turned = render_mesh(mesh, (64, 64), attitude=(20, -30, 100), sun=(-sun[1], sun[0], sun[2]))
    # The shadow map is sampled along other axes, so samples on the edges of shadows may differ.
    difference = (turned - torch.rot90(upright)).abs()
    assert float(difference.sum() / upright.sum()) < 0.005
    assert float((turned - upright).abs().sum() / upright.sum()) > 0.5


def test_the_sun_changes_the_shading_but_not_the_outline():
    views = [
        render_mesh(satellite_mesh(), (64, 64), attitude=(25, -30, 15), sun=s)
        for s in ((-1, 1, 1), (1, 0, 1), (0, -1, 1))
    ]
    for image in views[1:]:
        assert bool(((image > 0) == (views[0] > 0)).all())
        assert float((image / image.sum() - views[0] / views[0].sum()).abs().sum()) > 0.2


@settings(max_examples=15, derandomize=True, deadline=None)
@given(
    attitude=st.tuples(*[st.floats(-180, 180)] * 3),
    size=st.floats(0.2, 1.0),
    shape=st.tuples(st.integers(24, 80), st.integers(24, 80)),
)
def test_the_outline_has_the_wanted_size_and_is_centred(attitude, size, shape):
    mesh = solid(trimesh.creation.box((3, 2, 1)))
    image = render_mesh(mesh, shape, attitude=attitude, size=size)
    assert image.shape == shape
    assert bool((image >= 0).all())
    rows, columns = torch.nonzero(image, as_tuple=True)
    spans = [float(k.max() - k.min()) + 1 for k in (rows, columns)]
    fraction = max(spans[0] / shape[0], spans[1] / shape[1])
    # pixels that are touched exceed the outline by less than one on either side; a sharp corner may slip through the
    # samples of at most one
    assert size - 1 / min(shape) <= fraction <= size + 2 / min(shape)
    for k, side in ((rows, shape[0]), (columns, shape[1])):
        assert abs(float(k.max() + k.min() + 1) / 2 - side / 2) <= 1


def test_dtype_follows_the_request():
    image = render_mesh(plate(1, 1), (8, 8), dtype=torch.float32)
    assert image.dtype == torch.float32
    assert render_mesh(plate(1, 1), (8, 8)).dtype == torch.float64


def test_packaged_satellite_has_the_parts_that_were_asked_for():
    mesh = satellite_mesh()
    assert np.isfinite(mesh.triangles).all()
    assert len({len(values) for values in mesh}) == 1
    lengths = np.ptp(mesh.triangles, axis=(0, 1))
    assert lengths[0] > 8 > lengths[1]  # wing to wing, then dish to nozzle
    # coincident faces would fight for the depth
    corners = np.sort(mesh.triangles.round(9).view("f8,f8,f8")[..., 0], axis=1)
    assert len(np.unique(corners, axis=0)) == len(corners)


@pytest.mark.parametrize(
    ("view", "message"),
    [
        ({"attitude": (0, 0)}, "attitude"),
        ({"attitude": (0, 0, math.nan)}, "attitude"),
        ({"sun": (0, 0, 0)}, "sun"),
        ({"sun": (0, 0, math.inf)}, "sun"),
        ({"size": 0.0}, "size"),
        ({"size": 1.5}, "size"),
        ({"size": math.nan}, "size"),
        ({"ambient": -0.1}, "ambient"),
    ],
)
def test_bad_views_are_refused(view, message):
    with pytest.raises(ValueError, match=message):
        render_mesh(plate(1, 1), (8, 8), **view)


def test_a_raster_beyond_the_memory_is_refused():
    with pytest.raises(ValueError, match="n_pixels is 10000000: that takes at least"):
        render_mesh(plate(1, 1), (10**7, 10**7))


def test_meshes_without_outline_are_refused():
    for triangles in (np.zeros((1, 3, 3)), np.full((1, 3, 3), np.nan)):
        with pytest.raises(ValueError, match="outline"):
            render_mesh(matt(triangles), (8, 8))
    with pytest.raises(ValueError, match="black"):  # seen edge-on
        render_mesh(plate(1, 1), (8, 8), attitude=(90, 0, 0))


def test_meshes_from_files(tmp_path):
    (tmp_path / "two.mtl").write_text("newmtl dark\nKd 0.2 0.2 0.2\nnewmtl red\nKd 0.9 0.3 0.0\n")
    (tmp_path / "two.obj").write_text(
        "mtllib two.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nusemtl dark\nf 1 2 3\nusemtl red\nf 1 2 4\nf 1 3 4\n"
    )
    mesh = load_mesh(tmp_path / "two.obj")
    assert mesh.triangles.shape == (3, 3, 3)
    assert sorted(mesh.albedo) == pytest.approx([0.2, 0.4, 0.4], abs=1 / 255)  # materials are read with 8 bits
    trimesh.creation.box((1, 2, 3)).export(tmp_path / "box.stl")
    stl = load_mesh(tmp_path / "box.stl")
    assert np.ptp(stl.triangles, axis=(0, 1)) == pytest.approx([1, 2, 3])
    assert (stl.albedo > 0).all()


def test_bad_mesh_files_are_refused(tmp_path):
    with pytest.raises(ValueError, match="no mesh file"):
        load_mesh(tmp_path / "missing.obj")
    for name, text in (
        ("empty.obj", ""),
        ("points.obj", "v 0 0 0\nv 1 0 0\n"),
        ("model.unknown", "x"),
        ("bad.glb", "x"),
    ):
        (tmp_path / name).write_text(text)
        with pytest.raises(ValueError, match=name):
            load_mesh(tmp_path / name)
    (tmp_path / "nan.obj").write_text("v 0 0 0\nv nan 0 0\nv 0 1 0\nf 1 2 3\n")
    with pytest.raises(ValueError, match="not finite"):
        load_mesh(tmp_path / "nan.obj")


def test_agrees_with_an_independent_renderer(shared):
    # mars_global_surveyor_512.npz is a render without cast shadows. Its attitude, sun, ambient light and scale (four
    # numbers of light for some thousands of pixels) were found by matching outlines and then brightness.
    reference = np.load(shared / "scenes" / "mars_global_surveyor_512.npz")["image"].astype(float)
    view = {
        "attitude": (57.366, 28.525, 17.100),
        "sun": (0.5924, 0.3541, 0.7237),
        "size": 445 / 512,
        "ambient": 0.02949,
    }
    image = render_mesh(load_mesh(shared / "scenes" / "mars_global_surveyor.obj"), (512, 512), **view).numpy() * 1.0173
    # Only pixels on the outline may differ, and the outline is about as long as 15 % of the area.
    assert np.mean((image > 0) != (reference > 0)) < 0.025 * np.mean(reference > 0)

    def flat(picture):
        return (picture > 0) & (maximum_filter(picture, 5) - minimum_filter(picture, 5) < 0.01 * picture)

    ratio = (image / np.where(reference > 0, reference, 1))[flat(image) & flat(reference)]
    assert len(ratio) > 5000
    shadowed = ratio < 0.5
    assert np.mean(shadowed) < 0.1
    # Materials were stored with 8 bits, of values of 40 and more: 1/80.
    assert np.mean(np.abs(ratio[~shadowed] - 1) < 1 / 80) > 0.95

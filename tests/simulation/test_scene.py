"""Scenes: flux, size and place whatever the source, and refusal of files that are no scene."""

import math

import numpy as np
import pytest
import torch
import trimesh
from astropy.io import fits
from skimage import io

from torchmask.simulation.scene import SceneOptions, load_image, make_scene


@pytest.fixture
def picture():
    """An L: tall to the left, a foot to the right, on black."""
    image = np.zeros((40, 60))
    image[5:35, 10:20] = 1.0
    image[25:35, 20:40] = 0.5
    return image


@pytest.fixture
def files(tmp_path, picture):
    np.savez(tmp_path / "l.npz", image=picture)
    io.imsave(tmp_path / "l.png", (picture * 200).astype(np.uint8), check_contrast=False)
    fits.writeto(tmp_path / "l.fits", picture)
    trimesh.creation.box((3, 2, 1)).export(tmp_path / "box.obj")
    return tmp_path


@pytest.mark.parametrize("name", [None, "l.npz", "l.png", "l.fits", "box.obj"])
@pytest.mark.parametrize("shape", [(64, 64), (48, 80)])
def test_every_source_gives_the_flux_size_and_place_asked_for(files, name, shape):
    options = SceneOptions(path=None if name is None else files / name, size=0.5)
    scene = make_scene(shape, 3e5, options)
    assert scene.shape == shape
    assert scene.dtype == torch.float64
    assert float(scene.sum()) == pytest.approx(3e5, rel=1e-12)
    assert bool((scene >= 0).all())
    rows, columns = torch.nonzero(scene, as_tuple=True)
    spans = [int(k.max() - k.min()) + 1 for k in (rows, columns)]
    # outlines are cut at pixels: one more on either side at most
    assert 0.5 * min(shape) - 1 <= max(spans[0] / shape[0], spans[1] / shape[1]) * min(shape) <= 0.5 * min(shape) + 2
    for k, side in ((rows, shape[0]), (columns, shape[1])):
        assert abs(float(k.max() + k.min() + 1) / 2 - side / 2) <= 1
    assert bool((scene[:3] == 0).all())


@pytest.mark.parametrize("shape", [(64, 64), (33, 48)])
def test_a_single_lit_pixel_is_a_point_of_any_size(tmp_path, shape):
    image = np.zeros((64, 64))
    image[20, 41] = 3.0
    np.savez(tmp_path / "star.npz", image=image)
    for options in ({}, {"size": 0.1}, {"size": 1.0}, {"attitude": (0, 0, 30)}):
        scene = make_scene(shape, 3e5, SceneOptions(path=tmp_path / "star.npz", **options))
        assert scene.count_nonzero() == 1
        assert float(scene[shape[0] // 2, shape[1] // 2]) == pytest.approx(3e5, rel=1e-12)


def test_black_margins_of_an_image_do_not_count(tmp_path):
    image = np.zeros((64, 64))
    image[20:22, 40:42] = 3.0
    np.savez(tmp_path / "square.npz", image=image)
    scene = make_scene((64, 64), 1.0, SceneOptions(path=tmp_path / "square.npz", size=0.5))
    assert scene.count_nonzero() == 32 * 32


def test_images_keep_their_way_up_and_their_contrast(files):
    for name in ("l.npz", "l.png", "l.fits"):
        scene = make_scene((60, 60), 1.0, SceneOptions(path=files / name, size=0.5))  # one pixel for one
        assert scene.count_nonzero() == 30 * 10 + 10 * 20
        foot = scene[35:45, 15:45]
        assert foot.min() > 0
        assert float(scene[20, 20] / scene[40, 40]) == pytest.approx(2, rel=1e-9)
        assert scene[20, 40] == 0


def test_an_image_turns_in_its_plane(files):
    upright = make_scene((60, 60), 1.0, SceneOptions(path=files / "l.npz", size=0.5))
    turned = make_scene((60, 60), 1.0, SceneOptions(path=files / "l.npz", size=0.5, attitude=(0, 0, 90)))
    assert float((turned - torch.rot90(upright)).abs().sum()) < 1e-9
    oblique = make_scene((60, 60), 1.0, SceneOptions(path=files / "l.npz", size=0.5, attitude=(0, 0, 30)))
    # Second moments say how an outline lies: turned anticlockwise by 30 degrees, y being minus the row.
    assert _axis(oblique) == pytest.approx(_axis(upright) + 30, abs=1.5)


def _axis(scene):
    """Angle of the long axis [degrees], anticlockwise from +x."""
    rows, columns = torch.meshgrid(*(torch.arange(float(n)) for n in scene.shape), indexing="ij")
    x, y = columns - (scene * columns).sum(), -rows + (scene * rows).sum()
    xx, yy, xy = ((scene * product).sum() for product in (x * x, y * y, x * y))
    return math.degrees(0.5 * math.atan2(2 * xy, xx - yy)) % 180


def test_down_sampling_averages_rather_than_picks(tmp_path):
    image = np.zeros((400, 400))
    image[::2] = 1.0  # lines finer than the pixels of the scene
    image[-1] = 1.0
    np.savez(tmp_path / "lines.npz", image=image)
    scene = make_scene((64, 64), 1.0, SceneOptions(path=tmp_path / "lines.npz", size=0.5))
    inside = scene[20:44, 20:44]
    assert float(inside.std() / inside.mean()) < 0.02


def test_colours_are_averaged_and_transparency_is_black(tmp_path):
    pixels = np.zeros((8, 8, 4), dtype=np.uint8)
    pixels[2:6, 2:6] = (30, 60, 90, 255)
    pixels[0, 0] = (255, 255, 255, 0)
    io.imsave(tmp_path / "colour.png", pixels, check_contrast=False)
    image = load_image(tmp_path / "colour.png")
    assert image[0, 0] == 0
    assert float(image[3, 3]) == pytest.approx(60 * 255)
    assert image.count_nonzero() == 16


def test_fits_extensions_are_searched(tmp_path):
    extension = fits.ImageHDU(np.ones((5, 6), dtype=">f4"))
    fits.HDUList([fits.PrimaryHDU(), extension]).writeto(tmp_path / "extension.fits")
    assert load_image(tmp_path / "extension.fits").shape == (5, 6)


def test_float32_and_the_packaged_default():
    scene = make_scene((32, 32), 1e7, dtype=torch.float32)
    assert scene.dtype == torch.float32
    assert float(scene.sum()) == pytest.approx(1e7, rel=1e-5)
    lit = scene > 0
    assert 0.05 < float(lit.double().mean()) < 0.3
    assert float(scene[lit].std() / scene[lit].mean()) > 0.5  # dish, cells and glints differ


@pytest.mark.parametrize("n_photons", [0.0, -1.0, math.nan, math.inf])
def test_bad_fluxes_are_refused(n_photons):
    with pytest.raises(ValueError, match="n_photons"):
        make_scene((32, 32), n_photons)


@pytest.mark.parametrize("size", [0.0, 1.01, math.nan])
def test_bad_sizes_are_refused(size):
    with pytest.raises(ValueError, match="size"):
        SceneOptions(size=size)


@pytest.mark.parametrize("options", [{"attitude": (10, 0, 0)}, {"attitude": (0, 5, 0)}, {"sun": (0, 0, 1)}])
def test_images_are_neither_lit_nor_turned_out_of_their_plane(files, options):
    with pytest.raises(ValueError, match="an image rotates only in its plane"):
        make_scene((32, 32), 1.0, SceneOptions(path=files / "l.png", **options))


@pytest.mark.parametrize("suffix", [".npz", ".png", ".fits", ".obj"])
def test_missing_and_damaged_files_are_refused(tmp_path, suffix):
    path = tmp_path / f"target{suffix}"
    with pytest.raises(ValueError, match="target"):
        make_scene((32, 32), 1.0, SceneOptions(path=path))
    path.write_bytes(b"this is no image")
    with pytest.raises(ValueError, match="target"):
        make_scene((32, 32), 1.0, SceneOptions(path=path))


def test_truncated_files_are_refused(files):
    for name in ("l.npz", "l.png", "l.fits"):
        whole = (files / name).read_bytes()
        (files / name).write_bytes(whole[: len(whole) // 2])
        with pytest.raises(ValueError, match=name):
            load_image(files / name)


def test_unknown_kinds_are_refused(tmp_path):
    for name in ("target.jpg", "target"):
        (tmp_path / name).write_bytes(b"x")
        with pytest.raises(ValueError, match=name):
            make_scene((32, 32), 1.0, SceneOptions(path=tmp_path / name))
    with pytest.raises(ValueError, match="unknown kind"):
        load_image(tmp_path / "target.jpg")


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.zeros((4, 4)), "black"),
        (-np.eye(4), "negative"),
        (np.full((4, 4), np.nan), "not finite"),
        (np.ones((2, 4, 4)), "shape"),
        (np.ones(4), "shape"),
    ],
)
def test_images_that_are_no_scene_are_refused(tmp_path, image, message):
    np.savez(tmp_path / "bad.npz", image=image)
    with pytest.raises(ValueError, match=message):
        load_image(tmp_path / "bad.npz")


def test_files_without_an_image_are_refused(tmp_path):
    np.savez(tmp_path / "other.npz", object=np.ones((4, 4)))
    with pytest.raises(ValueError, match="image"):
        load_image(tmp_path / "other.npz")
    np.savez(tmp_path / "pickled.npz", image=np.array([{}], dtype=object))
    with pytest.raises(ValueError, match="pickled"):
        load_image(tmp_path / "pickled.npz")
    fits.writeto(tmp_path / "cube.fits", np.ones((3, 4, 4)))
    with pytest.raises(ValueError, match="two-dimensional"):
        load_image(tmp_path / "cube.fits")


@pytest.mark.parametrize("name", [None, "l.npz"])
def test_one_number_is_a_square_and_whole_numbers_may_be_floats(files, name):
    options = SceneOptions(path=None if name is None else files / name)
    square = make_scene((32, 32), 1e6, options)
    for shape in (32, 32.0, (32.0, 32), [32, 32]):
        assert torch.equal(make_scene(shape, 1e6, options), square)


@pytest.mark.parametrize(
    ("shape", "error", "message"),
    [
        ((0, 32), ValueError, r"rows is 0: it must be a whole number of at least 1, as shape is \(rows, columns\)"),
        ((32, 2.5), ValueError, r"columns is 2\.5: it must be a whole number"),
        (0, ValueError, "rows is 0"),
        ((1, 2, 3), ValueError, r"shape is \(1, 2, 3\): it must be \(rows, columns\), or one number"),
        (None, TypeError, "rows is None: it must be a whole number"),
    ],
)
def test_fields_of_no_pixels_are_refused(shape, error, message):
    with pytest.raises(error, match=message):
        make_scene(shape, 1e6)

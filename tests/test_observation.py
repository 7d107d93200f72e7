"""An observation and its file, its directions on the sky, and the checks that frames pass."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from torchmask.grid import Grid
from torchmask.observation import PHASE_OVERSAMPLING, Observation, check_frames
from torchmask.optics.aperture import FullAperture, SparseAperture
from torchmask.optics.pixel import MappedPixel, SquarePixel
from torchmask.optics.shapes import Annulus, Disc, Hexagon

GRID = Grid((16, 20), 1e-7, 550e-9)
ARRAYS = ("frames", "object", "psfs", "phases", "valid", "errors")


@pytest.fixture
def mask():
    return SparseAperture([[0.0, 0.38], [0.33, -0.2], [-0.35, -0.15]], 0.2, 1.0)


def frames_of(n, seed=0):
    return torch.rand(n, *GRID.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def phases_of(mask, n):
    samples = mask.samples(GRID, PHASE_OVERSAMPLING).weights.shape
    return torch.rand(n, *samples, dtype=torch.float64, generator=torch.Generator().manual_seed(5))


# --- the file


def test_everything_survives_the_file(tmp_path, mask):
    whole = Observation(
        frames_of(3),
        mask,
        GRID,
        readout_noise=1.5,
        object=frames_of(1, 1)[0],
        psfs=frames_of(3, 2),
        phases=phases_of(mask, 3),
        r0=0.15,
        outer_scale=20.0,
        n_photons=1e6,
        valid=frames_of(3, 3) > 0.1,
        errors=frames_of(3, 4),
        header={"OBJECT": "satellite", "CRPIX1": 5.0, "EQUINOX": 2000},
        pixel=SquarePixel(0.8),
        frame_numbers=(4, 5, 9),
    )
    whole.save(tmp_path / "a.npz")
    back = Observation.load(tmp_path / "a.npz")
    for name in ARRAYS:
        assert torch.equal(getattr(back, name), getattr(whole, name)), name
    for name in ("grid", "readout_noise", "r0", "outer_scale", "n_photons", "header", "pixel", "frame_numbers"):
        assert getattr(back, name) == getattr(whole, name), name
    assert torch.equal(back.aperture.centers, mask.centers)
    for name in ("subaperture_diameter", "mask_diameter", "shape"):
        assert getattr(back.aperture, name) == getattr(mask, name), name


def test_a_map_of_a_pixel_survives_the_file_and_a_response_of_ones_own_is_refused(tmp_path, mask):
    seen = Observation(frames_of(2), mask, GRID, None, pixel=MappedPixel(torch.eye(4).double(), 2))
    seen.save(tmp_path / "map.npz")
    back = Observation.load(tmp_path / "map.npz").take([1]).pixel
    assert isinstance(back, MappedPixel)
    assert (str(back), back.samples) == ("map of 4 x 4 samples, 2 per pixel", 2)
    assert torch.equal(back.sensitivity, seen.pixel.sensitivity)

    class Round:
        def transfer(self, nu_y, nu_x):
            return torch.exp(-(nu_y**2) - nu_x**2)

    with pytest.raises(ValueError, match="a Round cannot be written to a file: give a SquarePixel or a MappedPixel"):
        dataclasses.replace(seen, pixel=Round()).save(tmp_path / "own.npz")


def test_some_frames_come_with_what_belongs_to_them(mask):
    per_frame = {"psfs": frames_of(4, 1), "phases": phases_of(mask, 4), "errors": frames_of(4, 2)}
    per_frame |= {"valid": frames_of(4, 3) > 0.5, "transmission": torch.rand(4)}
    whole = Observation(frames_of(4), mask, GRID, 1.5, object=frames_of(1)[0], header={"OBJECT": "x"}, **per_frame)
    part = whole.take([3, 1])
    assert (whole.frame_numbers, part.frame_numbers) == ((0, 1, 2, 3), (3, 1))
    assert part.take([1]).frame_numbers == (1,)
    for name in ("frames", *per_frame):
        assert torch.equal(getattr(part, name), getattr(whole, name)[[3, 1]]), name
    assert part.object is whole.object
    assert part.header == whole.header
    common = Observation(frames_of(4), mask, GRID, None, valid=frames_of(1)[0] > 0.5)
    assert torch.equal(common.take([2]).valid, common.valid)
    assert common.take([2]).errors is None


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_what_is_not_known_is_not_known_afterwards(tmp_path, dtype):
    pupil = FullAperture(1.0, central_obstruction=0.25)
    Observation(frames_of(2).to(dtype), pupil, GRID, readout_noise=None).save(tmp_path / "a.npz")
    back = Observation.load(tmp_path / "a.npz")
    assert isinstance(back.aperture, FullAperture)
    assert back.aperture.central_obstruction == 0.25
    assert back.frames.dtype == dtype
    unknown = ("readout_noise", "object", "psfs", "phases", "r0", "outer_scale", "n_photons", "valid", "errors")
    assert all(getattr(back, name) is None for name in unknown)
    assert back.header == {}


def test_files_of_version_0_1_are_read(tmp_path):
    """The keys that 0.1.0 wrote, as numpy writes them."""
    frames = np.random.default_rng(0).random((2, 8, 8), dtype=np.float32)
    old = {
        "frames": frames,
        "pixel_scale": 2.75e-7,
        "wavelength": 550e-9,
        "centers": np.array([[0.0, 0.3], [0.3, -0.2], [-0.3, -0.2]]),
        "subaperture_diameter": 0.2,
        "mask_diameter": 1.0,
        "shape": "hexagon",
        "orientation": 0.1,
        "central_obstruction": 0.0,
        "readout_noise": 2.0,
        "object": 100 * frames[0],
        "psfs": frames / 64,
        "valid": np.ones((8, 8), dtype=bool),
        "r0": 0.15,
        "outer_scale": 20.0,
        "n_photons": 1e5,
        "header": '{"OBJECT": "satellite"}',
    }
    np.savez(tmp_path / "old.npz", **old)
    back = Observation.load(tmp_path / "old.npz")
    assert torch.equal(back.frames, torch.from_numpy(frames))
    assert torch.equal(back.object, torch.from_numpy(old["object"]))
    assert torch.equal(back.psfs, torch.from_numpy(old["psfs"]))
    assert back.valid.all()
    assert back.grid == Grid(8, 2.75e-7, 550e-9)
    assert back.aperture.shape == Hexagon(0.1)
    assert (back.readout_noise, back.r0, back.outer_scale, back.n_photons) == (2.0, 0.15, 20.0, 1e5)
    assert back.header == {"OBJECT": "satellite"}
    # the least that such a file had to hold
    needed = ("frames", "centers", "subaperture_diameter", "mask_diameter", "pixel_scale", "wavelength")
    np.savez(tmp_path / "least.npz", **{name: old[name] for name in needed})
    least = Observation.load(tmp_path / "least.npz")
    assert least.aperture.shape == Disc()
    assert least.readout_noise is None
    for name in needed:
        np.savez(tmp_path / f"no_{name}.npz", **{key: old[key] for key in needed if key != name})
        with pytest.raises(ValueError, match=f"has no {name!r}"):
            Observation.load(tmp_path / f"no_{name}.npz")


def test_obstructed_pupils_of_version_0_1_are_read(tmp_path):
    """They were discs, with the obstruction beside them."""
    old = {
        "frames": np.ones((2, 8, 8)),
        "pixel_scale": 2.75e-7,
        "wavelength": 550e-9,
        "centers": np.zeros((1, 2), dtype=np.float32),
        "subaperture_diameter": 1.0,
        "mask_diameter": 1.0,
        "shape": "disc",
        "orientation": 0.0,
        "central_obstruction": 0.25,
    }
    np.savez(tmp_path / "old.npz", **old)
    pupil = Observation.load(tmp_path / "old.npz").aperture
    assert isinstance(pupil, FullAperture)
    assert (pupil.central_obstruction, pupil.shape, pupil.centers.dtype) == (0.25, Annulus(0.25), torch.float32)


def test_files_of_another_program_are_read(shared_stack):
    mask, full = (shared_stack(f"skylab_1e7_{kind}") for kind in ("mask", "full"))
    assert isinstance(mask.aperture, SparseAperture)
    assert isinstance(full.aperture, FullAperture)
    assert mask.aperture.n_subapertures == 11
    assert mask.aperture.fill_factor == pytest.approx(0.15, rel=1e-3)
    assert full.aperture.mask_diameter == pytest.approx(mask.aperture.extent, rel=1e-9)
    assert mask.frames.shape == (20, 128, 128)
    assert mask.grid.cutoff(1.0) == pytest.approx(0.5)


def test_a_file_is_never_replaced(tmp_path, mask):
    observation = Observation(frames_of(2), mask, GRID, readout_noise=None)
    with pytest.raises(ValueError, match=r"\.npz"):
        observation.save(tmp_path / "a.fits")
    observation.save(tmp_path / "a.npz")
    before = (tmp_path / "a.npz").read_bytes()
    with pytest.raises(ValueError, match="exists"):
        observation.save(tmp_path / "a.npz")
    assert (tmp_path / "a.npz").read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["a.npz"]


def test_files_that_are_none_are_refused(tmp_path, mask):
    with pytest.raises(ValueError, match="no file"):
        Observation.load(tmp_path / "missing.npz")
    (tmp_path / "text.npz").write_text("no archive")
    Observation(frames_of(2), mask, GRID, readout_noise=None).save(tmp_path / "good.npz")
    whole = (tmp_path / "good.npz").read_bytes()
    (tmp_path / "half.npz").write_bytes(whole[: len(whole) // 2])
    for name in ("text.npz", "half.npz"):
        with pytest.raises(ValueError, match=name):
            Observation.load(tmp_path / name)


@pytest.mark.parametrize(
    "change",
    [
        {"frames": np.ones(5)},
        {"frames": np.ones((2, 16, 32))},
        {"centers": np.ones((4, 3))},
        {"pixel_scale": np.float64(-1.0)},
        {"wavelength": np.array([1.0, 2.0])},
        {"psfs": np.ones((1, 16, 20))},
        {"shape": np.array("blob")},
    ],
    ids=lambda change: next(iter(change)),
)
def test_a_file_whose_parts_disagree_says_so(tmp_path, mask, change):
    Observation(frames_of(2), mask, GRID, readout_noise=None, psfs=frames_of(2, 1)).save(tmp_path / "a.npz")
    np.savez(tmp_path / "b.npz", **dict(np.load(tmp_path / "a.npz")) | change)
    with pytest.raises(ValueError, match=r"b\.npz does not contain a valid observation: "):
        Observation.load(tmp_path / "b.npz")


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"frames": torch.ones(3, 16, 16)}, r"frames has shape \(3, 16, 16\): it must be \(n_frames, 16, 20\)"),
        ({"frames": torch.ones(0, 16, 20)}, r"with at least one frame"),
        ({"valid": torch.ones(3, 16, 20)}, r"valid is torch.float32 of shape \(3, 16, 20\): it must be bool"),
        ({"valid": torch.ones(2, 16, 20, dtype=torch.bool)}, r"valid is torch.bool of shape \(2, 16, 20\)"),
        ({"errors": torch.ones(16, 20)}, r"errors has shape \(16, 20\): it must be \(3, 16, 20\)"),
        ({"phases": torch.ones(3, 3, 7)}, r"phases has shape \(3, 3, 7\): it must be \(3, 3, \d+\)"),
        ({"psfs": torch.ones(1, 16, 20)}, r"psfs has shape \(1, 16, 20\): it must be \(3, 16, 20\)"),
        ({"object": torch.ones(3, 16, 20)}, r"object has shape \(3, 16, 20\): it must be \(16, 20\)"),
        ({"readout_noise": -1.0}, r"readout_noise is -1.0"),
        ({"readout_noise": math.nan}, r"readout_noise is nan"),
    ],
)
def test_an_observation_of_parts_that_disagree_is_refused(mask, fields, message):
    with pytest.raises(ValueError, match=message):
        Observation(**{"frames": torch.ones(3, 16, 20), "readout_noise": None} | fields, aperture=mask, grid=GRID)


# --- the sky


@pytest.mark.parametrize("mirrored", [False, True])
def test_the_sky_matrix_leads_from_pixels_to_east_and_north(mask, sky_cards, mirrored):
    pytest.importorskip("astropy")
    angle = 0.3
    observation = Observation(frames_of(1), mask, GRID, None, header=sky_cards(angle, GRID.pixel_scale, mirrored))
    c, s, parity = math.cos(angle), math.sin(angle), 1 if mirrored else -1
    expected = GRID.pixel_scale * torch.tensor([[parity * c, -parity * s], [s, c]], dtype=torch.float64)
    torch.testing.assert_close(observation.sky_matrix, expected, rtol=1e-12, atol=0)  # a card holds 13 digits


def test_a_header_of_another_scale_tells_only_how_the_sky_lies(mask, sky_cards, sky_matrix):
    """As after `dataclasses.replace(observation, grid=...)`; up to 1 % it is taken as it is, with all its skew."""
    pytest.importorskip("astropy")
    for ratio, scale in ((2.0, 1.0), (0.5, 1.0), (1.02, 1.0), (1.009, 1.009)):
        header = sky_cards(0.3, ratio * GRID.pixel_scale)
        seen = Observation(frames_of(1), mask, GRID, None, header=header).sky_matrix
        expected = torch.from_numpy(sky_matrix(0.3, scale * GRID.pixel_scale))
        torch.testing.assert_close(seen, expected, rtol=1e-12, atol=0)


def test_declination_may_come_first(mask, sky_cards):
    pytest.importorskip("astropy")
    cards = sky_cards(0.3, GRID.pixel_scale)
    swapped = dict(cards)
    for name in ("CTYPE", "CUNIT", "CRVAL"):
        swapped[f"{name}1"], swapped[f"{name}2"] = cards[f"{name}2"], cards[f"{name}1"]
    for axis in (1, 2):
        swapped[f"CD1_{axis}"], swapped[f"CD2_{axis}"] = cards[f"CD2_{axis}"], cards[f"CD1_{axis}"]
    one, other = (Observation(frames_of(1), mask, GRID, None, header=header) for header in (cards, swapped))
    torch.testing.assert_close(other.sky_matrix, one.sky_matrix, rtol=1e-12, atol=0)


@pytest.mark.parametrize("cards", [{}, {"OBJECT": "star"}, {"CDELT1": 1.0, "CDELT2": 1.0}])
def test_without_sky_coordinates_there_is_no_sky_matrix(mask, cards):
    pytest.importorskip("astropy")
    assert Observation(frames_of(1), mask, GRID, None, header=cards).sky_matrix is None


# --- what frames are


def test_bad_pixels_may_hold_anything():
    frames, valid = frames_of(3), torch.ones(GRID.shape, dtype=torch.bool)
    valid[5, 6] = valid[0, 0] = False
    spoilt = frames.clone()
    spoilt[:, 5, 6], spoilt[:, 0, 0] = math.nan, math.inf
    filled, mask = check_frames(spoilt, valid, GRID)
    assert torch.equal(mask, valid.expand(3, -1, -1))
    assert torch.equal(filled[:, valid], frames[:, valid])
    around = (frames[:, 4:7, 5:8].sum((1, 2)) - frames[:, 5, 6]) / 8
    torch.testing.assert_close(filled[:, 5, 6], around)


def test_arrays_and_frames_with_a_gradient_are_frames_too():
    frames = frames_of(3)
    valid = frames > 0.1
    expected = check_frames(frames, valid, GRID)
    of_fits = frames.numpy().astype(">f8"), valid.numpy()  # the most significant byte comes first in FITS
    flipped = (np.flip(np.flip(values.numpy()).copy()) for values in (frames, valid))  # with negative strides
    for given in ((frames.numpy(), valid.numpy()), of_fits, flipped, (frames.clone().requires_grad_(), valid)):
        for one, other in zip(expected, check_frames(*given, GRID), strict=True):
            assert torch.equal(one, other)
            assert not other.requires_grad
    assert check_frames(frames.float(), None, GRID)[0].dtype == torch.float64


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda f: f[0], "at least one frame"),
        (lambda f: f[:, :-1], "the grid needs .*at least one frame$"),
        (lambda f: f.permute(1, 2, 0), "at least one frame: move the last axis, which counts frames, to the front"),
        (lambda f: f[:0], "at least one frame"),
        (lambda f: f.index_fill(0, torch.tensor([1]), math.nan), r"frames \[1\] hold values that are not finite"),
        (lambda f: f.index_fill(0, torch.tensor([2]), 0.0), r"frames \[2\] hold no light"),
        (lambda f: -f, r"frames \[0, 1, 2\] hold no light: their mean pixel is not positive.*less sky"),
        (lambda f: f + 0j, "must be real"),
    ],
)
def test_what_is_no_stack_of_frames_is_refused(change, message):
    with pytest.raises(ValueError, match=message):
        check_frames(change(frames_of(3)), None, GRID)


def test_valid_pixels_must_fit_the_frames():
    ones = torch.ones(2, *GRID.shape, dtype=torch.bool)  # for three frames
    for valid in (torch.ones(GRID.shape), ones[0, :4, :4], ones):
        with pytest.raises(ValueError, match=r"valid is torch\.\w+ of shape .*: it must be bool"):
            check_frames(frames_of(3), valid, GRID)
    with pytest.raises(ValueError, match=r"frames .* have no valid pixel: .* `valid` is True where a pixel counts"):
        check_frames(frames_of(3), ~ones[0], GRID)

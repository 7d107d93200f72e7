"""What frames of an object say about the mask: how it lies, which it is, and what they cannot say."""

import math
import re
import warnings
from typing import get_type_hints

import pytest
import torch

from torchmask.atmosphere.phase import TurbulencePhase
from torchmask.grid import Grid
from torchmask.interferometry.calibration import calibrate_mask
from torchmask.interferometry.fringe_power import FringePower, fringe_wavelengths
from torchmask.interferometry.fringes import frame_observables
from torchmask.interferometry.which_mask import ORIENTATIONS, MaskLook, look_at_mask
from torchmask.observation import Observation
from torchmask.optics.aperture import FullAperture, SparseAperture
from torchmask.optics.bad_pixels import fill_bad_pixels
from torchmask.optics.band import Band
from torchmask.optics.detector import Detector
from torchmask.optics.geometry import MaskGeometry
from torchmask.restoration.myopic import MyopicDeconvolution
from torchmask.restoration.verdict import Verdict
from torchmask.simulation.conditions import Conditions
from torchmask.simulation.exposures import simulate_observation
from torchmask.simulation.scene import make_scene

GRID = Grid.nyquist(1.0, 550e-9, 64)
FINER = Grid.nyquist(1.0, 550e-9, 64, oversampling=1.7)  # for bands
MASK = SparseAperture.from_catalog("golay9", 1.0, 0.12)
UNKNOWN = SparseAperture.random(9, 1.0, 0.12, torch.Generator().manual_seed(4))  # to the catalogue
EIGHT = SparseAperture.random(8, 1.0, 0.15, torch.Generator().manual_seed(1))


def exposures(mask, scene=None, n_frames=10):
    scene = make_scene((64, 64), n_photons=1e7).double() if scene is None else scene
    turbulence, generator = TurbulencePhase(r0=1 / 7, outer_scale=20.0), torch.Generator().manual_seed(2)
    return simulate_observation(scene, mask, GRID, turbulence, Detector(1.5), n_frames, generator).frames


@pytest.fixture(scope="module")
def frames():
    return exposures(MASK)


@pytest.fixture(scope="module")
def frames_of_unknown():
    return exposures(UNKNOWN)


def test_of_the_right_mask_there_is_nothing_to_say(frames):
    assert look_at_mask(frames, MASK, GRID) == MaskLook()
    assert look_at_mask(frames, MASK.replace(-MASK.centers), GRID) == MaskLook()  # half a turn changes nothing


@pytest.mark.parametrize("name", ORIENTATIONS)
def test_another_orientation_is_named(frames, name):
    """The mask is told as the inverse of what fits; mirrors and swaps are their own inverses."""
    told = ORIENTATIONS[name].apply(MASK)
    assert f"fit the mask better {name} than as given" in look_at_mask(frames, told, GRID).contradiction


def test_the_mask_of_the_catalogue_that_was_in_the_beam_is_named(frames):
    found = look_at_mask(frames, UNKNOWN, GRID).contradiction
    assert "not those of the mask in any of its eight orientations" in found
    assert "but fit golay9 of the catalogue (0." in found
    mirrored = frames.flip(2).roll(1, 2)  # about pixel 32
    found = look_at_mask(mirrored, UNKNOWN, GRID).contradiction
    assert "but fit golay9 of the catalogue with x reversed (0." in found


def test_a_mask_that_is_turned_or_of_another_size_is_named_as_such(frames_of_unknown):
    """Angles and scales are tried in steps of a hole's over the mask's diameter: at most half of that is missed."""
    step = UNKNOWN.subaperture_diameter

    def fitting(geometry, words):
        told = look_at_mask(frames_of_unknown, geometry.apply(UNKNOWN), GRID).contradiction
        found = re.search(f"but fit it {words} by about ([\\d.]+)", told)
        assert found is not None, told
        return float(found[1])

    assert abs(fitting(MaskGeometry(-0.6), "turned") - math.degrees(0.6)) < math.degrees(step) / 2 + 0.5
    mirrored = fitting(MaskGeometry(0.6, mirrored=True), "with x reversed, then turned")  # its own inverse
    assert abs(mirrored - math.degrees(0.6)) < math.degrees(step) / 2 + 0.5
    assert abs(math.log(fitting(MaskGeometry(0.0, 1.25, 1.25), "magnified") / 0.8)) < step / 2 + 0.01


@pytest.mark.parametrize("value", [0.0, 100.0])
def test_noise_says_nothing(value):
    generator = torch.Generator().manual_seed(0)
    noise = value + torch.randn(6, 64, 64, generator=generator, dtype=torch.float64)
    assert look_at_mask(noise, MASK, GRID) == MaskLook()


def test_a_share_below_zero_contradicts_no_mask():
    """Six frames of a ball show -0.83 +- 0.71 of the right mask's pattern, more than two errors below the least."""
    grid = Grid.nyquist(1.0, 550e-9, 32)
    y, x = torch.meshgrid(torch.arange(-16, 16), torch.arange(-16, 16), indexing="ij")
    ball = (1 - (x / 9) ** 2 - (y / 9) ** 2).clamp(min=0).sqrt().double()
    mask = SparseAperture.from_catalog("golay9", 1.0, 0.15)
    seed = torch.Generator().manual_seed(9)
    frames = simulate_observation(
        ball * (1e5 / ball.sum()), mask, grid, TurbulencePhase(0.2, 20.0), Detector(1.5), 6, seed
    ).frames
    power = FringePower.of(frames, mask, grid)
    assert power is not None
    share, error = power.match(mask)
    assert share + 2 * error < 0.6  # the least that the right mask has
    assert look_at_mask(frames, mask, grid) == MaskLook()


def in_light_of(light):
    """A mask of 14 holes, and frames of it."""
    mask = SparseAperture.random(14, 1.0, 0.12, torch.Generator().manual_seed(2))
    turbulence, generator = TurbulencePhase(r0=1 / 4, outer_scale=20.0), torch.Generator().manual_seed(5)
    seen = make_scene((64, 64), n_photons=1e6).double(), mask, FINER, turbulence, Detector(1.5), 8, generator
    return mask, simulate_observation(*seen, conditions=Conditions(band=light)).frames


def test_the_fringes_of_a_band_are_those_of_all_its_wavelengths():
    """The light has more wavelengths than are told; the pattern of one would accuse the right mask."""
    mask, frames = in_light_of(Band.top_hat(550e-9, 440e-9, 9))
    band = Band.top_hat(550e-9, 440e-9)
    powers = [FringePower.of(frames, mask, FINER, some) for some in ([], fringe_wavelengths(mask, FINER, band))]
    one, whole = (power.match(mask) for power in powers if power is not None)
    assert one.share + 2 * one.error < 0.6 < whole.share
    assert look_at_mask(frames, mask, FINER, band) == MaskLook()
    assert "not those of the mask" in look_at_mask(frames, mask, FINER).contradiction
    turned = MaskGeometry(0.3).apply(mask)
    assert look_at_mask(frames, turned, FINER, band).contradiction


def test_the_fringes_of_light_that_is_not_of_the_grids_wavelength():
    light = Band.of([630e-9])
    mask, frames = in_light_of(light)
    assert look_at_mask(frames, mask, FINER, light) == MaskLook()
    assert "not those of the mask" in look_at_mask(frames, mask, FINER).contradiction


def test_what_a_symmetric_mask_cannot_show_is_said(frames):
    symmetric = SparseAperture.from_catalog("golay3", 1.0, 0.15)
    assert look_at_mask(frames, symmetric, GRID).unseen == "with x reversed"
    for simple in (FullAperture(1.0), MASK.replace(MASK.centers[:2])):
        assert look_at_mask(frames, simple, GRID) == MaskLook()


def test_a_restoration_warns_once_and_its_verdict_says_why(frames):
    mirrored = ORIENTATIONS["with x reversed"].apply(MASK)
    with pytest.warns(UserWarning, match="with x reversed") as caught:
        result = MyopicDeconvolution(mirrored, GRID, n_modes=3, max_iterations=1).restore(frames)
    assert [entry.filename for entry in caught if "with x reversed" in str(entry.message)] == [__file__]
    assert "fit the mask better with x reversed" in result.summary().splitlines()[-1]
    symmetric = SparseAperture.from_catalog("golay3", 1.0, 0.15)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        result = MyopicDeconvolution(symmetric, GRID, n_modes=3, max_iterations=1).restore(frames)
    assert "the mask with x reversed makes the same fringes" in result.summary()
    assert set(MaskLook._fields) <= set(get_type_hints(Verdict))


def test_observables_of_frames_through_another_mask_than_told_are_warned_of(frames):
    mirrored = ORIENTATIONS["with x reversed"].apply(MASK)
    with pytest.warns(UserWarning, match="fit the mask better with x reversed than as given") as caught:
        frame_observables(Observation(frames, mirrored, GRID, 1.5))
    assert caught[0].filename == __file__


def without_the_brightest(frames, share):
    """Frames whose brightest pixels are filled in, and which are left."""
    valid = frames < frames.quantile(1 - share)
    return fill_bad_pixels(frames, valid), valid


def test_pixels_that_were_filled_in_accuse_no_mask(frames):
    """They hide fringes: what is left of the right mask's looks like those of none."""
    filled, valid = without_the_brightest(frames.double(), 0.08)
    assert float((filled * ~valid).sum() / filled.sum()) > 0.05
    assert "in any of its eight orientations" in look_at_mask(filled, MASK, GRID).contradiction
    assert look_at_mask(filled, MASK, GRID, valid=valid) == MaskLook()
    everywhere = torch.ones_like(valid)
    assert look_at_mask(filled, MASK, GRID, valid=everywhere) == look_at_mask(filled, MASK, GRID)


def test_a_better_orientation_is_named_although_pixels_were_filled_in(frames):
    filled, valid = without_the_brightest(frames.double(), 0.012)
    assert float((filled * ~valid).sum() / filled.sum()) > 0.05
    mirrored = ORIENTATIONS["with x reversed"].apply(MASK)
    assert "better with x reversed than as given" in look_at_mask(filled, mirrored, GRID, valid=valid).contradiction


@pytest.mark.parametrize(("share", "contradicted"), [(0.049, True), (0.051, False)])
def test_a_twentieth_of_the_light_may_be_filled_in(share, contradicted, frames_of_unknown):
    """Of a mask that is not the one told, which no orientation fits."""
    light = frames_of_unknown.double()
    fraction = (light.flatten().sort().values.cumsum(0) / light.sum()).reshape(-1)
    valid = (fraction < 1 - share)[light.flatten().argsort().argsort()].reshape(light.shape)
    assert bool(look_at_mask(light, MASK, GRID, valid=valid).contradiction) == contradicted


@pytest.mark.parametrize(("mask", "share"), [(UNKNOWN, 0.05), (EIGHT, 0.02)])
def test_a_star_whose_brightest_pixels_are_cut_off_is_calibrated_without_them(mask, share):
    """The angle is found within four of its errors; the mask that was told is not refused."""
    star = torch.zeros(64, 64, dtype=torch.float64)
    star[32, 32] = 1e6
    whole = exposures(mask, star, n_frames=2).double().round()
    told = MaskGeometry(rotation=-0.01).apply(mask)
    with pytest.warns(UserWarning, match="the camera seems to cut off there"):
        found = calibrate_mask(whole.clamp(max=float(whole.quantile(1 - share).round())), told, GRID)
    assert found.verdict is not None
    assert found.verdict.explained
    assert found.geometry.rotation == pytest.approx(0.01, abs=4 * float(found.geometry_errors[0]))


def test_a_restoration_compares_the_fringes_of_its_band(frames, monkeypatch):
    told = []

    def note(*arguments):
        told.append(arguments[1:])
        return MaskLook("another mask")

    monkeypatch.setattr("torchmask.restoration.myopic.look_at_mask", note)
    band = Band.of([500e-9, 550e-9], [1.0, 2.0])
    finer = Grid.nyquist(1.0, 550e-9, 64, oversampling=1.2)
    method = MyopicDeconvolution(MASK, finer, 3, wavelengths=band.wavelengths, weights=band.shares, max_iterations=1)
    with pytest.warns(UserWarning, match="another mask"):
        method.restore(frames)
    ((*light, valid),) = told
    assert light == [MASK, finer, band]
    assert torch.equal(valid, torch.ones_like(frames, dtype=torch.bool))


def test_a_calibration_names_the_mask_too():
    star = torch.zeros(64, 64, dtype=torch.float64)
    star[32, 32] = 1e6
    with pytest.raises(ValueError, match=r"not those of this mask at any angle .*: they fit golay9 of the catalogue"):
        calibrate_mask(exposures(MASK, star, 3), UNKNOWN, GRID)

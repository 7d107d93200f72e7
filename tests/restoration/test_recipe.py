"""What a model is made from: the aperture where it lies now, and the aberrations it is assumed to have."""

import math
from dataclasses import replace

import pytest
import torch
from torch import nn

from torchmask.grid import Grid
from torchmask.optics.aperture import FullAperture, SparseAperture
from torchmask.optics.band import Band
from torchmask.optics.zernike import zernike_basis
from torchmask.restoration.aberrations import turbulent_basis
from torchmask.restoration.myopic import MyopicDeconvolution
from torchmask.restoration.recipe import FULL_MODES, MASK_MODES, ModelRecipe

GRID = Grid.nyquist(1.0, 550e-9, 32)
HERE = [[0.0, 0.3], [0.3, -0.2], [-0.3, -0.15]]


def mask(trains=False):
    centers = torch.tensor(HERE, dtype=torch.float64)
    return SparseAperture(nn.Parameter(centers) if trains else centers, 0.3, 1.0)


def recipe(aperture=None, **changes):
    given = {"frame_modes": 3, "static_modes": 0, "r0": 0.2, "outer_scale": 20.0, "whitened": True}
    given |= {"grid": GRID, "band": Band.of([550e-9]), "dtype": torch.float64, "device": None}
    return ModelRecipe(aperture or mask(), **given | changes)


def test_turbulent_parameters_are_white():
    aperture = mask()
    for changes in ({}, {"static_modes": 6}, {"whitened": False}):
        made = recipe(aperture, **changes)
        expected = turbulent_basis(aperture, 3, made.static_modes, made.r0, made.outer_scale, whitened=made.whitened)
        found = made.turbulent_model().aberrations
        torch.testing.assert_close(found.mixing, expected.mixing)
        assert (found.n_modes, found.n_common) == (expected.n_modes, expected.n_common)
        assert made.n_modes == max(3, made.static_modes)


def test_estimated_parameters_are_errors_of_one_sigma():
    covariance = torch.linspace(0.1, 0.9, 9, dtype=torch.float64).diag() ** 2
    basis = recipe().estimated_model(covariance).aberrations
    torch.testing.assert_close(basis.mixing @ basis.mixing.T, covariance)
    with pytest.raises(ValueError, match="covariance is given with static_modes"):
        recipe(static_modes=3).estimated_model(covariance)


@pytest.mark.parametrize("trains", [False, True])
def test_a_model_stands_still_unless_it_follows(trains):
    aperture = mask(trains)
    stands, follows = (recipe(aperture).turbulent_model(follows_aperture=follows) for follows in (False, True))
    assert follows.pupil.aperture is aperture
    assert isinstance(stands.pupil.aperture.centers, nn.Parameter) == trains
    assert not stands.pupil.aperture.centers.requires_grad
    z = torch.ones(1, 8, dtype=torch.float64)
    with torch.no_grad():
        before = stands.psf(z)
        aperture.centers.add_(0.03)
        assert torch.equal(stands.psf(z), before)
        assert not torch.equal(follows.psf(z), before)
        copy = aperture.still()
        assert torch.equal(copy.centers, aperture.centers)
        assert copy.centers.data_ptr() != aperture.centers.data_ptr()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"r0": 0.0}, r"r0 is 0\.0: it must be finite and positive, in m"),
        ({"outer_scale": math.nan}, "outer_scale is nan"),
        ({"frame_modes": 0}, "n_modes is 0: it must be a whole number of at least 1"),
        ({"static_modes": -1}, "static_modes is -1: it must be a whole number of at least 0"),
    ],
)
def test_refuses_numbers_out_of_range(changes, words):
    with pytest.raises(ValueError, match=words):
        recipe(**changes)


@pytest.mark.parametrize("name", ["frame_modes", "static_modes"])
def test_no_more_modes_than_samples_of_a_hole(name):
    """On P samples no more than P modes are independent; the covariance of hundreds would take minutes."""
    pupil = recipe().turbulent_model().pupil
    weights = mask().samples(pupil.grid).weights
    most = int((weights > 0).sum(-1).max())
    modes = zernike_basis(mask().samples(pupil.grid), mask(), most + 30)[0]
    assert torch.linalg.matrix_rank(modes[weights[0] > 0]) <= most
    assert getattr(recipe(**{name: most}), name) == most
    said = name.replace("frame", "n")
    with pytest.raises(
        ValueError, match=f"{said} is {most + 1}: a hole has {most} pupil samples, .* at most {most}, or a"
    ):
        recipe(**{name: most + 1})
    assert recipe(FullAperture(1.0), frame_modes=1000).frame_modes == 1000  # of one opening they are quick to make
    assert getattr(recipe(**{name: most + 1}, whitened=False), name) == most + 1  # no covariance; they may be known


def test_no_more_modes_than_pixels():
    """What has no limit by samples: a full pupil, and modes without a prior; the usual modes are always allowed."""
    for known, most in (({"aperture": FullAperture(1.0)}, 1024), ({"whitened": False}, 341)):
        with pytest.raises(ValueError, match=f"n_modes is 100000: a frame has 1024 pixels, .* at most {most}, or a"):
            recipe(**known, frame_modes=100_000)
    small = {"aperture": FullAperture(1.0), "grid": Grid.nyquist(1.0, 550e-9, 8)}
    assert recipe(**small, frame_modes=FULL_MODES).frame_modes == FULL_MODES


def test_the_piston_of_a_single_opening_is_refused():
    """There would be no parameter left under the prior: a search without aberrations failed within PyTorch."""
    with pytest.raises(ValueError, match="n_modes is 1: the piston of a single opening does not show, take at least 3"):
        recipe(FullAperture(1.0), frame_modes=1)
    assert recipe(FullAperture(1.0), frame_modes=1, whitened=False).n_modes == 1
    assert recipe(FullAperture(1.0), frame_modes=1, static_modes=3).n_modes == 3


def test_a_pixel_scale_in_another_unit_is_told_before_the_holes_are_sampled():
    """Milliarcseconds for arcseconds: each hole had some 10^7 samples then."""
    with pytest.raises(ValueError, match="undersamples an aperture"):
        recipe(grid=replace(GRID, pixel_scale=1e30 * GRID.pixel_scale))


@pytest.mark.parametrize(
    ("options", "in_steps", "first", "then"),
    [
        ({"frame_modes": 10}, True, MASK_MODES, 10),
        ({"frame_modes": 10}, False, 10, 10),  # they begin with aberrations that are known, or were found before
        ({"frame_modes": 10, "whitened": False}, True, 10, 10),
        ({"frame_modes": 10, "static_modes": 15}, True, MASK_MODES, 10),
        ({"frame_modes": MASK_MODES, "last_modes": 28}, True, MASK_MODES, MASK_MODES),  # as nobody asks for more
        ({"frame_modes": 3}, True, 3, 3),
    ],
)
def test_a_search_has_at_most_six_modes(options, in_steps, first, then):
    """Of faint frames and of others, which only differ in the modes that nobody asks for."""
    made = recipe(grid=Grid.nyquist(1.0, 550e-9, 48), **options)
    faint, other = (made.for_frames(in_steps=in_steps, faint=faint, fills_field=False) for faint in (True, False))
    assert (faint.frame_modes, faint.last_modes) == (first, then)
    assert (other.frame_modes, other.last_modes) == (first, max(then, made.last_modes))
    for found in (faint, other):
        assert replace(found, frame_modes=made.frame_modes, last_modes=made.last_modes) == made
        assert (found.finer_basis() is None) == (found.last_modes == first or not made.whitened)


def test_a_full_pupil_has_all_its_modes_however_faint():
    made = recipe(FullAperture(1.0), frame_modes=10, last_modes=15)
    assert made.for_frames(in_steps=True, faint=True, fills_field=True) is made


@pytest.mark.parametrize(("period", "margin"), [(0.25, 0.25), (0.5, 0.5), (0.9, 0.9), (1.2, 1.0)])
def test_around_a_wide_object_is_what_a_hole_brings_in(period, margin):
    """Twice lambda / d, of the reddest light, over the width of the frames. A quarter is the margin of all others."""
    reddest = 650e-9
    hole = 2 * reddest / (period * 48 * GRID.pixel_scale)
    apart = 1.02 * hole * torch.tensor([[0.0, 0.58], [-0.5, -0.29], [0.5, -0.29]], dtype=torch.float64)
    grid = Grid((64, 48), GRID.pixel_scale, GRID.wavelength)
    made = recipe(SparseAperture(apart, hole, 1.0), grid=grid, band=Band.of([550e-9, reddest]))
    for faint in (False, True):
        wide = made.for_frames(in_steps=True, faint=faint, fills_field=True)
        assert wide.margin == pytest.approx(margin, rel=1e-12)
        assert made.for_frames(in_steps=True, faint=faint, fills_field=False).margin == made.margin == 0.25
    assert wide.turbulent_model().window.field.shape[1] >= (1 + margin) * 48


def test_turbulence_that_is_not_told_is_as_wide_as_a_hole():
    """A full pupil spans seven times its r0, and the outer scale is twenty times the mask."""
    for aperture, r0 in ((mask(), 0.3), (FullAperture(1.4), 0.2)):
        grid = Grid.nyquist(1.4, 550e-9, 32)
        made = MyopicDeconvolution(aperture, grid, 3).recipe
        assert made.r0 == pytest.approx(r0, rel=1e-12)
        assert made.outer_scale == pytest.approx(20 * aperture.mask_diameter, rel=1e-12)
        told = MyopicDeconvolution(aperture, grid, 3, r0=0.17, outer_scale=33.0).recipe
        assert (told.r0, told.outer_scale) == (0.17, 33.0)

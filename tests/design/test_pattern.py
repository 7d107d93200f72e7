"""Patterns of real masks: where their holes touch, and the same light through all."""

import math

import pytest
import torch

from torchmask.design.constraints import InsideDisc, NoOverlap
from torchmask.design.pattern import Pattern
from torchmask.optics import catalog
from torchmask.optics.aperture import SparseAperture


@pytest.mark.parametrize("name", catalog.names())
def test_the_largest_fill_factor_is_where_holes_touch(name):
    pattern = Pattern.from_catalog(name)
    most = pattern.largest_fill_factor()
    mask = pattern.afresh(2.0, most * (1 - 1e-9))
    assert bool((NoOverlap().margins(mask) >= 0).all())
    assert float(NoOverlap().margins(mask).min()) < 1e-8
    assert bool((InsideDisc().margins(mask) >= -1e-12).all())
    assert float(mask.area) == pytest.approx(most * math.pi / 4 * 4.0, rel=1e-8)  # in round holes or hexagons
    with pytest.raises(ValueError, match=r"its holes would overlap: it carries a fill factor of at most"):
        pattern.afresh(2.0, most * (1 + 1e-6))


@pytest.mark.parametrize("name", ["golay6", "jwst_niriss_ami_7"])
def test_a_pattern_is_laid_as_the_catalogue_lays_it(name):
    pattern = Pattern.from_catalog(name)
    round_holes = 0.1 * math.pi / 4 / catalog.entry(name).shape.area(1.0)
    expected = SparseAperture.from_catalog(name, 1.0, round_holes)
    torch.testing.assert_close(pattern.afresh(1.0, 0.1).centers, expected.centers, rtol=0, atol=1e-14)
    assert pattern.afresh(1.0, 0.1).subaperture_diameter == pytest.approx(expected.subaperture_diameter, rel=1e-12)


def test_a_pattern_keeps_off_the_rim():
    mask = Pattern.from_catalog("golay6").afresh(1.2, 0.1, rim_margin=0.03)
    assert float(InsideDisc().margins(mask).min()) == pytest.approx(0.03, rel=1e-9)
    assert mask.fill_factor == pytest.approx(0.1, rel=1e-12)


def test_a_rim_margin_scales_the_largest_area_with_the_disc_that_it_leaves():
    """Of a mask of 1.2 m a margin of 0.15 m leaves 0.9 m: (3/4)^2 of the fill factor."""
    pattern = Pattern.from_catalog("golay6")
    most = pattern.largest_fill_factor() * 0.75**2
    mask = pattern.afresh(1.2, most * (1 - 1e-9), rim_margin=0.15)
    assert float(NoOverlap().margins(mask).min()) == pytest.approx(0, abs=1e-8)
    assert float(InsideDisc().margins(mask).min()) == pytest.approx(0.15, rel=1e-9)
    with pytest.raises(ValueError, match=f"a fill factor of at most {most:.4g}"):
        pattern.afresh(1.2, most * (1 + 1e-6), rim_margin=0.15)


def test_a_mask_as_built_is_scaled_with_its_holes():
    built = SparseAperture.from_catalog("jwst_niriss_ami_7")
    scaled = Pattern.from_catalog("jwst_niriss_ami_7").scaled(1.0)
    assert scaled.subaperture_diameter == pytest.approx(0.8 / built.mask_diameter, rel=1e-12)
    torch.testing.assert_close(scaled.centers, built.centers / built.mask_diameter, rtol=1e-14, atol=0)
    assert scaled.shape == built.shape
    assert Pattern.from_catalog("golay6").scaled(1.0) is None


@pytest.mark.parametrize("shape", [(1, 2), (3, 4, 2)])
def test_what_is_no_pattern_is_refused(shape):
    with pytest.raises(ValueError, match=r"mine has centers of shape .*: one mask of at least two holes is needed"):
        Pattern.of("mine", SparseAperture(torch.rand(shape), 0.2, 1.0))


def test_fill_factors_that_are_none_are_refused():
    with pytest.raises(ValueError, match=r"fill_factor is -0\.15"):
        Pattern.from_catalog("golay6").afresh(1.0, -0.15)

"""Which way the masks of the catalogue stand. docs/conventions.md, "Masks"."""

import math

import pytest
import torch

import torchmask as tm
from torchmask.optics import catalog


def test_golay_arrays_stand_on_a_lattice_with_a_row_along_x():
    """x to the right, y up. Golay-3 has its single hole on top; golay-6 holds a pair one pitch apart along x."""
    half, height = 1 / 2, math.sqrt(3) / 6
    golay3 = torch.tensor([[-half, -height], [half, -height], [0.0, 2 * height]], dtype=torch.float64)
    whole = torch.tensor([[-2, 2], [0, -4], [2, 2], [-1, 5], [-2, -4], [3, -1]], dtype=torch.float64)
    golay6 = whole * torch.tensor([half, height], dtype=torch.float64)
    for name, expected in (("golay3", golay3), ("golay6", golay6)):
        torch.testing.assert_close(torch.tensor(catalog.entry(name).centers, dtype=torch.float64), expected)
        # Made to fit a mask it is moved and scaled, never turned or mirrored.
        mask = tm.SparseAperture.from_catalog(name, mask_diameter=1.0, fill_factor=0.1)
        baselines, scaled = expected[1:] - expected[0], mask.centers[1:] - mask.centers[0]
        torch.testing.assert_close(scaled, baselines * (scaled.norm() / baselines.norm()))


def test_hexagons_are_turned_by_the_normal_of_a_side():
    """Segments of the JWST have a flat side that faces +y."""
    mask = tm.SparseAperture.from_catalog("jwst_niriss_ami_7")
    angles = mask.shape.orientation + torch.arange(6, dtype=torch.float64) * math.pi / 3
    assert float((angles - math.pi / 2).abs().min()) < 1e-12


def test_golay6_looks_the_same_after_a_third_of_a_turn():
    mask = tm.SparseAperture.from_catalog("golay6", 1.0, 0.1)
    turn = 2 * math.pi / 3
    rotation = torch.tensor([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]], dtype=torch.float64)
    distance = torch.cdist(mask.centers @ rotation.T, mask.centers).min(1).values
    assert float(distance.max()) < 1e-9


def test_mirrored_reverses_x():
    seen = tm.SparseAperture.from_catalog("jwst_niriss_ami_7")
    other = tm.SparseAperture.from_catalog("jwst_niriss_ami_7", mirrored=True)
    torch.testing.assert_close(other.centers, seen.centers * torch.tensor([-1.0, 1.0], dtype=torch.float64))


def test_the_outermost_edge_touches_the_mask():
    mask = tm.SparseAperture.from_catalog("golay9", mask_diameter=1.5, fill_factor=0.12)
    rim = mask.centers.norm(dim=-1) + mask.subaperture_diameter / 2
    assert float(rim.max()) == pytest.approx(0.75, rel=1e-12)

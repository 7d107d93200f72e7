"""Noll's numbering and unit rms. docs/conventions.md, "Aberrations"."""

import math

import pytest
import torch

import torchmask as tm
from torchmask.atmosphere.von_karman import modal_covariance
from torchmask.optics.zernike import noll, zernike

GRID = tm.Grid.nyquist(diameter=1.2, wavelength=550e-9, n_pixels=256)


def test_modes_count_from_piston_in_the_order_of_noll():
    # Noll 1976, table I: (n, m), cosine for even j and sine for odd j
    table = [(0, 0), (1, 1), (1, -1), (2, 0), (2, -2), (2, 2), (3, -1), (3, 1), (3, -3), (3, 3), (4, 0), (4, 2)]
    assert [noll(j) for j in range(1, 13)] == table


def test_the_first_six_modes_are_those_of_the_textbook():
    x, y = torch.tensor([0.3, 0.4, -0.5], dtype=torch.float64), torch.tensor([0.5, -0.2, 0.1], dtype=torch.float64)
    r2 = x**2 + y**2
    expected = [
        torch.ones_like(x),
        2 * x,
        2 * y,
        math.sqrt(3) * (2 * r2 - 1),
        math.sqrt(6) * 2 * x * y,
        math.sqrt(6) * (x**2 - y**2),
    ]
    torch.testing.assert_close(zernike(torch.stack([x, y], -1), 6), torch.stack(expected, -1))


@pytest.mark.parametrize("shape", ["disc", "hexagon"])
def test_a_coefficient_is_the_rms_over_its_sub_aperture_in_radians(shape):
    mask = tm.SparseAperture([[0.2, 0.1], [-0.25, -0.2]], 0.4, 1.0, shape=shape)
    layer = tm.ZernikePhase(mask, GRID, n_modes=6)
    coefficients = torch.zeros(6, 2, 6, dtype=torch.float64)
    coefficients[range(6), 0, range(6)] = 0.8  # one mode a frame, on the first hole only
    phase, weights = layer(coefficients), mask.samples(GRID).weights
    rms = ((weights * phase**2).sum(-1) / weights.sum(-1)).sqrt()
    torch.testing.assert_close(rms[:, 0], torch.full((6,), 0.8, dtype=torch.float64), rtol=0.01, atol=0)
    assert float(rms[:, 1].max()) == 0


def test_coefficients_of_all_holes_are_ordered_hole_by_hole():
    """In covariances, piston of the second of two holes with 3 modes is row 3, tied to row 0 and not to row 1."""
    mask = tm.SparseAperture([[0.2, 0.0], [-0.2, 0.0]], 0.2, 1.0)
    covariance = modal_covariance(mask, 3, r0=0.1, outer_scale=20.0)
    assert covariance.shape == (6, 6)
    correlation = covariance / torch.outer(covariance.diagonal().sqrt(), covariance.diagonal().sqrt())
    assert float(correlation[0, 3]) > 0.9
    assert abs(float(correlation[0, 1])) < 0.1

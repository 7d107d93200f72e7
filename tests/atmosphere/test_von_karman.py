import math
import time
from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import integrate, special

from torchmask.atmosphere import von_karman
from torchmask.atmosphere.von_karman import (
    modal_covariance,
    von_karman_covariance,
    von_karman_psd,
    von_karman_structure_function,
)
from torchmask.optics.aperture import FullAperture, SparseAperture
from torchmask.optics.polygons import Square
from torchmask.optics.zernike import aperture_modes, noll

# Variance [rad^2] of the modes over a pupil with (D/r0)^(5/3) = 1, by D/L0: all modes, piston, each tilt, each mode of
# radial order 2, each of order 3. From the definition, by direct integration.
TABLE = {
    0.01: (185.95859, 185.2013, 0.31136, 0.023192, 0.00619),
    0.02: (58.57328, 57.88709, 0.27592, 0.023124, 0.006187),
    0.05: (12.71939, 12.15432, 0.216, 0.02274, 0.006163),
    0.1: (4.00636, 3.5555, 0.16067, 0.021709, 0.006081),
    0.2: (1.26192, 0.94044, 0.1009, 0.019006, 0.005786),
    0.5: (0.27403, 0.11758, 0.03431, 0.011278, 0.004412),
    1.0: (0.08631, 0.01681, 0.00878, 0.004499, 0.002374),
    2.0: (0.02719, 0.00178, 0.00133, 0.000958, 0.000681),
}
# Mean square difference of the pistons of two discs d/L0, then by B/d; (d/r0)^(5/3) = 1.
PISTON_DIFFERENCES = {
    0.01: {1: 3.8203, 2: 11.9678, 3: 22.0433, 5: 45.0151, 10: 105.8696},
    0.05: {1: 2.3383, 2: 6.312, 3: 10.0394, 5: 15.7381, 10: 22.1672},
    0.1: {1: 1.5436, 2: 3.6153, 3: 5.0378, 5: 6.4301, 10: 7.0748},
}
KOLMOGOROV = 1e8  # an outer scale: spares all but piston and tilt to 1e-6


def pair(distance, shape="disc", angle=0.0, orientation=0.0):
    """Two holes of diameter 1, `distance` apart at `angle` from +x."""
    vector = distance * torch.tensor([math.cos(angle), math.sin(angle)], dtype=torch.float64)
    return SparseAperture(torch.stack([vector * 0, vector]), 1.0, distance + 1.2, shape, orientation=orientation)


def noll_covariance(i, j):
    """Kolmogorov covariance of Noll modes with (D/r0)^(5/3) = 1 (Noll 1976, with the exact constant 2.246065)."""
    (n, m), (k, q) = noll(i), noll(j)
    if m != q:
        return 0.0
    constant = 2 ** (-8 / 3) * math.gamma(14 / 3) * math.gamma(11 / 6) ** 2
    constant *= (24 / 5 * math.gamma(6 / 5)) ** (5 / 6) / math.pi
    sign = (-1) ** ((n + k - 2 * abs(m)) // 2)
    below = special.gamma((n - k + 17 / 3) / 2) * special.gamma((k - n + 17 / 3) / 2)
    below *= special.gamma((n + k + 23 / 3) / 2)
    return constant * sign * math.sqrt((n + 1) * (k + 1)) * special.gamma((n + k - 5 / 3) / 2) / below


# ---- one and two points


def test_constants():
    assert pytest.approx(6.883877, rel=1e-6) == von_karman.STRUCTURE_CONSTANT
    assert pytest.approx(0.0228955871, rel=1e-8) == von_karman.PSD_CONSTANT
    zero = torch.zeros((), dtype=torch.float64)
    assert float(von_karman_covariance(zero, 1.0, 1.0)) == pytest.approx(0.0863143, rel=1e-6)
    assert float(von_karman_psd(zero, 2.0, 3.0)) == pytest.approx(0.0228955871 * 2 ** (-5 / 3) * 3 ** (11 / 3))


@pytest.mark.parametrize("distance", [0.0, 0.1, 1.0, 7.0, 30.0])
def test_covariance_is_the_transform_of_the_spectrum(distance):
    """The Hankel transform, by numerical integration between the zeros of the Bessel function."""
    r0, outer_scale = 0.3, 10.0

    def integrand(f):
        psd = float(von_karman_psd(torch.tensor(f, dtype=torch.float64), r0, outer_scale))
        return 2 * math.pi * f * psd * special.j0(2 * math.pi * f * distance)

    ends = special.jn_zeros(0, 400) / (2 * math.pi * distance) if distance > 0 else np.geomspace(1e-3, 1e6, 40)
    parts = [integrate.quad(integrand, a, b, epsrel=1e-10)[0] for a, b in pairwise([0, *ends])]
    # The parts alternate in sign and fall: half of the last closes the sum to better than its size.
    expected = sum(parts) - parts[-1] / 2
    value = float(von_karman_covariance(torch.tensor(distance, dtype=torch.float64), r0, outer_scale))
    variance = float(von_karman_covariance(torch.tensor(0.0, dtype=torch.float64), r0, outer_scale))
    assert value == pytest.approx(expected, abs=1e-7 * variance)


def test_structure_function():
    """Ratio to Kolmogorov's; the difference of covariances where that is safe; the limit of a vast outer scale."""
    ratio = {0.001: 0.8515, 0.01: 0.6805, 0.03: 0.5417, 0.1: 0.3359, 0.3: 0.1385, 1.0: 0.02497}
    for x, expected in ratio.items():
        value = float(von_karman_structure_function(torch.tensor(20 * x, dtype=torch.float64), 0.2, 20.0))
        assert value / (6.883877 * (20 * x / 0.2) ** (5 / 3)) == pytest.approx(expected, rel=4e-4)
    distance = torch.linspace(0.5, 60, 300, dtype=torch.float64)  # the series ends at L0 / (2 pi) = 3.2
    variance = von_karman_covariance(torch.zeros(1, dtype=torch.float64), 0.2, 20.0)
    difference = 2 * (variance - von_karman_covariance(distance, 0.2, 20.0))
    torch.testing.assert_close(von_karman_structure_function(distance, 0.2, 20.0), difference, rtol=1e-11, atol=0)
    # From 1 to the next term of the series, -(1.5 x^2) / (1.864 (x/2)^(5/3) 2) at x = 2 pi / L0.
    vast = von_karman_structure_function(torch.ones(1, dtype=torch.float64), 1.0, 1e12)
    x = 2 * math.pi / 1e12
    odd = special.gamma(1 / 6) / special.gamma(11 / 6) * (x / 2) ** (5 / 3)
    assert float(vast) / 6.88387718 == pytest.approx(1 - 1.5 * x**2 / odd, rel=1e-8)


def test_dtype_and_shape_follow_the_distance():
    distance = torch.tensor([[0.0, 0.5], [1.0, 40.0]])
    for function in (von_karman_covariance, von_karman_structure_function):
        value = function(distance, 0.15, 20.0)
        assert value.dtype == torch.float32
        torch.testing.assert_close(value, function(distance.double(), 0.15, 20.0).float())
        assert function(torch.tensor(1.0), 0.15, 20.0).shape == ()
    assert float(von_karman_structure_function(distance, 0.15, 20.0)[0, 0]) == 0


# ---- modes of one pupil


@pytest.mark.parametrize("ratio", TABLE)
def test_variances_over_a_pupil(ratio):
    total, piston, tilt, second, third = TABLE[ratio]
    variances = modal_covariance(FullAperture(1.0), 10, 1.0, 1 / ratio).diagonal()
    expected = [piston, tilt, tilt, second, second, second] + [third] * 4
    # Half of the last digit printed, and what the integral leaves out (1e-4).
    digits = [0.5e-4 if ratio == 0.01 else 0.5e-5] + [0.5e-5] * 2 + [0.5e-6] * 7
    for value, e, d in zip(variances.tolist(), expected, digits, strict=True):
        assert value == pytest.approx(e, abs=d + 1e-4 * e)
    whole = float(von_karman_covariance(torch.zeros(1, dtype=torch.float64), 1.0, 1 / ratio))
    assert whole == pytest.approx(total, abs=1e-5)


def test_kolmogorov_covariances_of_66_modes():
    """Noll's matrix: variances, covariances and zeros. Piston and tilt still feel an outer scale of 1e8 D."""
    covariance = modal_covariance(FullAperture(1.0), 66, 1.0, KOLMOGOROV)
    exact = torch.tensor([[noll_covariance(i, j) for j in range(4, 67)] for i in range(2, 67)], dtype=torch.float64)
    error = covariance[1:, 3:] - exact
    scale = torch.tensor([noll_covariance(j, j) for j in range(2, 67)], dtype=torch.float64).sqrt()
    relative = (error / scale[:, None] / scale[2:]).abs()
    assert float(relative[:20, :18].max()) < 3e-4  # up to radial order 5
    assert float(relative.max()) < 6e-4
    printed = {(2, 8): -0.014164, (3, 7): -0.014164, (4, 11): -0.003879, (5, 13): -0.003879, (6, 12): -0.003879}
    printed |= {(2, 16): 0.000754, (4, 22): 0.000316, (7, 17): -0.001556, (8, 16): -0.001556, (11, 22): -0.000759}
    for (i, j), value in printed.items():
        assert float(covariance[i - 1, j - 1]) == pytest.approx(value, rel=1e-3, abs=0.5e-6)


def test_noll_residuals():
    """Differences of the exact residuals after J modes are sums of variances."""
    variances = modal_covariance(FullAperture(1.0), 66, 1.0, KOLMOGOROV).diagonal()
    residual = {3: 0.13466, 6: 0.06501, 10: 0.04024, 15: 0.02797, 21: 0.02083, 28: 0.01625, 36: 0.013099, 55: 0.009137}
    for first, last in pairwise(residual):
        assert float(variances[first:last].sum()) == pytest.approx(residual[first] - residual[last], rel=5e-4, abs=1e-5)


def test_strength_is_a_factor():
    weak = modal_covariance(FullAperture(1.0), 6, 1.0, 20.0)
    torch.testing.assert_close(modal_covariance(FullAperture(1.0), 6, 0.2, 20.0), weak * 5 ** (5 / 3))


# ---- modes of several sub-apertures


@pytest.mark.parametrize("ratio", PISTON_DIFFERENCES)
def test_piston_differences(ratio):
    distances = list(PISTON_DIFFERENCES[ratio])
    centers = torch.tensor([[b, 0.0] for b in [0, *distances]], dtype=torch.float64)
    c = modal_covariance(SparseAperture(centers, 1.0, 12.0), 1, 1.0, 1 / ratio)
    for k, b in enumerate(distances, start=1):
        difference = float(c[0, 0] + c[k, k] - 2 * c[0, k])
        assert difference == pytest.approx(PISTON_DIFFERENCES[ratio][b], abs=0.5e-4 + 2e-5 * difference)


def test_tilts_along_and_across_the_baseline():
    """Kolmogorov correlations. A finite outer scale takes away a common gradient, seen in the variance: it is added."""
    table = {1: (0.558, 0.780), 1.5: (0.475, 0.691), 2: (0.428, 0.630), 3: (0.371, 0.552), 4: (0.336, 0.502)}
    table |= {6: (0.293, 0.439), 10: (0.247, 0.371)}
    angle = 0.7
    for b, expected in table.items():
        c = modal_covariance(pair(b, angle=angle), 3, 1.0, 1e6).reshape(2, 3, 2, 3)
        missing = 0.448879 - float(c[0, 1, 0, 1])
        turn = torch.tensor([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]]).double()
        cross = turn @ c[0, 1:, 1, 1:] @ turn.T
        for k in range(2):
            assert (float(cross[k, k]) + missing) / 0.448879 == pytest.approx(expected[k], abs=0.6e-3)
        assert abs(float(cross[0, 1])) < 1e-6


@pytest.mark.parametrize(("shape", "orientation"), [("disc", 0.0), ("hexagon", 0.2)])
def test_cross_covariances_against_the_double_integral(shape, orientation):
    """Two separate holes, all 6 x 6 modes, in the space of positions: there the covariance is smooth."""
    mask = pair(1.6, shape, 0.4, orientation)
    nodes, weights = mask.shape.quadrature(24, mask.subaperture_diameter)
    modes = weights[:, None] * aperture_modes(mask, nodes, 6)
    distance = torch.cdist(nodes, nodes + mask.centers[1])
    expected = modes.T @ von_karman_covariance(distance, 1.0, 8.0) @ modes
    covariance = modal_covariance(mask, 6, 1.0, 8.0)
    scale = covariance[:6, :6].diagonal().sqrt()
    error = (covariance[:6, 6:] - expected) / scale[:, None] / scale
    assert float(error.abs().max()) < 1e-4


@pytest.mark.parametrize(
    "aperture", [FullAperture(1.0, 0.4), SparseAperture([[0.0, 0.0]], 1.0, 1.2, "hexagon", orientation=0.1)]
)
def test_variances_of_other_shapes_against_the_double_integral(aperture):
    """In the space of positions the structure function has a cusp, so two sets of nodes and a tolerance to match."""
    first, w = aperture.shape.quadrature(20, aperture.subaperture_diameter)
    second, v = aperture.shape.quadrature(27, aperture.subaperture_diameter)
    left = w[:, None] * aperture_modes(aperture, first, 6)
    right = v[:, None] * aperture_modes(aperture, second, 6)
    structure = von_karman_structure_function(torch.cdist(first, second), 1.0, 20.0)
    expected = -(left.T @ structure @ right)[1:, 1:] / 2
    covariance = modal_covariance(aperture, 6, 1.0, 20.0)
    torch.testing.assert_close(covariance[1:, 1:].diagonal(), expected.diagonal(), rtol=1e-3, atol=0)
    whole = float(von_karman_covariance(torch.zeros(1, dtype=torch.float64), 1.0, 20.0))
    residual = float(w @ structure @ v) / 2
    assert whole - float(covariance[0, 0]) == pytest.approx(residual, rel=1e-3)


@given(
    seed=st.integers(0, 1000),
    shift=st.tuples(st.floats(-5, 5), st.floats(-5, 5)),
    shape=st.sampled_from(["disc", "hexagon"]),
)
@settings(derandomize=True, deadline=None, max_examples=5)
def test_covariance_is_stationary_and_definite(seed, shift, shape):
    generator = torch.Generator().manual_seed(seed)
    centers = torch.rand(4, 2, generator=generator, dtype=torch.float64)
    order = torch.randperm(4, generator=generator)
    covariance = modal_covariance(SparseAperture(centers, 0.5, 2.0, shape), 3, 0.2, 20.0)
    moved = SparseAperture(centers[order] + torch.tensor(shift, dtype=torch.float64), 0.5, 12.0, shape)
    blocks = covariance.reshape(4, 3, 4, 3)[order][:, :, order].reshape(12, 12)
    largest = float(covariance.diagonal().max())
    torch.testing.assert_close(modal_covariance(moved, 3, 0.2, 20.0), blocks, rtol=0, atol=1e-11 * largest)
    assert bool((covariance == covariance.T).all())
    assert float(torch.linalg.eigvalsh(covariance).min()) > -1e-13 * largest


def test_change_over_a_drift_is_a_difference_of_places():
    """Modes of a hole, and of the same hole a drift away in any of 24 directions."""
    drift, hole = 0.6, modal_covariance(SparseAperture([[0.0, 0.0]], 1.0, 12.0), 6, 1.0, 30.0)
    moved = torch.zeros_like(hole)
    for k in range(24):
        angle = (k + 0.5) * math.pi / 12
        both = modal_covariance(pair(drift, angle=angle), 6, 1.0, 30.0)
        moved += (both[:6, 6:] + both[6:, :6]) / 24
    change = modal_covariance(SparseAperture([[0.0, 0.0]], 1.0, 12.0), 6, 1.0, 30.0, drift)
    scale = change.diagonal().sqrt()
    assert ((change - 2 * hole + moved) / scale / scale[:, None]).abs().max() < 2e-3
    assert torch.equal(modal_covariance(pair(2.0), 3, 1.0, 30.0, 0.0), torch.zeros(6, 6, dtype=torch.float64))


@pytest.mark.parametrize("drift", [-1.0, math.inf, math.nan])
def test_a_drift_is_a_distance(drift):
    with pytest.raises(ValueError, match="drift is"):
        modal_covariance(pair(2.0), 1, 1.0, 30.0, drift)


def test_twenty_sub_apertures_are_quick_and_definite():
    """Six modes each, the fixed area of the reference case; positions as they come, coincidences included."""
    generator = torch.Generator().manual_seed(0)
    centers = 0.8 * torch.rand(20, 2, generator=generator, dtype=torch.float64)
    centers[1] = centers[0]
    start = time.process_time()
    covariance = modal_covariance(SparseAperture(centers, (0.15 / 20) ** 0.5, 2.0), 6, 1 / 7, 20.0)
    assert time.process_time() - start < 10  # 0.2 s alone on one core
    values = torch.linalg.eigvalsh(covariance)
    assert float(values[0]) > -1e-13 * float(values[-1])
    # Two equal holes differ by nothing but what is taken to be each one's own, 1e-4 of the highest modes.
    difference = covariance[:6, :6] - covariance[:6, 6:12]
    assert float((difference.diagonal() / covariance[:6, :6].diagonal()).abs().max()) < 4e-4


def test_float64_whatever_the_centres_and_no_gradient():
    centers = torch.tensor([[0.0, 0.0], [0.3, 0.1]], requires_grad=True)
    covariance = modal_covariance(SparseAperture(centers, 0.2, 1.0), 3, 0.2, 20.0)
    assert covariance.dtype == torch.float64
    assert not covariance.requires_grad
    exact = modal_covariance(SparseAperture(centers.detach().double(), 0.2, 1.0), 3, 0.2, 20.0)
    torch.testing.assert_close(covariance, exact)


def test_what_is_kept_is_of_the_same_holes_and_turbulence_only():
    """A mask that moves, and every other argument, has a covariance of its own; nobody can change what is kept."""
    mask = SparseAperture([[0.0, 0.0], [0.5, 0.1]], 0.2, 2.0)
    first = modal_covariance(mask, 3, 0.2, 20.0)
    kept = first.clone()
    first.zero_()
    assert torch.equal(modal_covariance(mask, 3, 0.2, 20.0), kept)
    smaller = mask.replace(subaperture_diameter=0.1)
    square = mask.replace(shape=Square())
    others = [(smaller, 3, 0.2, 20.0), (square, 3, 0.2, 20.0), (mask, 3, 0.1, 20.0), (mask, 3, 0.2, 10.0)]
    assert not any(torch.allclose(modal_covariance(*other), kept, rtol=1e-2) for other in others)
    assert not torch.allclose(modal_covariance(mask, 3, 0.2, 20.0, 0.3), kept, rtol=1e-2)
    assert modal_covariance(mask, 6, 0.2, 20.0).shape == (12, 12)
    with torch.no_grad():
        mask.centers[1] += 0.2
    assert not torch.allclose(modal_covariance(mask, 3, 0.2, 20.0), kept, rtol=1e-2)


# ---- bad input


@pytest.mark.parametrize("name", ["r0", "outer_scale"])
@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf])
def test_scales_must_be_positive(name, value):
    scales = {"r0": 0.2, "outer_scale": 20.0, name: value}
    for function in (von_karman_psd, von_karman_covariance, von_karman_structure_function):
        with pytest.raises(ValueError, match=f"{name} is .* finite and positive"):
            function(torch.ones(1), **scales)
    with pytest.raises(ValueError, match=f"{name} is .* finite and positive"):
        modal_covariance(FullAperture(1.0), 3, **scales)


def test_one_mask_at_a_time():
    with pytest.raises(ValueError, match="one by one"):
        modal_covariance(SparseAperture(torch.rand(5, 3, 2), 0.1, 1.0), 3, 0.2, 20.0)

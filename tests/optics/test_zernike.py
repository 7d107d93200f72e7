import copy
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn

from torchmask.grid import Grid
from torchmask.optics.aperture import FullAperture, SparseAperture
from torchmask.optics.psf import PSF, psf_from_samples
from torchmask.optics.zernike import ZernikePhase, aperture_modes, noll, zernike, zernike_basis

WAVELENGTH = 550e-9


def points(n=200, radius=1.3, seed=0):
    """Random points, most of them in the disc, some beyond."""
    generator = torch.Generator().manual_seed(seed)
    return radius * (2 * torch.rand(n, 2, generator=generator, dtype=torch.float64) - 1)


def one_hole(shape="disc", obstruction=0.0, diameter=1.0):
    if shape == "hexagon":
        return SparseAperture([[0.0, 0.0]], diameter, 1.2 * diameter, "hexagon", orientation=0.2)
    return FullAperture(diameter, obstruction)


HOLES = pytest.mark.parametrize(
    ("shape", "obstruction"), [("disc", 0.0), ("disc", 0.14), ("disc", 0.6), ("hexagon", 0.0)]
)


# ---- Noll's polynomials


def test_noll_numbers():
    """The first rows of Noll's table: n, m, cosine for even numbers, sine for odd ones."""
    table = {
        0: [(0, 0)],
        1: [(1, 1), (1, -1)],
        2: [(2, 0), (2, -2), (2, 2)],
        3: [(3, -1), (3, 1), (3, -3), (3, 3)],
        4: [(4, 0), (4, 2), (4, -2), (4, 4), (4, -4)],
    }
    assert [noll(j) for j in range(1, 16)] == [entry for row in table.values() for entry in row]
    assert [noll(66), noll(56)] == [(10, 10), (10, 0)]


def test_polynomials_of_the_textbook():
    """Cartesian forms of Noll's first modes, signs included."""
    p = points()
    x, y = p.unbind(-1)
    r2 = x**2 + y**2
    expected = [
        torch.ones_like(x),
        2 * x,
        2 * y,
        math.sqrt(3) * (2 * r2 - 1),
        2 * math.sqrt(6) * x * y,
        math.sqrt(6) * (x**2 - y**2),
        math.sqrt(8) * (3 * r2 - 2) * y,
        math.sqrt(8) * (3 * r2 - 2) * x,
        math.sqrt(8) * (3 * x**2 * y - y**3),
        math.sqrt(8) * (x**3 - 3 * x * y**2),
        math.sqrt(5) * (6 * r2**2 - 6 * r2 + 1),
    ]
    torch.testing.assert_close(zernike(p, 11), torch.stack(expected, -1), rtol=1e-13, atol=1e-13)


def test_high_orders_against_the_factorial_sum():
    p = points(radius=1.0)
    x, y = p.unbind(-1)
    r, theta = torch.hypot(x, y), torch.atan2(y, x)
    modes = zernike(p, 66)
    for j in range(1, 67):
        n, m = noll(j)
        radial = torch.zeros_like(r)
        for k in range((n - abs(m)) // 2 + 1):
            numerator = (-1) ** k * math.factorial(n - k)
            denominator = (
                math.factorial(k) * math.factorial((n + abs(m)) // 2 - k) * math.factorial((n - abs(m)) // 2 - k)
            )
            radial += numerator / denominator * r ** (n - 2 * k)
        angular = torch.cos(m * theta) if m >= 0 else torch.sin(-m * theta)
        expected = math.sqrt((n + 1) * (1 if m == 0 else 2)) * radial * angular
        # The sum cancels: its terms reach 5000 at n = 10 and r up to 1.4.
        scale = float(expected.abs().max())
        assert float((modes[:, j - 1] - expected).abs().max()) < 1e-12 * max(scale, 1), j


def test_float32_is_accurate_at_high_orders():
    """Rounding grows no faster than the recurrence is long (5 steps, 10 products) on modes that reach sqrt(22)."""
    p = points(radius=0.7)  # inside the disc
    error = (zernike(p.float(), 66).double() - zernike(p.float().double(), 66)).abs().max()
    assert zernike(p.float(), 66).dtype == torch.float32
    assert float(error) < 30 * math.sqrt(22) * torch.finfo(torch.float32).eps


@given(
    coefficients=st.lists(st.floats(-3, 3), min_size=1, max_size=28),
    obstruction=st.sampled_from([0.0, 0.25]),
    shape=st.sampled_from(["disc", "hexagon"]),
)
@settings(derandomize=True, deadline=None, max_examples=40)
def test_mean_square_of_the_phase_is_the_sum_of_squares(coefficients, obstruction, shape):
    """Parseval, by a quadrature finer than the one the modes were made with."""
    aperture = one_hole(shape, obstruction if shape == "disc" else 0.0, 0.3)
    a = torch.tensor(coefficients, dtype=torch.float64)
    nodes, weights = aperture.shape.quadrature(40, aperture.subaperture_diameter)
    phase = aperture_modes(aperture, nodes, len(a)) @ a
    assert float((weights * phase**2).sum()) == pytest.approx(float((a**2).sum()), rel=1e-10, abs=1e-12)


# ---- other shapes


def test_quadrature_knows_the_moments():
    """Means of x^2 and of r^4: (1 + e^2) R^2 / 4 and (1 + e^2 + e^4) R^4 / 3 on a ring, (5/24) R^2 on a hexagon."""
    for obstruction in (0.0, 0.3):
        nodes, weights = FullAperture(2.0, obstruction).shape.quadrature(4, 2.0)
        e2 = obstruction**2
        assert float(weights.sum()) == pytest.approx(1)
        assert float((weights * nodes[:, 0] ** 2).sum()) == pytest.approx((1 + e2) / 4)
        assert float((weights * (nodes**2).sum(-1) ** 2).sum()) == pytest.approx((1 + e2 + e2**2) / 3)
    hexagon = one_hole("hexagon", diameter=math.sqrt(3))  # circumradius 1
    nodes, weights = hexagon.shape.quadrature(4, hexagon.subaperture_diameter)
    assert float((weights * nodes[:, 0] ** 2).sum()) == pytest.approx(5 / 24)
    # All nodes lie within the six sides, whose normals point along the orientation.
    angle = hexagon.shape.orientation + torch.arange(6, dtype=torch.float64) * math.pi / 3
    assert float((nodes @ torch.stack([angle.cos(), angle.sin()])).max()) < math.sqrt(3) / 2


def test_modes_of_a_ring():
    """Tilt and focus of an obstructed pupil in closed form (Mahajan, J. Opt. Soc. Am. 71, 75, 1981)."""
    p, e2 = points(), 0.3**2
    modes = aperture_modes(FullAperture(2.0, 0.3), p, 4)
    r2 = (p**2).sum(-1)
    torch.testing.assert_close(modes[:, 1], 2 * p[:, 0] / math.sqrt(1 + e2))
    torch.testing.assert_close(modes[:, 3], math.sqrt(3) * (2 * r2 - 1 - e2) / (1 - e2))


def test_modes_of_a_hexagon():
    """Tilt and focus of a hexagon of circumradius 1 in closed form (Mahajan & Dai 2007): any orientation."""
    p = points()
    modes = aperture_modes(one_hole("hexagon", diameter=math.sqrt(3)), p, 4)
    torch.testing.assert_close(modes[:, 2], 2 * math.sqrt(6 / 5) * p[:, 1])
    torch.testing.assert_close(modes[:, 3], math.sqrt(5 / 43) * (12 * (p**2).sum(-1) - 5))


@HOLES
def test_basis_is_orthonormal_on_the_raster(shape, obstruction):
    """The pupil samples, which know nothing of the quadrature, agree better the finer they are.

    A rim cell is as a whole off by half a cell, inwards as often as outwards but for the curvature: second order.
    """
    aperture = one_hole(shape, obstruction)
    errors = []
    for n in (64, 128, 256):
        samples = aperture.samples(Grid.nyquist(aperture.extent, WAVELENGTH, n))
        basis = zernike_basis(samples, aperture, 15)[0]
        weights = samples.weights[0] / samples.weights.sum()
        gram = basis.T @ (weights[:, None] * basis)
        errors.append(float((gram - torch.eye(15, dtype=torch.float64)).abs().max()))
    assert errors[2] < 0.01
    assert errors[2] < errors[1] / 2.5 < errors[0] / 6


# ---- derivatives


def test_gradient_at_the_centre_and_beyond_the_rim():
    p = torch.cat([torch.zeros(1, 2, dtype=torch.float64), points(5)]).requires_grad_()
    assert torch.autograd.gradcheck(lambda q: zernike(q, 28), p)


@pytest.mark.parametrize("shape", ["disc", "hexagon"])
def test_basis_follows_the_centres(shape):
    """Moving a hole moves its modes against fixed samples: gradcheck with one centre exactly on a sample."""
    grid = Grid.nyquist(1.2, WAVELENGTH, 16)
    step = grid.period / 16
    centers = torch.tensor([[0.0, 0.0], [2 * step, 0.3 * step]], dtype=torch.float64, requires_grad=True)

    def basis(c):
        mask = SparseAperture(c, 0.4, 1.2, shape)
        samples = mask.samples(grid)
        return zernike_basis(samples, mask, 10) * samples.weights[..., None]

    assert torch.autograd.gradcheck(basis, centers)


# ---- the module


def mask_of_three(dtype=torch.float64, train=False):
    centers = torch.tensor([[0.0, 0.3], [0.25, -0.2], [-0.3, -0.1]], dtype=dtype)
    return SparseAperture(nn.Parameter(centers) if train else centers, 0.3, 1.0)


@pytest.mark.parametrize(("axis", "mode"), [(1, 1), (0, 2)])
def test_tilt_moves_the_image(axis, mode):
    """Phase 2 pi s x pixel_scale / wavelength: s pixels towards +x. The piston carries what a hole's tilt leaves."""
    mask = mask_of_three()
    grid = Grid.nyquist(1.0, WAVELENGTH, 64)
    shift = 3
    per_metre = 2 * math.pi * shift / grid.period
    coefficients = torch.zeros(3, 3, dtype=torch.float64)
    coefficients[:, 0] = per_metre * mask.centers[:, mode - 1]
    coefficients[:, mode] = per_metre * mask.subaperture_diameter / 4
    phase = ZernikePhase(mask, grid, 3)(coefficients)
    samples = mask.samples(grid)
    position = mask.centers[:, None] + samples.offsets
    torch.testing.assert_close(phase, per_metre * position[..., mode - 1])
    peak = divmod(int(psf_from_samples(samples, phase).argmax()), 64)
    assert peak == ((0, shift) if axis == 1 else (shift, 0))


def test_frames_broadcast_and_follow_the_dtype():
    for dtype in (torch.float32, torch.float64):
        mask = mask_of_three(dtype)
        module = ZernikePhase(mask, Grid.nyquist(1.0, WAVELENGTH, 64), 6)
        coefficients = torch.randn(2, 5, 3, 6, dtype=dtype, generator=torch.Generator().manual_seed(0))
        phase = module(coefficients)
        assert phase.dtype == dtype
        assert phase.shape == (2, 5, *module.basis.shape[:2])
        torch.testing.assert_close(phase[1, 3], (module.basis * coefficients[1, 3][:, None]).sum(-1))
    assert ZernikePhase(mask_of_three(), Grid.nyquist(1.0, WAVELENGTH, 64), 6).float()(coefficients.float()).dtype == (
        torch.float32
    )


def test_population_has_a_basis_for_every_mask():
    grid = Grid.nyquist(1.2, WAVELENGTH, 64)
    centers = torch.stack([mask_of_three().centers, 0.9 * mask_of_three().centers])
    phase = ZernikePhase(SparseAperture(centers, 0.3, 1.2), grid, 4)
    coefficients = torch.randn(2, 3, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    for k in range(2):
        alone = ZernikePhase(SparseAperture(centers[k], 0.3, 1.2), grid, 4)
        torch.testing.assert_close(phase(coefficients)[k], alone(coefficients[k]))


def test_basis_is_kept_only_while_the_centres_rest():
    grid = Grid.nyquist(1.0, WAVELENGTH, 64)
    module = ZernikePhase(mask_of_three(), grid, 4)
    assert list(module.state_dict()) == ["aperture.centers"]
    coefficients = torch.ones(3, 4, dtype=torch.float64)
    before = module(coefficients)
    twin = copy.deepcopy(module)
    moved = {"aperture.centers": module.aperture.centers + torch.tensor([0.004, -0.003])}
    module.load_state_dict(moved)
    fresh = ZernikePhase(SparseAperture(moved["aperture.centers"], 0.3, 1.0), grid, 4)
    torch.testing.assert_close(module(coefficients), fresh(coefficients))
    assert not torch.allclose(module(coefficients), before)
    torch.testing.assert_close(twin(coefficients), before)


def test_coefficients_and_centres_train_through_the_psf():
    grid = Grid.nyquist(1.0, WAVELENGTH, 32)
    mask = mask_of_three(train=True)
    coefficients = 0.3 * torch.randn(3, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    coefficients = nn.Parameter(coefficients)
    psf, phase = PSF(mask, grid), ZernikePhase(mask, grid, 6)
    sharpness = (psf(phase(coefficients)) ** 2).sum()
    sharpness.backward()
    for parameter in (coefficients, mask.centers):
        gradient = parameter.grad
        assert gradient is not None
        direction = gradient / gradient.norm()
        with torch.no_grad():
            values = []
            for h in (-1e-5, 1e-5):
                parameter += h * direction
                values.append(float((psf(phase(coefficients)) ** 2).sum()))
                parameter -= h * direction
        assert (values[1] - values[0]) / 2e-5 == pytest.approx(float(gradient.norm()), rel=1e-6)


# ---- bad input


@pytest.mark.parametrize("n_modes", [0, -1, 2.5, math.nan])
def test_number_of_modes_is_a_whole_number(n_modes):
    with pytest.raises(ValueError, match="whole number of at least 1"):
        ZernikePhase(mask_of_three(), Grid.nyquist(1.0, WAVELENGTH, 64), n_modes)


def test_a_whole_number_of_modes_may_be_a_float():
    one, other = (ZernikePhase(mask_of_three(), Grid.nyquist(1.0, WAVELENGTH, 64), n) for n in (3, 3.0))
    assert torch.equal(one.basis, other.basis)
    assert (noll(11.0), type(other.n_modes)) == ((4, 0), int)


def test_coefficients_must_fit_the_mask():
    module = ZernikePhase(mask_of_three(), Grid.nyquist(1.0, WAVELENGTH, 64), 6)
    with pytest.raises(ValueError, match=r"\(sub-apertures, modes\) = \(3, 6\)"):
        module(torch.zeros(6, 3, dtype=torch.float64))
    with pytest.raises(TypeError, match=r"coefficients are torch\.float32 and the aperture is torch\.float64"):
        module(torch.zeros(3, 6))
    with pytest.raises(TypeError, match=r"coefficients is of type ndarray: a tensor is needed, give torch\.as_tensor"):
        module(np.zeros((3, 6)))


@pytest.mark.parametrize("shape", ["disc", "hexagon"])
def test_autocast_rounds_no_phase(shape):
    mask = SparseAperture(torch.tensor([[0.0, 0.3], [0.3, -0.2], [-0.3, -0.2]]), 0.2, 1.0, shape)
    grid = Grid.nyquist(1.0, WAVELENGTH, 32)
    layer = ZernikePhase(mask, grid, 6)
    coefficients = torch.randn(4, 3, 6, generator=torch.Generator().manual_seed(0)).requires_grad_()
    expected = layer(coefficients)
    (slope,) = torch.autograd.grad((expected**2).sum(), coefficients)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        for one in (layer, ZernikePhase(mask, grid, 6)):
            found = one(coefficients)
            (again,) = torch.autograd.grad((found**2).sum(), coefficients)
            assert found.dtype == one.basis.dtype == torch.float32
            torch.testing.assert_close(found, expected, rtol=0, atol=1e-5)
            torch.testing.assert_close(again, slope, rtol=0, atol=1e-6 * float(slope.norm()))
    torch.testing.assert_close(one(coefficients), expected, rtol=0, atol=1e-5)  # also out of it


def test_one_made_in_inference_mode_trains_later():
    mask, grid = SparseAperture([[0.0, 0.3], [0.2, -0.2]], 0.3, 1.0), Grid.nyquist(1.0, WAVELENGTH, 32)
    with torch.inference_mode():
        layers = [
            ZernikePhase(aperture, grid, 3) for aperture in (mask, SparseAperture(mask.centers.tolist(), 0.3, 1.0))
        ]
    for layer in layers:
        coefficients = torch.ones(2, 3, dtype=torch.float64, requires_grad=True)
        layer(coefficients).sum().backward()
        assert float(coefficients.grad[:, 0].min()) > 1


def test_a_thin_ring_has_few_modes():
    with pytest.raises(ValueError, match=r"66 modes are not independent .*0\.999"):
        aperture_modes(FullAperture(1.0, 0.999), torch.zeros(1, 2, dtype=torch.float64), 66)
    assert aperture_modes(FullAperture(1.0, 0.999), torch.zeros(1, 2, dtype=torch.float64), 6).shape == (1, 6)

"""E|OTF|^2 of any pupil against closed forms and against draws from the exact covariance."""

import math

import pytest
import torch
from exact_turbulence import drawn_mean_square, sampled_mean_square
from hypothesis import given
from hypothesis import strategies as st

from torchmask.atmosphere import transfer
from torchmask.atmosphere.seeing import Seeing
from torchmask.atmosphere.transfer import difference_variance, mean_square_otf, steady_square_otf
from torchmask.grid import Grid
from torchmask.optics.aperture import FullAperture, SparseAperture
from torchmask.optics.band import Band
from torchmask.optics.otf import analytic_otf
from torchmask.optics.round import disc_otf

NYQUIST = Grid.nyquist(1.0, 550e-9, 32)


# What Korff's integral gives over its limit, 0.435 (r0 / D)^2 T(b), at b = D / 2
@pytest.mark.parametrize(("strength", "ratio"), [(7, 1.61), (10, 1.53), (20, 1.39), (40, 1.30)])
def test_full_pupil_above_its_limit(strength, ratio):
    limit = 0.341864 * 4 / math.pi / strength**2 * float(disc_otf(torch.tensor(0.5, dtype=torch.float64)))
    found = float(mean_square_otf(FullAperture(1.0), NYQUIST, torch.tensor([[0.25, 0.0]]), Seeing(1 / strength)))
    assert found / limit == pytest.approx(ratio, rel=0.02)


# Mean over both wavelengths of a top hat of exp(-(k - k')^2 D / 2), D/r0 = 7, fixed points D apart
@pytest.mark.parametrize(
    ("even_in", "width", "kept"),
    [
        *(("wavelength", *values) for values in [(0.05, 0.965), (0.1, 0.875), (0.2, 0.659), (0.4, 0.397)]),
        *(("wavenumber", *values) for values in [(0.05, 0.965), (0.1, 0.875), (0.2, 0.661), (0.4, 0.401)]),
    ],
)
def test_a_band_blurs_the_phase_between_two_points(even_in, width, kept):
    band = Band.top_hat(1.0, width, 12)
    if even_in == "wavenumber":
        band = Band.of([1 / number for number in band.wavelengths], band.shares)
    scale = 1 / torch.tensor(band.wavelengths, dtype=torch.float64)
    shares = torch.tensor(band.shares, dtype=torch.float64)
    baseline = torch.tensor([1.0, 0.0], dtype=torch.float64)
    variance = difference_variance(
        Seeing(1 / 7).structure(), torch.zeros(2), baseline, baseline, scale[:, None], scale[None, :]
    )
    assert float(shares @ torch.exp(-variance / 2) @ shares) == pytest.approx(kept, abs=1e-3)


PLACE = st.tuples(*[st.floats(-3, 3)] * 2)
SCALE = st.floats(0.3, 3)


@given(points=st.tuples(*[PLACE] * 4), scale=SCALE, other_scale=SCALE)
def test_a_difference_is_made_of_the_distances_of_its_four_points(points, scale, other_scale):
    """E[(a (phi_1 - phi_2) - a' (phi_3 - phi_4))^2] = a^2 D12 + a'^2 D34 - a a' (D14 + D23 - D13 - D24)."""
    first, second, third, fourth = torch.tensor(points, dtype=torch.float64)
    structure = Seeing(0.2, 5.0).structure()

    def between(one, other):
        return float(structure(one - other))

    crossed = between(first, fourth) + between(second, third) - between(first, third) - between(second, fourth)
    own = scale**2 * between(first, second) + other_scale**2 * between(third, fourth)
    expected = own - scale * other_scale * crossed
    separation, pairs = (third + fourth - first - second) / 2, (second - first, fourth - third)
    found = float(difference_variance(structure, separation, *pairs, scale, other_scale))
    # rounding of a displacement, 1e-15 m, and of D, which is at most 2e3 rad^2 and is steepest where it is small
    assert found == pytest.approx(expected, rel=1e-9, abs=1e-7)


@pytest.mark.parametrize("stretch", [0.8, 1.3])
def test_light_of_one_other_wavelength_is_a_grid_of_that_wavelength(stretch):
    """r0 goes with the wavelength to the 6/5. Holes of less than r0 / 4 are sampled by their size, whatever r0 is."""
    mask = SparseAperture([[0.0, 0.3], [0.02, -0.1], [-0.3, -0.1]], 0.2, 1.0)
    elsewhere = Grid(NYQUIST.n_pixels, NYQUIST.pixel_scale, stretch * NYQUIST.wavelength)
    nu = torch.tensor([[0.0, 0.05], [0.01, 0.21], [0.16, 0.0]], dtype=torch.float64) / stretch
    found = mean_square_otf(mask, NYQUIST, nu, Seeing(1.0), Band.of([elsewhere.wavelength]))
    expected = mean_square_otf(mask, elsewhere, nu, Seeing(stretch**1.2))
    assert (expected > 1e-3).all()
    torch.testing.assert_close(found, expected, rtol=1e-9, atol=0)


def test_pistons_alone_are_the_denominator_of_mse_a():
    """Holes of r0 / 5, 3.6 r0 apart or more: the squares of the pairs, each less what turbulence takes in a hole."""
    mask = SparseAperture([[0.0, 0.4], [0.35, -0.2], [-0.4, -0.25]], 0.04, 1.0)
    centers = mask.centers / NYQUIST.period
    at = torch.tensor([0.002, 0.004], dtype=torch.float64)
    found = mean_square_otf(
        mask, NYQUIST, torch.stack([centers[0] - centers[1], centers[2] - centers[0]]) + at, Seeing(0.2)
    )
    square = float(disc_otf(torch.linalg.vector_norm(NYQUIST.period * at) / 0.04)) ** 2
    # each of two independent holes loses the variance of its piston-removed phase at most, 1.03 (d / r0)^(5/3)
    lost = 2 * 1.0324 * 0.2 ** (5 / 3)
    assert (found * 9 < square).all()
    assert (found * 9 > square * (1 - lost)).all()


@pytest.mark.parametrize(("width", "n_instants"), [(0.2, 1), (0.0, 4), (0.2, 2)])
def test_the_sum_over_samples_tends_to_the_integral(width, n_instants):
    """No border of a hole is known better than to a sample of it; the integral's own samples add half a per cent.

    Few instants keep more of a fringe than all of them: by what two independent points would, 2 (1 - x) exp(-x^(5/3)).
    """
    grid = Grid.nyquist(1.0, 550e-9, 24, 1 / 0.9)
    mask = SparseAperture([[0.0, 0.3], [0.25, -0.1], [-0.3, -0.1]], 0.25, 1.0)
    band = Band.top_hat(550e-9, width * 550e-9, 3) if width else None
    exposed = n_instants > 1
    seeing = Seeing(0.2, 5.0, Seeing(0.2, wind=10.0).tau0 if exposed else 0.0, (8.0, 6.0) if exposed else 0.0)
    pixels = torch.tensor([[0, 2], [4, 2], [1, 22]])
    nu = torch.fft.fftfreq(24, dtype=torch.float64)[pixels.flip(1)]
    exact = mean_square_otf(mask, grid, nu, seeing, band)
    lag = torch.arange(n_instants) / n_instants
    kept = float((2 * (1 - lag) * torch.exp(-(lag ** (5 / 3)))).sum() - 1) / n_instants
    excess = kept / 0.832 - 1 if exposed else 0.0  # 0.832 at T = tau0
    for oversampling in (2, 4):
        found = sampled_mean_square(mask, grid, pixels, seeing, band, n_instants=n_instants, oversampling=oversampling)
        sample = grid.period / (24 * oversampling) / 0.25
        assert ((found / exact - 1).abs() < sample + 0.005 + excess).all()


def test_a_mask_turned_by_half_a_turn_is_the_same_to_any_wind():
    """Of two instants either may be the later one, for the light of two wavelengths from different holes as well."""
    centers = torch.tensor([[0.0, 0.3], [0.25, -0.1], [-0.3, -0.1], [-0.1, 0.05]], dtype=torch.float64)
    masks = [SparseAperture(sign * centers, 0.2, 1.0) for sign in (1, -1)]
    band, seeing = Band.top_hat(550e-9, 110e-9, 3), Seeing(0.4, 5.0, exposure=0.02, wind=(8.0, 6.0))
    nu = torch.tensor([[0.12, 0.22], [0.13, 0.2], [-0.15, 0.19]], dtype=torch.float64)
    one, other = (mean_square_otf(mask, NYQUIST, nu, seeing, band) for mask in masks)
    assert (one > 0.01).all()
    torch.testing.assert_close(one, other, rtol=1e-9, atol=0)


def test_a_point_far_from_all_baselines_carries_nothing():
    mask = SparseAperture([[0.4, 0.0], [-0.4, 0.0]], 0.1, 1.0)
    assert float(mean_square_otf(mask, NYQUIST, torch.tensor([[0.0, 0.2]]), Seeing(0.1))) == 0


@pytest.mark.parametrize("ratio", [0.4, 1.5])
def test_a_mask_agrees_with_draws(ratio):
    mask = SparseAperture([[0.0, 0.3], [0.25, -0.1], [-0.3, -0.1]], 0.25, 1.0)
    assert_agrees(mask, NYQUIST, Seeing(0.25 / ratio, 5.0), oversampling=4)


def test_a_full_pupil_agrees_with_draws_through_a_band():
    band = Band.top_hat(550e-9, 110e-9, 3)
    assert_agrees(FullAperture(0.5, 0.3), Grid.nyquist(0.6, 550e-9, 32), Seeing(0.25, 5.0), band, oversampling=2)


def test_a_pupil_with_vanes_agrees_with_draws():
    vanes = FullAperture(1.0, 0.2, 0.08, [0.0, math.pi / 2, math.pi, 3 * math.pi / 2])
    assert_agrees(vanes, NYQUIST, Seeing(0.3, 5.0), oversampling=2)


def test_an_exposure_agrees_with_draws():
    seeing = Seeing(0.25, 5.0, exposure=2 * Seeing(0.25, wind=10.0).tau0, wind=(8.0, 6.0))
    # eight instants stand for the exposure: by the midpoint rule that is half a per cent of contrast too much
    assert_agrees(FullAperture(0.5), Grid.nyquist(0.5, 550e-9, 32), seeing, n_instants=8, oversampling=1)


def assert_agrees(aperture, grid, seeing, band=None, **sampling):
    """Within 3 % beyond four standard errors, at 12 frequencies that carry something."""
    generator = torch.Generator().manual_seed(3)
    drawn = drawn_mean_square(aperture, grid, seeing, band, n_draws=500, generator=generator, **sampling)
    nu_y, nu_x = grid.frequencies(torch.float64)
    carried = (drawn.mean > 3e-3) & (torch.hypot(nu_y, nu_x) > 0.04) & (nu_y >= 0)
    row, column = carried.nonzero()[torch.randperm(int(carried.sum()), generator=generator)[:12]].T
    nu = torch.stack([nu_x[0, column], nu_y[row, 0]], -1)
    still = mean_square_otf(aperture, grid, nu, Seeing(1e9), band)
    found = mean_square_otf(aperture, grid, nu, seeing, band) / still * drawn.perfect[row, column]
    excess = (found - drawn.mean[row, column]).abs() - 4 * drawn.error[row, column]
    assert (excess < 0.03 * found).all()
    # on average over the frequencies the draws' errors are smaller
    assert float((found / drawn.mean[row, column]).mean()) == pytest.approx(1, abs=0.02)


def test_hexagons_annuli_and_zero_frequency():
    nu = torch.tensor([[0.0, 0.0], [0.1, 0.2]], dtype=torch.float64)
    for aperture in (FullAperture(1.0, 0.3), SparseAperture([[0.3, 0.0], [-0.3, 0.1]], 0.2, 1.0, "hexagon")):
        still = mean_square_otf(aperture, NYQUIST, nu, Seeing(1e6))
        assert float(still[0]) == pytest.approx(1, rel=1e-9)
        row, column = int(nu[1, 1] * 32), int(nu[1, 0] * 32)
        grid_nu = torch.tensor([[column / 32, row / 32]], dtype=torch.float64)
        exact = float(analytic_otf(aperture, NYQUIST).real[row, column]) ** 2
        assert float(mean_square_otf(aperture, NYQUIST, grid_nu, Seeing(1e6))[0]) == pytest.approx(exact, rel=1e-6)


def test_separations_that_turbulence_silences_cost_one_evaluation_and_change_nothing(monkeypatch):
    """A full pupil of 25 r0 in an exposure, where nearly all pairs of points are far apart."""
    pupil, grid, seeing = FullAperture(1.0), Grid.nyquist(1.0, 550e-9, 64), Seeing(0.04, 20.0, 5e-4, 10.0)
    frequencies, evaluated = torch.tensor([[0.25, 0.1]]), [0]

    def count(structure, separation, *rest):
        evaluated[0] += separation[..., 0].numel()
        return original(structure, separation, *rest)

    original = transfer.difference_variance
    monkeypatch.setattr(transfer, "difference_variance", count)
    few = mean_square_otf(pupil, grid, frequencies, seeing)
    least, evaluated[0] = evaluated[0], 0
    monkeypatch.setattr(transfer, "_LOST", math.inf)
    torch.testing.assert_close(few, mean_square_otf(pupil, grid, frequencies, seeing), rtol=1e-9, atol=0)
    assert least < evaluated[0] / 8
    steady = steady_square_otf(pupil, grid, frequencies, seeing)
    monkeypatch.setattr(transfer, "_LOST", 60.0)
    torch.testing.assert_close(steady_square_otf(pupil, grid, frequencies, seeing), steady, rtol=1e-9, atol=1e-14)


def test_separations_far_away_are_taken_together_and_change_little(monkeypatch):
    """A full pupil of 25 r0 at baselines of 0.25 and 1.25 r0: 0.5 % is what sampling leaves uncertain."""
    pupil, grid, seeing = FullAperture(1.0, 0.14), Grid.nyquist(1.0, 550e-9, 64), Seeing(0.04, 20.0, 1e-3, 10.0)
    frequencies = torch.tensor([[0.005, 0.0], [0.02, 0.015]])
    few = mean_square_otf(pupil, grid, frequencies, seeing)
    monkeypatch.setattr(transfer, "_FAR", math.inf)
    torch.testing.assert_close(few, mean_square_otf(pupil, grid, frequencies, seeing), rtol=5e-4, atol=0)


def test_a_population_is_refused():
    with pytest.raises(ValueError, match="one mask is needed"):
        mean_square_otf(SparseAperture(torch.zeros(2, 1, 2), 0.2, 1.0), NYQUIST, torch.zeros(1, 2), Seeing(0.1))


@pytest.mark.parametrize("shape", ["disc", "square"])
@pytest.mark.parametrize("motion", [{}, {"exposure": 5e-3, "wind": 10.0}, {"exposure": 5e-3, "wind": (6.0, 8.0)}])
def test_it_is_made_where_the_frequencies_are_whatever_the_default_device(shape, motion):
    """In a wide band too: every array on the way is made on the processor."""
    mask = SparseAperture([[-0.2, 0.0], [0.2, 0.1]], 0.3, 1.0, shape)
    nu = torch.tensor([[0.02, 0.01], [0.2, 0.05]], dtype=torch.float64)
    known = mask, NYQUIST, nu, Seeing(0.3, 10.0, **motion), Band.top_hat(550e-9, 55e-9, 2)
    expected = mean_square_otf(*known)
    assert bool((expected > 0).all())
    with torch.device("meta"):
        assert torch.equal(mean_square_otf(*known), expected)

"""How |OTF|^2 fluctuates between exposures, and what a finite number of them costs."""

import itertools
import math
from types import SimpleNamespace

import pytest
import torch
from exact_turbulence import drawn_powers, perfect_power
from scipy.integrate import quad
from scipy.special import expn
from scipy.stats import gamma

from torchmask.atmosphere.seeing import Seeing
from torchmask.atmosphere.transfer import steady_square_otf
from torchmask.design.criterion import AsymptoticMSE, wiener_mse
from torchmask.design.fluctuation import mean_inverse, piston_powers, steady_lenses
from torchmask.design.turbulent import TurbulentMSE
from torchmask.grid import Grid
from torchmask.optics.aperture import FullAperture, SparseAperture
from torchmask.optics.otf import analytic_otf
from torchmask.spectra import NoisePSD, PowerLawPSD

GRID = Grid.nyquist(1.0, 550e-9, 32)
PSDS = PowerLawPSD(1.5, 1e5), NoisePSD(1e5)
REDUNDANT = SparseAperture([[0.28, 0.28], [-0.28, 0.28], [0.28, -0.28], [-0.28, -0.28], [0.0, 0.0]], 0.2, 1.0)


@pytest.mark.parametrize("n", [5, 10, 20])
@pytest.mark.parametrize("ratio", [1e-6, 0.03, 1.0, 5.0])
def test_the_mean_of_speckles_has_the_exponential_integral(n, ratio):
    z = ratio * n
    exact = n * math.exp(z) * expn(n, z)
    found = mean_inverse(*torch.tensor([2.0, 4.0 / n, 2.0 * ratio], dtype=torch.float64))  # of mean 2, twice the ratio
    assert float(found) == pytest.approx(exact / 2, rel=2e-5)


def test_any_variance_has_the_integral_of_its_gamma_distribution():
    mean, variance, ratio = 0.7, 0.05, 0.2
    shape = gamma(mean**2 / variance, scale=variance / mean)
    exact = quad(lambda x: shape.pdf(x) / (x + ratio), 0, shape.ppf(1 - 1e-13))[0]
    for dtype, accuracy in ((torch.float64, 1e-8), (torch.float32, 1e-5)):
        assert float(mean_inverse(*torch.tensor([mean, variance, ratio], dtype=dtype))) == pytest.approx(
            exact, rel=accuracy
        )


def test_small_fluctuations_cost_jensens_second_order():
    mean, variance, ratio = torch.tensor([1.0, 1e-6, 0.5], dtype=torch.float64)
    excess = mean_inverse(mean, variance, ratio) - 1 / (mean + ratio)
    assert float(excess) == pytest.approx(float(variance / (mean + ratio) ** 3), rel=1e-5)  # of the next order


def test_what_does_not_fluctuate_costs_nothing():
    nothing = torch.zeros(2, dtype=torch.float64)
    found = mean_inverse(torch.tensor([0.0, 1.0]), nothing, torch.tensor([0.5, math.inf]))
    assert found.tolist() == [2.0, 0.0]


def summed_powers(mask, grid):
    """E|OTF|^2 and the sum of A^4 (H, W) of pistons alone, baseline by baseline."""
    nu_y, nu_x = grid.frequencies(torch.float64)
    frequencies = torch.stack(torch.broadcast_tensors(nu_x, nu_y), -1) * grid.period
    first = mask.shape.otf(frequencies, mask.subaperture_diameter)
    mean, steady = first**2, first**4  # of all holes with themselves, whose phases agree
    for i, j in itertools.permutations(range(mask.n_subapertures), 2):
        offset = frequencies - (mask.centers[i] - mask.centers[j])
        offset -= (offset / grid.period).round() * grid.period  # the nearest image on the torus
        part = mask.shape.otf(offset, mask.subaperture_diameter) / mask.n_subapertures
        mean, steady = mean + part**2, steady + part**4
    return mean, steady


def test_powers_of_pistons_are_sums_over_baselines():
    geometry = AsymptoticMSE(GRID, *PSDS, 10)._geometry(REDUNDANT)
    found = piston_powers(REDUNDANT.centers[None], geometry, GRID.wavelength)
    for one, exact, power in zip(found, summed_powers(REDUNDANT, GRID), (2, 4), strict=True):
        # splines round the tip of T off, by up to 0.4 % where a hole is 3 pixels wide; two pairs are there
        torch.testing.assert_close(one[0], exact[: one.shape[-2]], rtol=0, atol=2 * power * 4e-3 / 5**power)


@pytest.mark.parametrize("n_photons", [1e4, 1e6])
def test_the_mean_error_of_random_pistons_is_predicted(n_photons):
    """The errors less their first order in |OTF|^2, which is 0 on average."""
    n_frames, n_draws = 10, 300
    psds = PowerLawPSD(1.5, n_photons), NoisePSD(n_photons)
    generator = torch.Generator().manual_seed(0)
    pistons = 2 * math.pi * torch.rand(n_draws * n_frames, 5, dtype=torch.float64, generator=generator)
    otfs = analytic_otf(REDUNDANT, GRID, pistons).unflatten(0, (n_draws, n_frames))
    criterion = AsymptoticMSE(GRID, *psds, n_frames)
    mean, _ = summed_powers(REDUNDANT, GRID)
    noise = criterion.noise_psd / n_frames
    slope = noise / (mean + noise / criterion.object_psd) ** 2
    first_order = (slope * ((otfs.abs() ** 2).mean(1) - mean)).mean((-2, -1))
    drawn = wiener_mse(otfs, *psds) + first_order - criterion(REDUNDANT)
    term = float(criterion.jensen_term(REDUNDANT))
    error = float(drawn.std()) / math.sqrt(n_draws)
    # the skewness of a Gamma distribution, which two equal pairs lack, is of the relative order 2 V / (K P^2) = 1 / K
    assert term == pytest.approx(float(drawn.mean()), abs=3 * error + term / n_frames)


@pytest.mark.parametrize("n_photons", [1e5, 1e7])
def test_the_mean_error_of_exposures_is_predicted_to_one_percent(n_photons):
    """The promise for the error of 10 exposures through masks under turbulence, here with holes of 0.8 r0.

    The mean of |OTF|^2 is that of the draws, 1000 from the exact covariance, so that the pupil's raster does not count.
    """
    n_frames, seeing = 10, Seeing(0.25, 20.0)
    draws = {"n_draws": 1000, "oversampling": 3, "generator": torch.Generator().manual_seed(0)}
    power = torch.cat(list(drawn_powers(REDUNDANT, GRID, seeing, **draws)))
    criterion = TurbulentMSE(
        GRID, PowerLawPSD(1.5, n_photons), NoisePSD(n_photons), n_frames, seeing.r0, seeing.outer_scale
    )
    seen = perfect_power(REDUNDANT, GRID, oversampling=3) > 0.02 / 5**2  # the promise is for what the mask transmits
    criterion.object_psd[~seen] *= 1e-12
    criterion.load_state_dict(criterion.state_dict())  # it keeps what follows from them
    noise, mean = criterion.noise_psd / n_frames, power.mean(0)
    ratio, stacks = noise / criterion.object_psd, power.unflatten(0, (-1, n_frames)).mean(1)
    # the errors less their first order in |OTF|^2, which is 0 on average
    errors = (noise / (stacks + ratio) + noise * (stacks - mean) / (mean + ratio) ** 2).mean((-2, -1))
    drawn, scatter = float(errors.mean()), float(errors.std()) / math.sqrt(len(errors))
    term = float(criterion.jensen_term(REDUNDANT))
    # the mean of all draws fluctuates too, a hundredth as much
    predicted = float((noise / (mean + ratio)).mean()) + term * (1 - n_frames / len(power))
    assert predicted == pytest.approx(drawn, abs=0.01 * drawn + 3 * scatter)
    assert term > 2 * (0.01 * drawn + 3 * scatter)  # so that no prediction without it passes


def test_without_r0_the_term_is_that_of_pistons():
    piston, none = AsymptoticMSE(GRID, *PSDS, 10), TurbulentMSE(GRID, *PSDS, 10)
    assert float(none.jensen_term(REDUNDANT)) == float(piston.jensen_term(REDUNDANT)) > 0
    with torch.device("meta"):  # another default device
        again = float(none.jensen_term(REDUNDANT))
    assert again == float(piston.jensen_term(REDUNDANT))


@pytest.mark.parametrize("criterion", [AsymptoticMSE(GRID, *PSDS, 10), TurbulentMSE(GRID, *PSDS, 10, r0=0.2)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_populations_have_a_term_for_each_mask(criterion, dtype):
    centers = torch.stack([REDUNDANT.centers, 0.9 * REDUNDANT.centers.flip(0)]).to(dtype)[:, None]
    found = criterion.jensen_term(SparseAperture(centers, 0.2, 1.0))
    assert found.shape == (2, 1)
    assert found.dtype == dtype
    alone = [criterion.jensen_term(SparseAperture(one, 0.2, 1.0)) for one in centers[:, 0]]
    torch.testing.assert_close(found[:, 0], torch.stack(alone), rtol=1e-5, atol=0)


@pytest.mark.parametrize("criterion", [AsymptoticMSE(GRID, *PSDS, 10), TurbulentMSE(GRID, *PSDS, 10, r0=0.2)])
def test_a_population_of_no_masks_has_no_terms(criterion):
    assert criterion.jensen_term(SparseAperture(torch.zeros(2, 0, 3, 2), 0.2, 1.0)).shape == (2, 0)


def test_what_is_no_mask_is_refused():
    with pytest.raises(ValueError, match="full pupil"):
        AsymptoticMSE(GRID, *PSDS, 10).jensen_term(FullAperture(1.0))
    with pytest.raises(TypeError, match="SparseAperture from the centres"):
        AsymptoticMSE(GRID, *PSDS, 10).jensen_term(REDUNDANT.centers)


def test_a_steady_amplitude_is_the_strehl_ratio_of_the_overlap():
    """Two holes far beyond the outer scale: phases differ by twice the variance over a hole, half the mean of D."""
    hole, far, seeing = 0.2, 2.0, Seeing(0.15, outer_scale=0.5)
    pair = SparseAperture([[0.0, 0.0], [far, 0.0]], hole, 2.2)
    grid = Grid.nyquist(2.2, 550e-9, 64)
    structure = seeing.structure()
    overlap = [float(pair.shape.otf(torch.tensor([[r, 0.0]]).double(), hole)) for r in torch.linspace(0, hole, 401)]
    density = torch.tensor(overlap) * torch.linspace(0, hole, 401)  # of separations r between points of a hole
    between = structure(torch.stack([torch.linspace(0, hole, 401), torch.zeros(401)], -1).double())
    variance = float((density * between).sum() / density.sum())
    found = steady_square_otf(pair, grid, torch.tensor([[far / grid.period, 0.0]]), seeing)
    # a raster of 24 samples across the hole
    assert float(found) == pytest.approx(math.exp(-variance) / 4, rel=0.02)


def test_steady_amplitudes_of_masks_are_those_of_the_general_integral():
    pair, seeing = SparseAperture([[0.4, 0.0], [-0.4, 0.0]], 0.2, 1.0), Seeing(0.2, outer_scale=10.0)
    _, steady = TurbulentMSE(GRID, *PSDS, 10, seeing.r0, seeing.outer_scale)._powers(pair)
    rows, columns = [0, 0, 0, 1, 2], [13, 12, 11, 13, 12]  # at 0.8125 to 0.6875 m, about the baseline
    frequencies = torch.tensor([[column, row] for row, column in zip(rows, columns, strict=True)]) / 32
    exact = steady_square_otf(pair, GRID, frequencies, seeing) ** 2
    # of what is transmitted at the baseline: the table is good to 2 % in an amplitude's square
    torch.testing.assert_close(steady[rows, columns], exact, rtol=0, atol=0.04 * 2**-4)


def test_a_full_pupil_is_steady_at_long_waves_and_a_speckle_at_short_ones():
    criterion = TurbulentMSE(GRID, *PSDS, 10, r0=1 / 7, outer_scale=20.0)
    mean, steady = criterion._powers(FullAperture(1.0))
    relative = 1 - steady / mean**2
    assert float(relative[0, 0]) == pytest.approx(0.0, abs=1e-6)
    assert float(relative[0, 8]) == pytest.approx(1.0, abs=0.01)


def test_independent_modes_of_a_lens_are_as_steady_as_lenses_of_their_own():
    """Light of two modes has no phase in common, whichever lens it comes through; N holes with themselves count N^4
    times, at nu and at -nu alike."""
    n, kept = 5, torch.rand(2, 1, 3, 4, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    both = steady_lenses(SimpleNamespace(kept=kept), n)
    alone = [steady_lenses(SimpleNamespace(kept=mode[None]), n) for mode in kept]
    torch.testing.assert_close(both, alone[0] + alone[1], rtol=1e-12, atol=0)
    one = torch.ones(1, 1, 3, 1, 1, dtype=torch.float64)
    assert (2 * steady_lenses(SimpleNamespace(kept=one), n)).flatten().tolist() == [n**4, 2, 2]

import math

import numpy as np
import pytest
import torch
from scipy.stats import chi2, norm
from torch import nn

from torchmask.design.criterion import AsymptoticMSE
from torchmask.design.tolerance import machining_errors, machining_tolerance
from torchmask.grid import Grid
from torchmask.optics.aperture import SparseAperture
from torchmask.spectra import NoisePSD, PowerLawPSD

HOLE = 0.1


@pytest.fixture
def mask():
    return SparseAperture.from_catalog("golay6", 1.0, 6 * HOLE**2)


@pytest.fixture
def bowl(mask):
    """A criterion with known statistics: it grows by the sum of squares of all displacements."""
    return lambda aperture: 5 * (1 + ((aperture.centers - mask.centers) ** 2).sum((-2, -1)))


def slope(aperture):
    """Grows in proportion to the displacement of the first hole."""
    return 2 + aperture.centers[..., 0, 0]


def funnel(aperture):
    """Grows with the square of the diameter's error."""
    return (
        3 * (1 + (aperture.subaperture_diameter - HOLE) ** 2) * aperture.centers.new_ones(aperture.centers.shape[:-2])
    )


def test_mean_growth_of_known_statistics(seeded, mask, bowl):
    result = machining_errors(bowl, mask, position_rms=0.003, n_draws=2000, generator=seeded(1))
    assert result.nominal_mse == 5
    mean, error = result.mean()
    assert error == pytest.approx(0.003**2 * math.sqrt(2 * 12) / math.sqrt(1000), rel=0.1)
    assert abs(mean - 12 * 0.003**2) < 4 * error


def test_a_whole_number_of_draws_may_be_a_float(seeded, mask, bowl):
    one, other = (machining_errors(bowl, mask, 0.003, n_draws=n, generator=seeded(1)) for n in (16, 16.0))
    assert torch.equal(one.mse, other.mse)
    assert len(other.mse) == 16


def test_quantiles_of_known_statistics(seeded, mask, bowl):
    result = machining_errors(bowl, mask, position_rms=0.003, n_draws=4000, generator=seeded(2))
    for level in (0.1, 0.5, 0.95):
        value, error = result.quantile(level)
        expected = 0.003**2 * chi2(12).ppf(level)
        assert abs(value - expected) < 4 * error
        # standard error of a quantile, sqrt(q (1 - q) / n) / density, of the independent half of the draws
        density = chi2(12).pdf(chi2(12).ppf(level)) / 0.003**2
        assert error == pytest.approx(math.sqrt(level * (1 - level) / 2000) / density, rel=0.5)


def test_first_order_effects_leave_the_mean_exactly(seeded, mask):
    result = machining_errors(slope, mask, position_rms=0.005, n_draws=64, generator=seeded(3))
    assert result.mean()[0] == pytest.approx(0, abs=1e-15)
    assert float(result.growth.std()) > 1e-3


@pytest.mark.parametrize("quantile", [None, 0.9])
def test_tolerance_of_known_statistics(seeded, mask, bowl, quantile):
    result = machining_tolerance(
        bowl, mask, 4e-4, quantile=quantile, kind="position", n_draws=1000, generator=seeded(4)
    )
    expected = math.sqrt(4e-4 / (12 if quantile is None else chi2(12).ppf(0.9)))
    assert abs(result.rms - expected) < 4 * result.error
    assert result.error < 0.03 * expected
    assert (result.growth, result.kind, result.quantile) == (4e-4, "position", quantile)


@pytest.mark.parametrize(("quantile", "low", "high"), [(None, 0.6, 1.4), (0.9, 0.6, 1.4)])
def test_the_statistical_error_covers_the_scatter(seeded, mask, bowl, quantile, low, high):
    expected = math.sqrt(4e-4 / (12 if quantile is None else chi2(12).ppf(0.9)))
    results = [
        machining_tolerance(bowl, mask, 4e-4, quantile=quantile, kind="position", n_draws=200, generator=seeded(seed))
        for seed in range(40)
    ]
    scores = np.array([(r.rms - expected) / r.error for r in results])
    # the rms of 40 scores scatters by 1 / sqrt(80) = 11 %; a quantile's error is itself known to 20 % or so
    assert low < math.sqrt((scores**2).mean()) < high


def test_diameter_and_both(seeded, mask, bowl):
    def both(aperture):
        return bowl(aperture) / 5 * funnel(aperture) / 3

    growth = 4e-5
    diameter = machining_tolerance(funnel, mask, growth, kind="diameter", n_draws=400, generator=seeded(5))
    assert abs(diameter.rms - math.sqrt(growth)) < 4 * diameter.error
    together = machining_tolerance(both, mask, growth, kind="both", n_draws=400, generator=seeded(6))
    assert abs(together.rms - math.sqrt(growth / 13)) < 4 * together.error


@pytest.mark.parametrize("kind", ["position", "diameter", "both"])
def test_only_what_is_asked_for_errs(seeded, mask, bowl, kind):
    moved, resized = set(), set()

    def record(aperture):
        moved.add(bool((aperture.centers != mask.centers).any()))
        resized.add(aperture.subaperture_diameter != mask.subaperture_diameter)
        return bowl(aperture) / 5 * funnel(aperture) / 3

    machining_tolerance(record, mask, 4e-5, kind=kind, n_draws=16, generator=seeded(14))
    assert (True in moved, True in resized) == (kind != "diameter", kind != "position")


def test_the_diameter_error_is_gaussian_and_common_to_all_holes(seeded, mask):
    def width(aperture):
        return aperture.centers.new_full(aperture.centers.shape[:-2], aperture.subaperture_diameter)

    errors = machining_errors(width, mask, diameter_rms=0.002, n_draws=400, generator=seeded(7)).growth.numpy() * HOLE
    assert len(errors) == 400
    assert np.sqrt((errors**2).mean()) == pytest.approx(0.002, abs=4 * 0.002 / math.sqrt(2 * 200))
    assert (np.abs(errors) < 0.002).mean() == pytest.approx(2 * norm.cdf(1) - 1, abs=4 * 0.033)


@pytest.mark.parametrize("rms", [0.0003, 0.003])
def test_each_mask_has_the_error_of_its_own_diameter(seeded, rms):
    """Not one by one but by a few diameters, it errs less than numbers made of 64 pairs of draws do, 1 in sqrt(128)."""
    criterion = AsymptoticMSE(Grid.nyquist(1.0, 550e-9, 128), PowerLawPSD(1.5, 1e5), NoisePSD(1e5), n_frames=20)
    mask = SparseAperture.from_catalog("golay9", 1.0, 9 * HOLE**2)
    seen, found = set(), machining_errors(criterion, mask, rms, rms, n_draws=128, generator=seeded(15))

    def note(aperture):
        seen.add(aperture.subaperture_diameter)
        return criterion(aperture)

    machining_tolerance(note, mask, n_draws=16, generator=seeded(16))
    assert len(seen) <= 8  # of as many TurbulentMSE keeps the tables
    generator = seeded(15)
    position = torch.randn(64, *mask.centers.shape, generator=generator, dtype=torch.float64) * rms
    diameter = torch.randn(64, generator=generator, dtype=torch.float64) * rms
    with torch.no_grad():
        masks = [mask.replace(mask.centers + p, HOLE + float(d)) for p, d in zip(position, diameter, strict=True)]
        exact = torch.stack([criterion(own) for own in masks]) / found.nominal_mse - 1
    error = (found.growth[:64] - exact).square().mean().sqrt()
    assert error < exact.square().mean().sqrt() / math.sqrt(128)


def test_a_mask_that_only_gains_has_no_tolerance(seeded, mask):
    result = machining_tolerance(lambda a: -(slope(a) ** 2) + 9, mask, n_draws=64, generator=seeded(8), kind="position")
    assert result.rms == math.inf
    assert math.isnan(result.error)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", ["golay6", "niriss"])
def test_small_errors_follow_the_gradient_of_the_criterion(seeded, name, dtype):
    """To first order each growth is the gradient along the error: its rms is the rms error times |g|."""
    criterion = AsymptoticMSE(Grid.nyquist(1.0, 550e-9, 96), PowerLawPSD(1.5, 1e7), NoisePSD(1e7), n_frames=20)
    criterion = criterion.to(dtype)
    mask = SparseAperture.from_catalog(name, 1.0, 0.15, dtype=dtype)
    free = mask.replace(centers=nn.Parameter(mask.centers.clone()))
    value = criterion(free)
    value.backward()
    assert isinstance(free.centers.grad, torch.Tensor)
    expected = float(free.centers.grad.norm() / value.detach())
    rms = 1e-6 if dtype == torch.float64 else 3e-5
    result = machining_errors(criterion, mask, position_rms=rms, n_draws=400, generator=seeded(9))
    assert result.mse.dtype == dtype
    assert float((result.growth**2).mean().sqrt()) / rms == pytest.approx(expected, rel=4 / math.sqrt(2 * 200))


def test_diameter_errors_follow_the_derivative_of_the_criterion(seeded, mask):
    criterion = AsymptoticMSE(Grid.nyquist(1.0, 550e-9, 96), PowerLawPSD(1.5, 1e7), NoisePSD(1e7), n_frames=20)

    def logarithm(diameter):
        return float(criterion(SparseAperture(mask.centers, diameter, 1.0)).log())

    expected = (logarithm(HOLE + 1e-5) - logarithm(HOLE - 1e-5)) / 2e-5
    result = machining_errors(criterion, mask, diameter_rms=1e-6, n_draws=400, generator=seeded(10))
    assert float((result.growth**2).mean().sqrt()) / 1e-6 == pytest.approx(abs(expected), rel=4 / math.sqrt(2 * 200))


def test_the_same_seed_gives_the_same_masks(seeded, mask, bowl):
    first, again, other = (
        machining_errors(bowl, mask, 0.003, n_draws=32, generator=seeded(seed)).mse for seed in (11, 11, 12)
    )
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_single_precision_draws_the_errors_of_double_precision(seeded, mask):
    """Values near 2 are equal to a few roundings of single precision, and a displacement is some 0.003."""
    double, single = (
        machining_errors(
            slope, mask.replace(centers=mask.centers.to(dtype)), 0.003, n_draws=32, generator=seeded(14)
        ).mse
        for dtype in (torch.float64, torch.float32)
    )
    torch.testing.assert_close(single.double(), double.double(), rtol=0, atol=8 * torch.finfo(torch.float32).eps)


def test_prints_its_main_numbers(seeded, mask, bowl):
    text = str(machining_errors(bowl, mask, 0.003, n_draws=64, generator=seeded(13)))
    assert "0.003 m" in text
    assert "64 masks" in text
    assert "95 % of masks stay below" in text


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"position_rms": -0.1}, "position_rms is -0.1"),
        ({"diameter_rms": 0.02}, "diameter_rms is 0.02.*a tenth of the hole diameter, 0.01 m"),
        ({"position_rms": math.nan}, "position_rms is nan"),
        ({"n_draws": 15}, "n_draws is 15: it must be a whole number of at least 16"),
        ({"n_draws": 16.5}, r"n_draws is 16\.5: it must be a whole number of at least 16"),
        ({"n_draws": 17}, "n_draws is 17: it must be even, since draws come in pairs: take 18"),
    ],
)
def test_bad_errors_are_refused(mask, bowl, keywords, message):
    with pytest.raises(ValueError, match=message):
        machining_errors(bowl, mask, **keywords)


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"growth": 0.0}, "growth is 0.0"),
        ({"growth": math.inf}, "growth is inf"),
        ({"kind": "angle"}, "kind is 'angle': known kinds are position, diameter, both"),
        ({"quantile": 1.0}, "quantile is 1.0"),
        ({"n_draws": 2}, "n_draws is 2"),
    ],
)
def test_bad_requests_are_refused(mask, bowl, keywords, message):
    with pytest.raises(ValueError, match=message):
        machining_tolerance(bowl, mask, **keywords)


def test_a_population_is_refused(bowl):
    with pytest.raises(ValueError, match="one mask is needed"):
        machining_errors(bowl, SparseAperture(torch.zeros(2, 3, 2), 0.1, 1.0), 0.001)


def test_every_evaluation_is_told(mask, bowl):
    """With turbulence in the criterion each takes seconds."""
    records, evaluations = [], []

    def slow(aperture):
        evaluations.append(aperture)
        return bowl(aperture)

    machining_tolerance(slow, mask, generator=torch.Generator().manual_seed(0), callback=records.append)
    assert [record.step for record in records] == list(range(1, len(evaluations) + 1))
    assert all(record.preparatory and record.step <= record.n_steps for record in records)
    assert {record.stage for record in records} == {"design/tolerance"}

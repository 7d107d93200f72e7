"""Lists of measurements: calibration against the observables' own, joining, and what cannot be."""

import dataclasses
import math
import warnings

import pytest
import torch
from scipy.special import j1

from torchmask.grid import Grid
from torchmask.interferometry.fringes import frame_observables
from torchmask.interferometry.measurements import Measurements, join
from torchmask.observation import Observation
from torchmask.optics.aperture import SparseAperture

MASK = SparseAperture([[0.0, 0.42], [0.38, -0.2], [-0.4, -0.15], [0.1, -0.05]], 0.1, 1.0)
GRID = Grid.nyquist(MASK.extent, 550e-9, 48, 1.1)


@pytest.fixture(scope="module")
def observe(expose_points):
    def observe(seed, stars=((0, 0, 1),)):
        frames = expose_points(MASK, GRID, stars, electrons=1e5, n_frames=4)
        drawn = torch.poisson(frames, torch.Generator().manual_seed(seed))
        return frame_observables(Observation(drawn, MASK, GRID, 0.0))

    return observe


@pytest.mark.parametrize("sizes", [(), (2e-7, 0.0), (2e-7, 1e-8), (0.0, 1e-7)])
def test_calibration_is_that_of_the_observables(sizes, observe):
    seen, star = observe(0, ((0, 0, 1), (2, 1, 0.3))), observe(1)
    one = seen.calibrate(star, *sizes, wavelength=GRID.wavelength).measurements(GRID.wavelength)
    other = seen.measurements(GRID.wavelength).calibrate(star.measurements(GRID.wavelength), *sizes)
    for field in dataclasses.fields(one):
        torch.testing.assert_close(getattr(other, field.name), getattr(one, field.name), msg=field.name)


def test_a_star_of_known_diameter_is_a_point_at_every_wavelength():
    """|V|^2 and their covariance as of a closed form, and its derivatives, in object, star and diameter."""
    generator = torch.Generator().manual_seed(0)
    waves = torch.tensor([1.5e-6, 1.65e-6, 1.8e-6], dtype=torch.float64).repeat(5)
    baselines = 40 * torch.randn(5, 2, dtype=torch.float64, generator=generator).repeat_interleave(3, 0)
    none, size, error = torch.zeros(0, dtype=torch.float64), 4e-9, 2e-10
    x = math.pi * (baselines.norm(dim=1) / waves).numpy()

    def power(diameter):
        return torch.from_numpy((2 * j1(x * diameter) / (x * diameter)) ** 2)

    def measured(vis2, errors):
        return Measurements(
            *(baselines, waves, vis2, errors, None, none.view(0, 2, 2), none, none, none, None),
        )

    lost = 0.5 + 0.4 * torch.rand(15, dtype=torch.float64, generator=generator)
    truth = 0.2 + 0.8 * torch.rand(15, dtype=torch.float64, generator=generator)
    seen, star = measured(truth * lost, 0.01 * lost), measured(power(size) * lost, 0.02 * lost)
    found = seen.calibrate(star, size, error)
    torch.testing.assert_close(found.vis2, truth, rtol=1e-12, atol=0)
    step = 1e-5 * size
    by_size = truth * (power(size + step) - power(size - step)) / (2 * step * power(size)) * error
    own = (0.01 * lost * truth / seen.vis2) ** 2 + (0.02 * lost * truth / star.vis2) ** 2
    covariance = own.diag() + by_size[:, None] * by_size
    torch.testing.assert_close(found.vis2_errors**2, covariance.diagonal(), rtol=1e-6, atol=0)
    scale = covariance.diagonal().rsqrt()
    torch.testing.assert_close(found.vis2_correlation, covariance * scale[:, None] * scale, rtol=1e-6, atol=1e-9)
    assert seen.calibrate(star, size).vis2_correlation is None
    with pytest.raises(ValueError, match=r"diameter is -1e-09 \+- 0 rad: neither must be negative"):
        seen.calibrate(star, -1e-9)
    with pytest.raises(ValueError, match=r"diameter is 1e-06 \+- 0 rad: a disc of .* shows no fringes"):
        seen.calibrate(star, 1e-6)


@pytest.mark.parametrize(("share", "warns"), [(0.2499, False), (0.2501, True)])
def test_a_star_that_is_known_to_fewer_than_four_errors_is_warned_of(share, warns, observe):
    """On one of six baselines, whose other errors may be anything; before it divides observables or measurements."""
    star = observe(1)
    covariance = star.vis2_covariance.clone()
    covariance[2, 2] = (share * star.vis2[2]) ** 2
    star = dataclasses.replace(star, vis2_covariance=covariance)
    for one, other in ((star, star), (star.measurements(GRID.wavelength), star.measurements(GRID.wavelength))):
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            one.calibrate(other)
        said = "is known to fewer than 4 of its errors on 1 of 6 baselines"
        assert [said in str(entry.message) for entry in told] == [True] * warns
        assert all(entry.filename == __file__ for entry in told)


def test_those_of_different_nights_are_independent(observe):
    seen = observe(0).measurements(GRID.wavelength)
    both = join([seen, seen])
    assert both.vis2.shape == (12,)
    torch.testing.assert_close(both.vis2_correlation[:6, :6], seen.vis2_correlation)
    assert not both.closure_correlation[:4, 4:].any()
    assert both.finest == seen.finest == pytest.approx(1 / float(seen.frequencies.norm(dim=1).max()))
    sides = seen.triangle_frequencies
    assert sides.sum(1).abs().max() < 1e-9 * sides.abs().max()
    alone = join([seen.closures_only(), dataclasses.replace(seen, closure_correlation=None).closures_only()])
    torch.testing.assert_close(alone.closure_correlation[4:, 4:], torch.eye(4, dtype=torch.float64))


def test_what_cannot_be_is_refused(observe):
    seen = observe(0).measurements(GRID.wavelength)
    with pytest.raises(ValueError, match=r"wavelengths holds 0: all must be positive"):
        observe(0).measurements(0.0)
    with pytest.raises(ValueError, match=r"vis2 holds values that are not finite"):
        dataclasses.replace(seen, vis2=seen.vis2 * torch.nan)
    with pytest.raises(ValueError, match=r"baselines has shape \(5, 2\): it must be \(6, 2\)"):
        dataclasses.replace(seen, baselines=seen.baselines[:5])
    with pytest.raises(ValueError, match="the star was observed differently: its 0 baselines and 4 triangles"):
        seen.calibrate(seen.closures_only())
    with pytest.raises(ValueError, match="the star was observed differently"):
        seen.calibrate(observe(0).measurements(1.01 * GRID.wavelength))
    with pytest.raises(ValueError, match="shows no fringes on 6 of 6 baselines"):
        seen.calibrate(dataclasses.replace(seen, vis2=-seen.vis2))
    with pytest.raises(ValueError, match="measurements is empty"):
        join([])

"""Parts of the fringes' errors in closed form: dark pixels, few photons, noise alone, and the scatter of frames."""

import math

import pytest
import torch

from torchmask.grid import Grid
from torchmask.interferometry.fringe_fit import FringeFit, FringeModel, PixelNoise, _weights
from torchmask.interferometry.fringes import _covariance, _pixel_noise, _ratio, _squares, _triple_noise, _triples
from torchmask.interferometry.visibilities import triangle_sides
from torchmask.observation import Observation
from torchmask.optics.aperture import SparseAperture

MASK = SparseAperture([[0.0, 0.42], [0.38, -0.2], [-0.4, -0.15]], 0.1, 1.0)
GRID = Grid.nyquist(MASK.extent, 550e-9, 48, 1.1)


def test_dark_pixels_do_not_outweigh_the_others_without_bound():
    """Photon noise of the light of one point; what rounding leaves far from it may even be negative."""
    variance = torch.zeros(2, *GRID.shape, dtype=torch.float64)
    variance[:, 24, 24] = 1e6
    weights = _weights(variance, torch.ones_like(variance, dtype=torch.bool), FringeModel(MASK, GRID))
    assert bool((weights > 0).all())
    assert float(weights.max() / weights.min()) == pytest.approx(1000, rel=1e-9)


def test_the_cube_of_the_light_of_few_photons_is_that_of_their_triples():
    """Of x Poisson photons of mean m, x (x - 1) (x - 2) has the mean m^3; their variance and third moment are x."""
    model, x = FringeModel(MASK, GRID), torch.tensor([5.0, 7.0], dtype=torch.float64)
    noise = PixelNoise(x, is_own=True, light=x)
    values = torch.cat([x[:, None], 2 * torch.ones(2, 3).double(), torch.zeros(2, 3).double()], 1)  # fringes of 2
    covariance = torch.zeros(2, 7, 7, dtype=torch.float64)
    covariance[:, 0, 0] = noise.variance
    cubes = torch.stack([noise.third, torch.zeros_like(x)], 1).to(torch.complex128)
    triple, _, _ = _triples(FringeFit(values, covariance, cubes), model, 3)
    assert complex(triple) == pytest.approx(2 * 3**3 * 2**3 / (5 * 4 * 3 + 7 * 6 * 5), rel=1e-12)


def test_squares_of_fringes_that_are_all_noise_have_the_variance_of_noise():
    """A baseline's |V|^2 is n^2 (x^2 + y^2 - 2 s^2) over the light squared: variance 4 n^4 s^4 for each frame."""
    n_frames, n_holes, rms, light = 4000, 3, 2.0, 500.0
    values = rms * torch.randn(n_frames, 7, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    values[:, 0] += light
    covariance = (rms**2 * torch.eye(7, dtype=torch.float64)).expand(n_frames, 7, 7)
    found, told = _squares(FringeFit(values, covariance, torch.zeros(n_frames, 2, dtype=torch.complex128)), n_holes)
    expected = 4 * n_holes**4 * rms**4 / n_frames / light**4
    # the larger of two, of which the scatter of exponential numbers, of kurtosis 9, is known to (8 / 4000)^(1/2)
    ratio = told.diagonal() / expected
    assert 1 - 0.05 < float(ratio.min()) <= float(ratio.max()) < 1 + 4 * math.sqrt(8 / n_frames)
    assert float(found.abs().max()) < 4 * math.sqrt(expected)


@pytest.mark.parametrize("measured", [0.0, 0.3, 1.0])
def test_a_square_that_comes_out_small_has_the_error_of_noise_at_least(measured):
    """That of n^2 (x^2 + y^2 - 2 s^2), whatever x and y are: 4 n^4 s^4, and 4 n^4 s^2 x^2 besides once x is large."""
    rms, light, n_holes = 2.0, 500.0, 3
    values = torch.zeros(1, 7, dtype=torch.float64)
    values[:, 0], values[:, 1:4] = light, measured * rms
    covariance = (rms**2 * torch.eye(7, dtype=torch.float64))[None]
    covariance[:, 0, 0] = 1e-9  # of the light
    _, told = _squares(FringeFit(values, covariance, torch.zeros(1, 2, dtype=torch.complex128)), n_holes)
    variance = 4 * rms**2 * (measured * rms) ** 2 - 4 * rms**4  # unbiased, but negative here
    expected = n_holes**4 * max(variance, 4 * rms**4) / light**4
    torch.testing.assert_close(told.diagonal(), torch.full((3,), expected, dtype=torch.float64), rtol=1e-4, atol=0)


def test_the_scatter_of_a_few_frames_is_that_of_their_sum():
    """n times the sample variance, besides what all have as ten frames, and the frames' own correlation as they count.

    The noise, far below the scatter, says how the variances of all compare: as 1 to 3.
    """
    rest = torch.tensor([[1.0, 3.0], [-2.0, 0.5], [0.5, -4.0], [0.5, 0.5]], dtype=torch.float64)
    assert not rest.sum(0).any()
    found = _covariance(rest, 1e-6 * torch.tensor([1.0, 3.0], dtype=torch.float64).diag())
    scatter = 4 * rest.var(0)
    prior = scatter.sum() * torch.tensor([0.25, 0.75], dtype=torch.float64)
    torch.testing.assert_close(found.diagonal(), (10 * prior + 4 * scatter) / 14, rtol=1e-12, atol=0)
    correlation = float(torch.corrcoef(rest.T)[0, 1]) * 4 / (2 + 4)  # four frames and two quantities
    assert float(found[0, 1] / found.diagonal().prod().sqrt()) == pytest.approx(correlation, rel=1e-12)
    assert torch.equal(_covariance(rest[:1], torch.eye(2, dtype=torch.float64)), torch.eye(2, dtype=torch.float64))


def test_no_variance_is_below_that_of_the_noise():
    """Where frames scatter less than it says, and where one quantity does: the other has the mean of both."""
    rest = torch.tensor([[1.0, 0.1], [-1.0, -0.1]], dtype=torch.float64)
    noise = torch.tensor([8.0, 2.0], dtype=torch.float64)
    torch.testing.assert_close(_covariance(rest, noise.diag()).diagonal(), noise, rtol=1e-12, atol=0)
    quiet = _covariance(rest, torch.tensor([1.0, 2.0], dtype=torch.float64).diag()).diagonal()
    more = (4.0 + 0.04) / 3  # scatter is twice the sample variance, 2 and 0.02
    torch.testing.assert_close(quiet[0], torch.tensor((10 * more + 2 * 4.0) / 12, dtype=torch.float64))
    assert float(quiet[1]) == pytest.approx(max(2.0, (10 * more * 2 + 2 * 0.04) / 12))
    one = torch.tensor([100.0, 2.0], dtype=torch.float64)  # all scatter less, but one of them more than its noise
    found = _covariance(torch.tensor([[0.0, 2.0], [0.0, -2.0]], dtype=torch.float64), one.diag()).diagonal()
    expected = torch.tensor([100.0, (10 * 2.0 + 2 * 16.0) / 12], dtype=torch.float64)
    torch.testing.assert_close(found, expected, rtol=1e-12, atol=0)


def test_the_error_of_a_mean_visibility_is_that_of_either_part_of_it():
    """Real and imaginary part scatter alike; the larger of noise and scatter counts, over all the light."""
    values = torch.tensor([[3.0 + 1.0j], [1.0 - 1.0j], [2.0 + 0.0j]], dtype=torch.complex128)
    light, none = torch.full((3,), 10.0, dtype=torch.float64), torch.zeros(3, 1, dtype=torch.float64)
    ratio, error = _ratio(values, light, none)
    assert complex(ratio) == pytest.approx(0.2)
    parts = torch.view_as_real(values[:, 0])
    assert float(error) == pytest.approx(math.sqrt(3 * float(parts.var(0).mean())) / 30, rel=1e-12)
    noisy = _ratio(values, light, none + 12.0)[1]  # of each frame, in either part
    assert float(noisy) == pytest.approx(math.sqrt(3 * 12) / 30, rel=1e-12)


def test_triple_products_of_noise_alone_have_the_variance_of_a_product():
    """Of three independent complex numbers with mean squares e it is e^3, half of it in the real part.

    The sum of the three derivatives' variances, to first order, is three times as much.
    """
    n_frames, n_holes, rms, light = 4000, 3, 2.0, 500.0
    values = rms * torch.randn(n_frames, 7, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    values[:, 0] += light
    covariance = (rms**2 * torch.eye(7, dtype=torch.float64)).expand(n_frames, 7, 7)
    fit = FringeFit(values, covariance, torch.zeros(n_frames, 2, dtype=torch.complex128))
    model, turn = FringeModel(MASK, GRID), torch.ones(1, dtype=torch.complex128)
    sides = triangle_sides(model.pairs, model.triangles)
    expected = n_frames * n_holes**6 * (2 * rms**2) ** 3 / 2
    for part in _triple_noise(fit, sides, turn, n_holes):
        # the mean over frames of products of two exponential numbers, of variance 3, is known to (3 / 4000)^(1/2)
        assert float(part) == pytest.approx(expected, rel=5 * math.sqrt(3 / n_frames))


def test_read_out_noise_is_what_photons_leave_of_the_noise_that_is_measured():
    """Evenly lit pixels of 20 electrons with a read-out noise of 6: frequencies beyond the cut-off show 20 + 36."""
    generator = torch.Generator().manual_seed(0)
    frames = torch.poisson(torch.full((4, *GRID.shape), 20.0, dtype=torch.float64), generator)
    frames += 6 * torch.randn(frames.shape, generator=generator, dtype=torch.float64)
    valid = torch.ones_like(frames, dtype=torch.bool)
    found = _pixel_noise(Observation(frames, MASK, GRID, None), frames, valid)
    readout = found.variance - frames
    assert found.is_own
    n = 4 * 48**2 * (1 - math.pi * GRID.cutoff(MASK.extent) ** 2)  # frequencies
    error = 56 * math.sqrt(2 / n)
    assert error < 2
    torch.testing.assert_close(readout, torch.full_like(readout, 36.0), rtol=0, atol=4 * error)

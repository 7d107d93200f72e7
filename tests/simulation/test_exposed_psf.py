"""PSFs of exposures that last, in a band: closed forms of the contrast, from both sides."""

import math

import numpy as np
import pytest
import torch

from torchmask.atmosphere.endless import Screen, ScreenWindow
from torchmask.atmosphere.layers import Layers
from torchmask.atmosphere.phase import LayeredPhase
from torchmask.atmosphere.von_karman import von_karman_structure_function
from torchmask.grid import Grid
from torchmask.optics.aperture import FullAperture, SparseAperture
from torchmask.optics.band import Band
from torchmask.optics.otf import analytic_otf
from torchmask.optics.psf import fold
from torchmask.simulation.exposed_psf import ExposedPSF, _widen
from torchmask.simulation.wavefronts import STEPS_PER_TAU0, exposure_delays, wavefronts

WAVELENGTH = 550e-9


# ---- a band


@pytest.mark.parametrize("factor", [1.0, 1.13, 2.0])
def test_an_image_is_widened_exactly(factor):
    """A wave of any frequency within the raster's, with the same wave wider around the first pixel."""
    matrix, _ = _widen((24, 24), factor, torch.zeros((), dtype=torch.float64))
    place = torch.fft.fftfreq(24, 1 / 24, dtype=torch.float64)
    for cycles in range(12):
        angle = 2 * math.pi * cycles / 24 * place
        wave, wider = torch.cos(angle) + torch.sin(angle), torch.cos(angle / factor) + torch.sin(angle / factor)
        torch.testing.assert_close(matrix @ wave, wider / factor, rtol=0, atol=1e-12)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_the_otf_of_a_band_is_the_mean_of_those_of_its_wavelengths(dtype):
    """Of a full pupil in closed form; what the sampling of the pupil leaves is as large with one wavelength."""
    aperture = FullAperture(1.0, dtype=dtype)
    grid = Grid.nyquist(1.0, WAVELENGTH, 48, 1.3)
    band = Band.of([470e-9, 550e-9, 640e-9], [1.0, 3.0, 2.0])

    def otf(own):
        return torch.fft.fft2(fold(ExposedPSF(aperture, grid, own)([None]), grid.shape)).real

    def exact(wavelength):
        return analytic_otf(aperture, Grid(48, grid.pixel_scale, wavelength)).real

    expected = sum(share * exact(w) for w, share in zip(band.wavelengths, band.shares, strict=True))
    alone = float((otf(Band.of([470e-9])) - exact(470e-9)).abs().max())
    together = float((otf(band) - expected).abs().max())
    assert together < 1.5 * alone < 0.02
    assert float((exact(550e-9) - expected).abs().max()) > 2 * together  # one wavelength alone would not pass


def test_path_differences_are_the_same_at_all_wavelengths():
    """A tilt of the wavefront moves the image of every wavelength by as many pixels, and so the image of the band."""
    grid = Grid.nyquist(1.0, WAVELENGTH, 32, 1.3)
    aperture = FullAperture(1.0)
    tilt = 2 * math.pi * grid.pixel_scale / WAVELENGTH * torch.tensor([5.0, -3.0], dtype=torch.float64)

    def off(band, shift):
        optics = ExposedPSF(aperture, grid, band)
        position = optics.samples.offsets + aperture.centers[:, None]
        still, moved = optics([None]), optics([position @ tilt])
        return float((moved - still.roll(shift, (0, 1))).abs().max() / still.max())

    # the sampling of the pupil leaves as much with one wavelength
    alone = off(Band.of([470e-9]), (-3, 5))
    assert off(Band.of([470e-9, 640e-9]), (-3, 5)) < 1.5 * alone < 0.005
    assert off(Band.of([470e-9, 640e-9]), (-3, 6)) > 0.05


@pytest.mark.parametrize(("width", "exact"), [(0.05, 0.965), (0.1, 0.875), (0.2, 0.659), (0.4, 0.397)])
def test_a_band_lowers_the_contrast_of_two_points(width, exact):
    """E|V|^2 of a top hat, uniform in wavelength, at D/r0 = 7 on the baseline D, of path differences alone.

    In the middle of the field all wavelengths fall on the same pixel, whatever their baselines: its light is
    1 + Re V of a piston between two holes, with shares in proportion to wavelength squared, for wider images are
    fainter by that. The mean of (Re V)^2 over Gaussian pistons of the structure function 6.88 7^(5/3) is half of
    E|V|^2, but for the mean of V^2, below 1e-3 for these widths.
    """
    grid = Grid.nyquist(1.2, WAVELENGTH, 16, 1.3)
    step = ExposedPSF(FullAperture(1.0), grid).samples.step[0]
    band = Band.top_hat(WAVELENGTH, width * WAVELENGTH, 12)
    optics = ExposedPSF(
        SparseAperture([[-7 * step, 0.0], [7 * step, 0.0]], 4 * step, 1.0),
        Grid(16, grid.pixel_scale, WAVELENGTH),
        Band.of(band.wavelengths, [share * w**2 for w, share in zip(band.wavelengths, band.shares, strict=True)]),
    )
    deviation = math.sqrt(6.88 * 7 ** (5 / 3))
    pistons = torch.linspace(-4.5, 4.5, 61, dtype=torch.float64)
    weights = torch.exp(-(pistons**2) / 2)
    ones = torch.ones(optics.samples.weights.shape[-1], dtype=torch.float64)
    light = torch.stack([optics([torch.stack([0 * ones, deviation * p * ones])])[0, 0] for p in pistons])
    mean = float((weights * light).sum() / weights.sum())
    power = float((weights * (light / mean - 1) ** 2).sum() / weights.sum())
    # PSFs have unit sum on their raster, where some light of the fringes is missing, so the mean is off: 1 %
    assert 2 * power == pytest.approx(exact, rel=0.01)


# ---- an exposure

KEPT = {0.5: 0.940, 1.0: 0.832, 2.0: 0.620, 4.0: 0.378}  # of two independent points, by T / tau0


def stepped(steps, structure):
    """E|V|^2 of an exposure in `steps` equal steps, given the phase structure after k of them."""
    k = np.arange(1, steps)
    return 1 / steps + 2 / steps * float(((1 - k / steps) * np.exp(-structure(k))).sum())


@pytest.mark.parametrize("ratio", KEPT)
def test_the_steps_of_an_exposure_are_fine_enough(ratio):
    turbulence = LayeredPhase(Layers.from_fractions(0.1, WAVELENGTH, [0.0], [1.0], [(8.0, 6.0)]), WAVELENGTH, 20.0)
    tau0 = turbulence.layers.tau0(WAVELENGTH)
    assert tau0 == pytest.approx(0.314 * 0.1 / 10, rel=1e-3)
    delays = exposure_delays(turbulence, ratio * tau0)
    assert len(delays) == STEPS_PER_TAU0 * ratio
    gap = ratio / len(delays)
    x = (np.arange(10_000) + 0.5) / 10_000
    exact = float((2 * (1 - x) * np.exp(-((x * ratio) ** (5 / 3)))).mean())
    assert exact == pytest.approx(KEPT[ratio], abs=5e-4)  # as rounded
    # Euler and Maclaurin's sum formula, with the cusp u^(5/3) of the structure function and zeta(-5/3) = -0.01437
    excess = stepped(len(delays), lambda k: (k * gap) ** (5 / 3)) - exact
    theory = (1 - math.exp(-(ratio ** (5 / 3)))) / (6 * len(delays) ** 2) + 2 / ratio * 0.01437 * gap ** (8 / 3)
    assert excess == pytest.approx(theory, rel=0.05)
    assert excess < 0.0035 * exact
    assert np.mean(delays) == pytest.approx(ratio * tau0 / 2)


@pytest.mark.parametrize("ratio", KEPT)
def test_an_exposure_lowers_the_contrast_of_two_independent_points(ratio):
    """|V|^2 of two small holes under screens of their own, 100 exposures, with the outer scale in the expectation."""
    r0, outer_scale, n_exposures = 0.3, 300.0, 100
    grid = Grid.nyquist(1.0, WAVELENGTH, 16)
    step = 2.0 / 64
    optics = ExposedPSF(SparseAperture([[-6 * step, 0.0], [6 * step, 0.0]], 3 * step, 1.0), grid)
    ones = torch.ones_like(optics.samples.weights[0])
    layer = Layers.from_fractions(r0, WAVELENGTH, [0.0], [1.0], [(1.0, 0.0)])
    delays = exposure_delays(LayeredPhase(layer, WAVELENGTH, outer_scale), ratio * layer.tau0(WAVELENGTH))
    gap, steps = ratio * layer.tau0(WAVELENGTH) / len(delays), len(delays)
    window = ScreenWindow((1, 10 * steps), (gap, gap), outer_scale, torch.float64, torch.device("cpu"))
    # ten exposures in a row pass through each pair of screens
    pairs = [torch.stack([Screen(window, r0, 2 * k + m).at((0.0, 0.0))[0] for m in (0, 1)]) for k in range(10)]
    exposures = [part for pair in pairs for part in pair.split(steps, dim=1)]
    assert len(exposures) == n_exposures

    def contrast(phases):
        return torch.fft.fft2(optics(phases))[0, 12].abs()

    perfect = contrast([None])
    squared = torch.stack([contrast(part * ones for part in each.T[..., None]) for each in exposures])
    squared = (squared / perfect) ** 2
    later = torch.arange(steps, dtype=torch.float64) * gap
    structure = von_karman_structure_function(later, r0, outer_scale)
    expected = stepped(steps, lambda k: structure[torch.from_numpy(k)].numpy())
    error = float(squared.view(10, 10).mean(1).std()) / math.sqrt(10)  # rows are independent: Student's t of 9
    assert error < 0.12 * expected
    assert float(squared.mean()) == pytest.approx(expected, abs=5 * error)
    assert KEPT[ratio] < expected < KEPT[ratio] + 0.03  # the outer scale of 1000 r0 keeps a little more


def test_an_exposure_through_a_layer_keeps_the_contrast_of_the_closed_form():
    """Two holes under frozen flow along their baseline: the mean of exp(-Q/2) over all pairs of times and of points of
    a hole, s apart, with Q = 2 D(b) + 2 D(s + v tau) - D(b + s + v tau) - D(b - s - v tau), over that in a snapshot.
    Points alone would keep 0.73: a hole of a third of r0 averages what moves over it."""
    r0, outer_scale, n_frames, baseline, wind = 0.3, 10.0, 60, 0.375, (0.8, 0.6)
    grid = Grid.nyquist(1.0, WAVELENGTH, 16)
    step = 2.0 / 64
    optics = ExposedPSF(SparseAperture([[-6 * step, 0.0], [6 * step, 0.0]], 3 * step, 1.0), grid)
    layers = Layers.from_fractions(r0, WAVELENGTH, [0.0], [1.0], [wind])
    turbulence = LayeredPhase(layers, WAVELENGTH, outer_scale)
    delays = exposure_delays(turbulence, 2 * layers.tau0(WAVELENGTH))
    stream = wavefronts(turbulence, optics.samples, n_frames, delays, torch.Generator().manual_seed(3))

    def power(phases):
        return float(torch.fft.fft2(optics(phases))[0, 12].abs()) ** 2

    drawn = np.array([[power(phases), power(phases[:1])] for phases in (list(w((0.0, 0.0))) for w in stream)])
    tau = torch.tensor(delays, dtype=torch.float64)
    moved = (tau[:, None] - tau).flatten()[:, None] * torch.tensor(wind, dtype=torch.float64)
    points, weights = optics.samples.offsets[0], optics.samples.weights[0] ** 2  # in both holes alike
    apart = (points[:, None] - points).flatten(0, 1)
    shares = (weights[:, None] * weights).flatten() / weights.sum() ** 2
    pair = torch.tensor([baseline, 0.0], dtype=torch.float64)

    def structure(vector):
        return von_karman_structure_function(torch.linalg.vector_norm(vector, dim=-1), r0, outer_scale)

    def kept(way):
        between = apart[:, None] + way
        q = 2 * structure(pair) + 2 * structure(between) - structure(between + pair) - structure(between - pair)
        return float((torch.exp(-q / 2).mean(1) * shares).sum())

    expected = kept(moved) / kept(0 * moved)
    ratio, error = drawn[:, 0] / drawn[:, 1].mean(), float(drawn[:, 0].std() / drawn[:, 1].mean()) / math.sqrt(n_frames)
    assert 0.4 < expected < 0.9
    assert error < 0.08
    assert float(ratio.mean()) == pytest.approx(expected, abs=4 * error)

"""What turbulence leaves of a lens, as it is interpolated, against the mean over pairs of its points."""

import pytest
import torch

from torchmask.atmosphere.lens_coherence import lens_amplitude, lens_drift, lens_sum
from torchmask.atmosphere.seeing import Seeing
from torchmask.optics.shapes import Disc

DIAMETER = 0.1
BASELINE = torch.tensor([[0.33, 0.21]], dtype=torch.float64)
PLACES = torch.tensor([[0.0, 0.0], [0.3, 0.1], [-0.2, 0.4], [0.5, -0.5], [0.1, 0.8]], dtype=torch.float64)


def mean_over_points(seeing, baseline, points, scale, average):
    """`average` of Q / 2 (pairs of points, lags) of the points of a lens, with the weights of the lags."""
    separations = (points[:, None] - points).flatten(0, 1)
    structure, (drift, shares) = seeing.structure(2.0), lens_drift(seeing)
    separations = separations[:, None] + drift
    crossed = structure(separations + baseline) + structure(separations - baseline)
    half = scale**2 * (structure(baseline) + structure(separations) - crossed / 2)
    return float(average(half).mean(0) @ torch.tensor(shares, dtype=torch.float64))


@pytest.mark.parametrize("tau", [0.0, 1.0])
@pytest.mark.parametrize(("ratio", "scale"), [(0.4, 1.0), (1.5, 1.0), (1.5, 1.2)])
def test_the_amplitude_is_the_mean_over_pairs_of_points(ratio, scale, tau, lens_points):
    """To a per cent of the amplitude of a whole hole, weighted by what a lens transmits; points are off by 1 / 26^2."""
    r0 = DIAMETER / ratio
    seeing = Seeing(r0, exposure=tau * Seeing(r0, wind=10.0).tau0, wind=10.0 if tau else 0.0)
    table = lens_amplitude(Disc(), DIAMETER, seeing, 1.0, scale)
    transfer = Disc().otf(PLACES * DIAMETER, DIAMETER)
    factors = [factor.expand(len(PLACES)) for factor in table(BASELINE)]
    found = lens_sum(factors, transfer.sqrt(), *PLACES.unbind(-1))
    for place, lens, amplitude in zip(PLACES, transfer, found, strict=True):
        points = lens_points(place * DIAMETER, DIAMETER, 26)
        kept = mean_over_points(seeing, BASELINE[0], points, scale, lambda half: torch.exp(-half)) ** 0.5
        assert float(lens * amplitude) == pytest.approx(float(lens) * kept, abs=0.01)


def test_steady_amplitudes_keep_a_quarter_of_the_mean_variance(lens_points):
    seeing = Seeing(DIAMETER / 0.8)
    table = lens_amplitude(Disc(), DIAMETER, seeing, 1.0, steady=True)
    transfer = Disc().otf(PLACES * DIAMETER, DIAMETER)
    found = lens_sum([factor.expand(len(PLACES)) for factor in table(BASELINE)], transfer.sqrt(), *PLACES.unbind(-1))
    for place, lens, amplitude in zip(PLACES, transfer, found, strict=True):
        points = lens_points(place * DIAMETER, DIAMETER, 26)
        half = mean_over_points(seeing, BASELINE[0], points, 1.0, lambda half: half)
        kept = float(torch.exp(torch.tensor(-half / 2)))
        assert float(lens * amplitude) == pytest.approx(float(lens) * kept, abs=0.01)

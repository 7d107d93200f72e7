"""What turbulence leaves of a lens, as it is interpolated, against the mean over pairs of its points."""

import pytest
import torch

from torchmask.atmosphere import lens_coherence
from torchmask.atmosphere.lens_coherence import lens_amplitude, lens_drift, lens_sum, shared_coherence
from torchmask.atmosphere.seeing import Seeing
from torchmask.optics.shapes import Disc, Hexagon, Square

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


@pytest.mark.parametrize("shape", [Disc(), Hexagon(), Square(0.2)], ids=["disc", "hexagon", "turned square"])
@pytest.mark.parametrize("wind", [10.0, (8.0, 6.0)])
def test_directions_that_follow_from_others_are_as_computed(shape, wind, monkeypatch):
    """With little of either table, and of one its products. Round holes are sampled along the first baseline only."""
    monkeypatch.setattr(lens_coherence, "_SHARED_BASELINES", (3, 6))
    monkeypatch.setattr(lens_coherence, "_SEPARATIONS", (4, 6))
    monkeypatch.setattr(lens_coherence, "_BASELINES", (3, 6))
    monkeypatch.setattr(lens_coherence, "_PLACES", (4, 6))
    seeing = Seeing(DIAMETER / 1.5, exposure=2 * Seeing(DIAMETER / 1.5, wind=10.0).tau0, wind=wind)

    def tables():
        shared = shared_coherence(shape, DIAMETER, seeing, 0.5)
        parts = [torch.from_numpy(part.values).flatten(1) for part in shared]
        return parts[0].T @ parts[1], torch.from_numpy(lens_amplitude(shape, DIAMETER, seeing, 0.5).values)

    found = tables()

    def everywhere(function, baselines, others, *_):
        if not shape.is_round or not seeing.is_isotropic:
            return function(baselines.flatten(0, 1), others.flatten(0, 1))
        first = function(baselines[:, 0], others.flatten(0, 1)).unflatten(-1, others.shape[:2])
        return torch.stack([first.roll(turn, -1) for turn in range(6)], 1).flatten(2).flatten(0, 1)

    monkeypatch.setattr(lens_coherence, "_table", everywhere)
    for one, other in zip(found, tables(), strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=1e-11 * float(other.abs().max()))

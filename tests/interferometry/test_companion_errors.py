"""What is said of a companion that was found, and companions put beside a star, in closed form."""

import math

import pytest
import torch

from torchmask.grid import ARCSEC, MAS, Grid
from torchmask.interferometry import companion_errors
from torchmask.interferometry.companion import CompanionModel, Exposures, Parameters
from torchmask.interferometry.companion_errors import (
    differences_over_errors,
    inject_companion,
    injection_errors,
    measured_companion,
    polar,
    rotation_towards,
)
from torchmask.interferometry.companion_fit import CompanionFit, fit_companion
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.band import Band

GRID = Grid.nyquist(1.0, 550e-9, 24)


def tensor(*values):
    return torch.tensor(values, dtype=torch.float64)


def fit_of(companion, covariance, jackknife):
    nothing = torch.zeros(len(jackknife), dtype=torch.float64)
    parameters = Parameters(nothing, nothing, nothing, companion)
    return CompanionFit(parameters, covariance, nothing, nothing, jackknife)


@pytest.mark.parametrize("angle", [10.0, 100.0, 200.0, 350.0])
def test_directions_go_from_north_through_east(angle):
    turn = math.radians(angle)
    companion = tensor(0.1, 0.2 * ARCSEC * math.sin(turn), 0.2 * ARCSEC * math.cos(turn))
    found = polar(companion)
    assert found["separation"] == pytest.approx(200)
    assert found["position_angle"] == pytest.approx(angle)
    assert found["magnitude_difference"] == pytest.approx(2.5)
    # the rotation turns it onto the second axis
    turned = rotation_towards(companion) @ companion
    torch.testing.assert_close(turned, tensor(0.1, 0.2 * ARCSEC, 0.0), rtol=1e-12, atol=1e-12 * ARCSEC)
    assert polar(tensor(-0.1, 1e-6, 0.0))["magnitude_difference"] == math.inf


def test_errors_are_along_and_across_the_separation():
    """A companion in the north-east whose jackknife scatters along the separation, and whose noise is across it."""
    radius, spread, across = 1.5e-6, 1e-8, 2e-8
    outwards = tensor(0.6, 0.8)
    companion = torch.cat([tensor(0.01), radius * outwards])
    jackknife = companion.repeat(4, 1)
    jackknife[:, 1:] += spread * tensor(1.0, -1.0, 1.0, -1.0)[:, None] * outwards
    sideways = tensor(0.8, -0.6)
    covariance = torch.zeros(3, 3, dtype=torch.float64)
    covariance[1:, 1:] = across**2 * torch.outer(sideways, sideways)
    covariance[0, 0] = 1e-8
    fit, systematic = fit_of(companion, covariance, jackknife), tensor(0.0, 3 * spread, 0.0)
    found = measured_companion(fit, systematic)
    assert found["separation"] == pytest.approx(radius / MAS)
    assert found["position_angle"] == pytest.approx(math.degrees(math.atan2(0.6, 0.8)))
    errors = found["statistical_error"]
    assert errors["separation"] == pytest.approx(3**0.5 * spread / MAS)  # (n - 1) / n times n squares
    assert errors["position_angle"] == pytest.approx(math.degrees(across / radius))
    assert errors["magnitude_difference"] == pytest.approx(2.5 / math.log(10) * 1e-4 / 0.01)
    assert found["systematic_error"]["separation"] == pytest.approx(3 * spread / MAS)
    assert found["total_error"]["separation"] == pytest.approx(12**0.5 * spread / MAS)
    assert found["exposures"] == 4
    other = measured_companion(fit, systematic)
    other["position_angle"] -= 359.0
    assert differences_over_errors(found, other)["position_angle"] == pytest.approx(
        -1 / (2**0.5 * errors["position_angle"]), rel=1e-6
    )
    assert differences_over_errors(found, other)["separation"] == 0


@pytest.fixture(scope="module")
def star():
    """A model, exposures of a star without noise, and their fit; east is y and north x, 0.1 arcsec to a pixel."""
    mask = SparseAperture([[0.0, 0.4], [-0.35, -0.2], [0.35, -0.25], [-0.1, 0.0]], 0.22, 1.0)
    model = CompanionModel(mask, GRID, 3, Band.of([550e-9]), radius=10.0, flux_error=0.0)
    own = torch.zeros(2, 16, dtype=torch.float64)
    own[:, :4] = tensor([1e6, 5.0, 12.0, 12.0], [2e6, 3.0, 12.2, 11.9])
    sky = (torch.eye(2, dtype=torch.float64) / (0.1 * ARCSEC)).expand(2, 2, 2)
    truth = Parameters(torch.zeros(12, dtype=torch.float64), tensor(0.1, 0.1), own, tensor(0.0, 0.0, 0.0))
    frames = model.images(truth, sky)
    exposures = Exposures(frames, torch.full_like(frames, 10.0), torch.ones_like(frames, dtype=torch.bool), sky)
    return model, exposures, fit_companion(model, exposures)


def test_injected_companion_is_the_star_moved_and_dimmed(star):
    _, exposures, fit = star
    valid = exposures.valid.clone()
    valid[:, 12, 12] = False  # where the fit's own light stands in
    spoilt = Exposures(torch.where(valid, exposures.frames, 1e9), exposures.errors, valid, exposures.to_pixels)
    companion = tensor(0.1, 0.2 * ARCSEC, -0.3 * ARCSEC)  # whole pixels: y by 2, x by -3
    changed = inject_companion(spoilt, fit, companion)
    light = torch.where(valid, exposures.frames, fit.images) - fit.parameters.own[:, 1, None, None]
    rounding = 1e-12 * 1e9
    assert torch.allclose(changed.frames - spoilt.frames, 0.1 * light.roll((2, -3), (1, 2)), rtol=0, atol=rounding)
    assert changed.valid is valid


def test_injected_companions_are_found_again(star):
    """Without noise the search's raster is all that could lead a fit astray, and the field's border all that is wrong:
    light that leaves it enters on the other side."""
    model, exposures, fit = star
    like, records = tensor(0.1, 0.0, 0.25 * ARCSEC), []
    errors, rows = injection_errors(model, exposures, fit, like, 4, 0.1, records.append)
    assert errors.shape == (4, 3)
    assert [row["true_position_angle"] for row in rows] == pytest.approx([45, 135, 225, 315])
    assert [record.stage for record in records] == 4 * ["injection"]
    border = float(exposures.frames[:, [0, -1]].max() / exposures.frames.max())
    assert (errors[:, 0].abs() / 0.1).max() < border
    assert (errors[:, 1:].abs() / (0.25 * ARCSEC)).max() < border
    assert border < 0.05
    for row, error in zip(rows, errors, strict=True):
        assert row["separation"] == pytest.approx(250 + float(error[1]) / MAS, abs=0.1)


def test_fits_of_injected_companions_start_where_a_search_would_find_them(star, monkeypatch):
    """At the point of its raster nearest to the truth, not at the truth itself."""
    model, exposures, fit = star
    starts = []

    def found(model, injected, start, parameters):
        starts.append(start)
        return fit_of(start, torch.eye(3), start[None])

    monkeypatch.setattr(companion_errors, "fit_companion", found)
    like = tensor(0.1, 0.0, 0.25 * ARCSEC)
    injection_errors(model, exposures, fit, like, 5, 0.1)
    turns = 2 * math.pi * (torch.arange(5, dtype=torch.float64) + 0.5) / 5
    truth = 2.5 * torch.stack([turns.sin(), turns.cos()], 1)  # in steps of the raster
    places = torch.stack(starts)[:, 1:] / (0.1 * ARCSEC)
    torch.testing.assert_close(places, truth.round(), rtol=0, atol=1e-9)
    assert [float(start[0]) for start in starts] == 5 * [0.1]

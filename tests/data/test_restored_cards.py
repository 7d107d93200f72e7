"""The numbers in the header of a restored image are those of the restoration, each under its own name."""

import dataclasses
import math

import pytest
import torch

from torchmask.data.restored import save_restored
from torchmask.grid import Grid
from torchmask.observation import Observation
from torchmask.optics.aperture import SparseAperture
from torchmask.restoration.result import RestorationResult
from torchmask.restoration.verdict import Finding, Verdict

fits = pytest.importorskip("astropy.io.fits")

ARCSEC = math.pi / 180 / 3600


@pytest.fixture
def observation():
    """Five frames, of which number 13 has a tenth of the light of the others."""
    mask = SparseAperture([[0.0, 0.38], [0.33, -0.2], [-0.35, -0.15]], 0.2, 1.0)
    frames = torch.ones(5, 8, 8, dtype=torch.float64)
    frames[:, 3:6, 3:6] = 1e4
    frames[3, 3:6, 3:6] = 1e3
    return Observation(frames, mask, Grid(8, 0.02 * ARCSEC, 550e-9), 3.0, frame_numbers=(10, 11, 12, 13, 14))


@pytest.fixture
def result(observation):
    verdict = Verdict(Finding.EXPLAINED, 1.39, 300, 0.4, 1.8, 0.2, (0, 2), 5, "")
    rest = {name: torch.ones(5) for name in ("transmission", "model", "residuals", "cost")}
    return RestorationResult(
        object=torch.rand(8, 8, generator=torch.Generator().manual_seed(0), dtype=torch.float64),
        extended_object=torch.ones(2, 2),
        coefficients=torch.zeros(5, 3, 6),
        chi_square=torch.tensor([0.5, 0.6, 0.7, 0.8, 2.4], dtype=torch.float64),
        **rest,
        prior="TotalVariation()",
        r0=0.15,
        noise=2.5,
        converged=True,
        message="",
        n_evaluations=1,
        seconds=1.0,
        background=torch.full((8, 8), 0.75, dtype=torch.float64),
        verdict=verdict,
    )


def cards_of(path, result, observation):
    save_restored(path, result, observation)
    return fits.getheader(path)


def test_every_card_is_the_number_that_it_names(tmp_path, result, observation):
    cards = cards_of(tmp_path / "r.fits", result, observation)
    expected = {
        "WAVELEN": 550e-9,
        "PIXELSCL": 0.02,
        "NFRAMES": 5,
        "NHOLES": 3,
        "NMODES": 6,
        "CHISQ": 1.0,  # the mean, and not the median of 0.7
        "CHISQMAX": 2.4,
        "NOISE": 2.5,
        "SKY": 0.75,
        "R0": 0.15,
        "CONVERGD": True,
        "EXPLAIND": True,
        "CHISQDOF": 300,
        "CHISQRED": 1.39,
        "CHISQMOD": 0.4,
        "CHISQLIM": 1.8,
        "NLOST": 2,
        "NCLOUD": 1,
    }
    found = {name: cards[name] for name in expected}
    assert cards["CLOUDED"] == "13"
    assert found == {name: pytest.approx(value, rel=1e-12) for name, value in expected.items()}


def test_what_did_not_converge_or_is_not_explained_says_so(tmp_path, result, observation):
    doubtful = next(finding for finding in Finding if finding is not Finding.EXPLAINED)
    verdict = dataclasses.replace(result.verdict, finding=doubtful)
    worse = dataclasses.replace(result, converged=False, verdict=verdict)
    cards = cards_of(tmp_path / "r.fits", worse, observation)
    assert (cards["CONVERGD"], cards["EXPLAIND"], cards["VERDICT"]) == (False, False, doubtful.value)


def test_a_sky_that_was_not_fitted_is_no_measurement_of_0(tmp_path, result, observation):
    bare = dataclasses.replace(result, background=torch.zeros(5, dtype=torch.float64))
    assert "SKY" not in cards_of(tmp_path / "r.fits", bare, observation)


def test_the_numbers_of_many_clouded_frames_are_whole(tmp_path, result):
    """They fill more than one card."""
    frames = torch.ones(60, 8, 8, dtype=torch.float64)
    frames[:, 3:6, 3:6] = 1e4
    frames[::3, 3:6, 3:6] = 1e3
    numbers = tuple(range(100, 160))
    mask = SparseAperture([[0.0, 0.38], [0.33, -0.2], [-0.35, -0.15]], 0.2, 1.0)
    seen = Observation(frames, mask, Grid(8, 0.02 * ARCSEC, 550e-9), 3.0, frame_numbers=numbers)
    cards = cards_of(tmp_path / "r.fits", result, seen)
    assert cards["CLOUDED"] == ",".join(map(str, numbers[::3]))
    assert cards["NCLOUD"] == 20

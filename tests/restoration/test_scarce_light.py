"""What is said where light is scarce: standard deviations of what the prior has taken off, and noise measured."""

import re
import warnings

import pytest

from torchmask.restoration.result import RestorationResult
from torchmask.restoration.verdict import Finding, Verdict

SCARCE = "the frames show too little of the object for its standard deviations"


@pytest.mark.parametrize("n_photons", [1e3, 3e3])
def test_standard_deviations_of_scarce_light_come_with_a_warning(n_photons, observe, restoring, tmp_path):
    frames = observe(n_photons=n_photons).frames
    method = restoring(3, max_iterations=100)
    with pytest.warns(UserWarning, match=SCARCE) as told:
        result = method.restore(frames, n_samples=2)
    assert [one.filename for one in told] == [__file__]  # the line that asks for them
    assert result.verdict.is_scarce
    assert "check again with more light or more frames" in result.summary()
    result.save(tmp_path / "scarce.npz")
    assert RestorationResult.load(tmp_path / "scarce.npz").verdict.is_scarce
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert method.restore(frames).verdict.is_scarce  # nobody asks for standard deviations


def test_enough_light_or_known_aberrations_bring_no_warning(observe, restoring, restored):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        enough = restoring(3, max_iterations=100).restore(observe(n_photons=1e5).frames, n_samples=2)
        frames, known = observe(n_photons=3e3).frames, restored.coefficients
        told = restoring(max_iterations=100).restore(frames, coefficients=known, n_samples=2)
    for result in (enough, told):
        assert not result.verdict.is_scarce
        assert "more light" not in str(result.verdict)


def test_a_verdict_of_older_files_does_not_say_that_light_is_scarce():
    values = Verdict(Finding.EXPLAINED, 1.0, 1000, 0.0, 1.1, 0.0, (), 5, "").to_json()
    del values["is_scarce"]
    text = str(values).replace("'", '"').replace("True", "true").replace("()", "[]")
    assert not Verdict.from_json(text).is_scarce


def test_noise_that_was_measured_too_large_is_named_as_measured(observation, restoring, monkeypatch):
    """As by light that is cut off at the border. A read-out noise that was told is to be checked itself."""
    monkeypatch.setattr("torchmask.restoration.noise.noise_variance", lambda *given: 1e4)
    measured = restoring(3, readout_noise=None, max_iterations=200).restore(observation.frames).verdict
    monkeypatch.undo()
    with pytest.warns(UserWarning, match=re.escape("check the gain and readout_noise")):
        told = restoring(3, readout_noise=100.0, max_iterations=200).restore(observation.frames).verdict
    assert measured.finding is told.finding is Finding.TOO_MUCH_NOISE
    assert "tell readout_noise= or mark such pixels in valid=" in str(measured)
    assert "check read-out noise, gain and errors of pixels" in str(told)

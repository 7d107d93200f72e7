"""What counts as explained, and how a verdict reads and is kept."""

import json
import math
from statistics import NormalDist

import pytest
import torch

from torchmask.restoration.model_error import ModelError
from torchmask.restoration.noise import FrameNoise
from torchmask.restoration.verdict import Finding, FrameFits, Tolerance, Verdict, judge

PIXELS = 1000
ERROR = ModelError(excess=0.3, fitted=40.0, phase=0.2)


TOLERANCE = Tolerance(2.0, 2.0)


def verdict_on(
    *chi_square,
    contrast=50.0,
    tolerance=TOLERANCE,
    at_rest=True,
    blind=False,
    still=False,
    error=ERROR,
    **fits,
):
    n_frames = len(chi_square)
    told = {
        "chi_square": torch.tensor(chi_square, dtype=torch.float64),
        "pixels": torch.full((n_frames,), PIXELS),
        "transmission": torch.ones(n_frames),
        "noise": FrameNoise(torch.ones(n_frames), torch.ones(n_frames)),
        "parameters": 100.0,
    }
    return judge(FrameFits(**(told | fits)), contrast, error, tolerance, at_rest=at_rest, blind=blind, is_still=still)


def test_chi_square_is_over_its_degrees_of_freedom():
    verdict = verdict_on(1.0, 1.2)
    assert verdict.degrees_of_freedom == 2 * 960
    assert verdict.chi_square == pytest.approx(2.2 * 1000 / 1920)
    assert verdict.excess == pytest.approx(verdict.chi_square - 1)


def test_what_may_be_left_is_the_model_error_and_chance():
    limit = 1 + 2 * 0.3 + 2 * math.sqrt(2 / 1920)
    assert verdict_on(1.0, 1.0).limit == pytest.approx(limit)
    just = limit * 0.96  # per pixel
    assert verdict_on(just - 1e-6, just - 1e-6).finding is Finding.EXPLAINED
    assert verdict_on(just + 1e-6, just + 1e-6).finding is Finding.NOT_EXPLAINED
    assert verdict_on(3.0, 3.0, tolerance=Tolerance(2.0, 2.0, least=5.0)).explained


def test_pixels_that_are_not_valid_do_not_count():
    verdict = verdict_on(1.0, 9.0, pixels=torch.tensor([1000, 40]))
    assert verdict.degrees_of_freedom == 961  # a frame that tells nothing has one left
    assert verdict.chi_square == pytest.approx((1000 + 360) / 961)


def test_one_frame_alone_is_explained_by_many_objects():
    """So its user is told to look at others; where it is not explained, something else is amiss first."""
    verdict = verdict_on(1.0, blind=True)
    assert verdict.explained
    assert "check against other frames: one alone is explained by many objects" in str(verdict)
    assert verdict_on(1.0).check == ""
    assert "other frames" not in verdict_on(8.0, blind=True).check


def test_frames_that_do_not_change_tell_no_more_than_one():
    """Where light is scarce, which may hide the change, more of it is asked for instead."""
    seen = {"contrast": 1e3, "blind": True, "still": True}
    verdict = verdict_on(1.0, 1.0, **seen)
    assert verdict.explained
    assert "check against frames under other aberrations: these do not change" in str(verdict)
    assert verdict_on(1.0, 2.0, **seen).check.startswith(
        "those frames for clouds, tracking errors and a gradient of the sky, and then against"
    )
    for other in ({"still": False}, {"blind": False}, {"contrast": 30.0}):
        assert "do not change" not in verdict_on(1.0, 1.0, **(seen | other)).check
    assert "do not change" not in verdict_on(8.0, 8.0, **seen).check


def test_light_is_scarce_below_a_signal_to_noise_of_200():
    """That of the whole mean frame, unless object or aberrations are known, which leaves less to be told."""
    for contrast, scarce in ((1 + 199.9**2 / PIXELS, True), (1 + 200.1**2 / PIXELS, False)):
        assert verdict_on(1.0, 1.0, contrast=contrast, blind=True).is_scarce is scarce
        assert not verdict_on(1.0, 1.0, contrast=contrast).is_scarce
        few = torch.tensor([PIXELS, PIXELS // 2])  # the mean frame has as many as the frame with most of them
        assert verdict_on(1.0, 0.5, contrast=contrast, blind=True, pixels=few).is_scarce is scarce


def test_more_light_is_asked_for_where_it_is_scarce():
    """Before anything else that may be wrong, and also if what was found explains the frames, as many objects would."""
    more = "check again with more light or more frames, as these show too little of the object to tell it"
    scarce = {"contrast": 5.0, "blind": True}
    assert f"explained: {more}; chi-square" in str(verdict_on(1.0, 1.0, **scarce))
    assert f"not explained: no frame is explained; {more}, and then the mask" in str(verdict_on(8.0, 8.0, **scarce))
    lost = str(verdict_on(*[1.0] * 19, 8.0, **scarce))
    assert "a gradient of the sky" in lost
    assert f"explained as a whole, but frame 19 is not: {more}, and then those frames for clouds" in lost
    stopped = str(verdict_on(8.0, 8.0, at_rest=False, **scarce))
    assert f"{more}, and then again after more iterations, since this search was stopped early, and then the" in stopped
    assert f"{more}, and then the mask" in str(verdict_on(8.0, **scarce))  # a single frame
    assert verdict_on(1.0, 1.0, contrast=1.0, blind=True).check.startswith("the pointing")
    assert "light" not in str(verdict_on(8.0, 8.0, blind=True))


def test_a_search_that_was_stopped_early_says_so_whatever_it_has_found():
    again = "check again after more iterations, since this search was stopped early"
    assert str(verdict_on(1.0, 1.0, at_rest=False)).startswith(f"explained: {again}; chi-square")
    lost = str(verdict_on(*[1.0] * 19, 8.0, at_rest=False))
    assert lost.startswith(f"explained as a whole, but frame 19 is not: {again}, and then those frames for clouds")
    assert f"not explained: no frame is explained; {again}, and then the mask" in str(
        verdict_on(8.0, 8.0, at_rest=False)
    )
    assert "stopped" not in str(verdict_on(1.0, 1.0)) + str(verdict_on(8.0, 8.0))


def test_noise_that_was_measured_may_have_been_raised_by_what_is_none():
    """Nobody told a read-out noise that could be checked; any other finding stays as it is."""
    told = verdict_on(0.1, 0.1)
    assert told.finding is Finding.TOO_MUCH_NOISE
    measured = told.of_measured_noise()
    assert "check read-out noise, gain" in str(told)
    assert "check what was measured as noise in the frames: light that is cut off at their border" in str(measured)
    assert "cosmic rays and hot pixels raise it, so tell readout_noise= or mark such pixels in valid=" in str(measured)
    assert (measured.finding, measured.least) == (told.finding, told.least)
    for other in (verdict_on(1.0, 1.0), verdict_on(8.0, 8.0), verdict_on(1.0, 1.0, contrast=1.0)):
        assert other.of_measured_noise() is other


def test_single_frames_may_be_lost():
    verdict = verdict_on(*[1.0] * 19, 8.0)
    assert verdict.explained
    assert verdict.frames == (19,)
    assert str(verdict).startswith("explained as a whole, but frame 19 is not: check those frames for clouds")
    verdict = verdict_on(1.0, 8.0, 8.0, 1.0)
    assert not verdict.explained
    assert verdict.frames == (1, 2)
    assert "frames 1, 2 are not explained; check those frames" in str(verdict)


def test_a_frame_may_have_the_noise_of_its_own_light_and_the_model_error_of_its_brightness():
    """Limits of single frames: noise level + 2 E g^2 + z level (2 unevenness / free)^(1/2)."""
    transmission = torch.tensor([0.5, 1.0, 1.5, 1.0])
    noise = FrameNoise(torch.tensor([0.6, 1.0, 1.4, 1.0]), torch.tensor([1.0, 3.0, 2.0, 1.0]))
    z = NormalDist().inv_cdf(1 - 0.01 / 4)
    limits = noise.level + 2 * 0.3 * transmission**2 + z * noise.level * (2 * noise.unevenness / 960).sqrt()
    at_limit = 0.96 * limits  # per pixel
    for frame in range(4):
        for sign in (-1, 1):
            chi_square = at_limit - 1e-5
            chi_square[frame] += 1e-5 + sign * 1e-5
            found = verdict_on(*chi_square.tolist(), transmission=transmission, noise=noise)
            assert found.frames == ((frame,) if sign > 0 else ())
    deviations = noise.level * (2 * noise.unevenness / 960).sqrt()
    assert found.limit == pytest.approx(1.6 + 2 * float(deviations.square().mean().sqrt()) / 2, rel=1e-6)


def test_of_good_stacks_one_in_a_hundred_has_a_frame_that_is_named():
    """Chi-square of Gaussian noise over many pixels is normal: of 1500 stacks 15, which scatters by sqrt(15)."""
    generator = torch.Generator().manual_seed(3)
    pixels, error = torch.full((20,), 10**6), ModelError(0.0, 0.0, 0.0)
    draws = 1 + math.sqrt(2e-6) * torch.randn(1500, 20, dtype=torch.float64, generator=generator)
    named = sum(bool(verdict_on(*draw, pixels=pixels, error=error).frames) for draw in draws.tolist())
    assert abs(named - 15) < 4 * math.sqrt(15)  # some at least


def test_of_many_frames_it_is_the_instrument_that_is_to_be_checked():
    text = str(verdict_on(900.0, 800.0, 850.0))
    assert text.startswith("not explained: no frame is explained; check the mask")
    assert "chi-square is 885.4 over 2880 degrees of freedom" in text
    assert "0.2 rad rms" in text
    stopped = str(verdict_on(900.0, 800.0, at_rest=False))
    assert "check again after more iterations" in stopped
    assert "and then the mask" in stopped
    assert str(verdict_on(1.0, 1.0)).startswith("explained: ")
    assert "check" not in str(verdict_on(1.0, 1.0))


def test_frames_of_noise_alone_are_not_explained():
    noise = 1 + 4.9 * math.sqrt(2 / PIXELS)
    assert verdict_on(1.0, 1.0, contrast=noise).finding is Finding.ONLY_NOISE
    assert not verdict_on(1.0, 1.0, contrast=noise).explained
    assert "nothing but noise" in str(verdict_on(1.0, 1.0, contrast=noise))
    assert "counts as explained" not in str(verdict_on(1.0, 1.0, contrast=noise))
    assert verdict_on(1.0, 1.0, contrast=noise + 0.01).explained


def test_noise_that_the_frames_do_not_show_is_told():
    """100 parameters take 100 pixels of noise, or those of three times the noise where it is uneven."""
    for unevenness in (1.0, 3.0):
        noise = FrameNoise(torch.ones(2), torch.full((2,), unevenness))
        least = 1 - 100 * unevenness / 1920 - 5 * math.sqrt(2 * unevenness / 1920)
        at_least = 0.96 * least  # per pixel
        good = verdict_on(at_least + 1e-6, at_least + 1e-6, noise=noise)
        assert good.finding is Finding.EXPLAINED
        assert good.least == pytest.approx(least, rel=1e-9)
        told = verdict_on(at_least - 1e-6, at_least - 1e-6, noise=noise)
        assert told.finding is Finding.TOO_MUCH_NOISE
        assert not told.explained
    assert verdict_on(0.01, 0.01, contrast=0.01).finding is Finding.TOO_MUCH_NOISE  # which hides the object
    assert str(told).startswith("not judged, the frames show less noise than assumed: check read-out noise, gain")
    assert f"a fit leaves {least:.2g} at least if the noise is right" in str(told)
    assert verdict_on(0.01, 0.01, parameters=1900.0).least == 0  # so few frames do not tell
    assert verdict_on(0.01, 0.01, parameters=1900.0).explained


def test_noise_that_light_makes_uneven_does_not_make_a_good_fit_worse():
    noise = FrameNoise(torch.tensor([1.5, 1.7]), torch.ones(2))
    limit = 1.6 + 2 * 0.3 + 2 * math.hypot(1.5, 1.7) * math.sqrt(2 / 960) / 2
    assert verdict_on(1.5, 1.7, noise=noise).limit == pytest.approx(limit, rel=1e-6)


def test_it_is_kept_as_json():
    verdict = verdict_on(1.0, 8.0, 8.0, 1.0)
    values = verdict.to_json()
    assert (values["explained"], values["text"]) == (False, str(verdict))
    assert Verdict.from_json(json.dumps(values, allow_nan=False)) == verdict
    for wrong in ("", "3", "{}", json.dumps(values | {"finding": "OTHER"}), json.dumps(values | {"more": 1})):
        with pytest.raises(ValueError, match="there is no verdict in"):
            Verdict.from_json(wrong)


def test_frames_of_which_few_pixels_are_valid_do_not_tell_noise_from_an_object():
    """The contrast is that of the mean frame, which has as many pixels as the frame with the most of them."""
    pixels, few = torch.tensor([PIXELS, PIXELS // 4, PIXELS]), 5 * math.sqrt(2 / PIXELS)
    assert verdict_on(1.0, 1.0, 1.0, contrast=1 + 0.99 * few, pixels=pixels).finding is Finding.ONLY_NOISE
    assert verdict_on(1.0, 1.0, 1.0, contrast=1 + 1.01 * few, pixels=pixels).explained


def test_single_frames_may_leave_twice_the_least_that_a_stack_may():
    """Where that is more than the model error, times the square of their transmission."""
    tolerance, transmission = Tolerance(2.0, 2.0, least=0.5), torch.tensor([0.8, 1.2])
    noise = NormalDist().inv_cdf(1 - 0.01 / 2) * math.sqrt(2 / 960)
    limits = 0.96 * (1 + 2 * 0.5 * transmission.double() ** 2 + noise)  # per pixel
    for sign, frames in ((-1, ()), (1, (0, 1))):
        each = (limits + sign * 1e-6).tolist()
        assert verdict_on(*each, tolerance=tolerance, transmission=transmission).frames == frames


def test_parameters_take_the_noise_of_the_brightest_pixels():
    """Of the frame in which noise times its unevenness is largest."""
    noise = FrameNoise(torch.tensor([0.8, 1.2]), torch.tensor([1.0, 2.0]))
    chance = math.hypot(0.8, 1.2 * math.sqrt(2)) * math.sqrt(2 / 960) / 2
    assert verdict_on(1.0, 1.0, noise=noise).least == pytest.approx(1 - 100 * 2.4 / 1920 - 5 * chance, rel=1e-6)

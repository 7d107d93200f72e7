"""The numbers that a restoration writes and logs, against the arrays that they are of."""

import dataclasses

import pytest
import torch

from torchmask.cli.outcome import log_outcome, metrics, summarise_outcome
from torchmask.grid import Grid
from torchmask.metrics import relative_error, ssim
from torchmask.observation import Observation
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.pixel import SquarePixel
from torchmask.restoration.result import RestorationResult

SIDE, N_FRAMES = 32, 4
MASK = SparseAperture([[0.0, 0.2], [-0.2, -0.1], [0.2, -0.1]], 0.1, 0.6)  # narrower than what its grid samples


@pytest.fixture(scope="module")
def outcome():
    """An observation and a result of random numbers, all different."""
    generator = torch.Generator().manual_seed(0)

    def random(*shape):
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    frames = random(N_FRAMES, SIDE, SIDE)
    frames[:, 12:20, 12:20] += 1e3
    frames[2] *= 0.2  # as through a cloud
    grid = Grid.nyquist(1.0, 550e-9, SIDE)
    observation = Observation(frames, MASK, grid, 1.0, object=100 * random(SIDE, SIDE), frame_numbers=(5, 6, 8, 9))
    result = RestorationResult(
        object=100 * random(SIDE, SIDE),
        extended_object=random(SIDE + 4, SIDE + 4),
        coefficients=random(N_FRAMES, 3, 3),
        transmission=random(N_FRAMES),
        model=random(N_FRAMES, SIDE, SIDE),
        residuals=random(N_FRAMES, SIDE, SIDE),
        chi_square=random(N_FRAMES),
        prior="",
        r0=0.13,
        noise=1.7,
        cost=torch.tensor([5.0, 3.0, 2.0], dtype=torch.float64),
        converged=True,
        message="",
        n_evaluations=7,
        seconds=0.5,
        background=random(N_FRAMES),
        rotation=0.02,
        magnification=1.03,
        frame_numbers=(5, 6, 8, 9),
    )
    return observation, result


def test_scores_are_up_to_the_cut_off_of_the_mask_and_of_the_mean_frame(outcome):
    observation, result = outcome
    table, cutoff = metrics(observation, result), observation.grid.cutoff(0.6)
    assert cutoff == pytest.approx(0.3, rel=1e-12)  # of 1 m it is half a cycle per pixel
    assert table["score"] == relative_error(result.object, observation.object, cutoff)
    assert table["ssim"] == ssim(result.object, observation.object, cutoff)
    mean = observation.frames.sum(0) / N_FRAMES
    expected = relative_error(mean, observation.object, cutoff)
    assert table["mean_frame_score"] == pytest.approx(expected, rel=1e-12)
    unknown = metrics(dataclasses.replace(observation, object=None), result)
    assert not {"score", "ssim", "mean_frame_score"} & set(unknown)


def test_fit_light_and_search_are_summed_up(outcome):
    observation, result = outcome
    table = metrics(observation, result)
    fits = result.chi_square.tolist()
    assert table["chi_square"] == pytest.approx(sum(fits) / N_FRAMES, rel=1e-12)
    assert table["worst_frame_chi_square"] == max(fits)
    assert table["photons_per_frame"] == pytest.approx(float(result.object.flatten().sum()), rel=1e-12)
    assert (table["cost"], table["iterations"], table["evaluations"]) == (2.0, 3, 7)
    assert (table["noise"], table["r0"], table["rotation"], table["magnification"]) == (1.7, 0.13, 0.02, 1.03)
    assert table["sky"] == result.sky
    assert table["clouded_frames"] == [8]  # by the numbers of the files


def test_pixels_and_clouds_are_told_where_there_are_any(outcome):
    observation, result = outcome
    table = metrics(observation, result)
    assert table["pixel"] == "points"
    told = summarise_outcome(result, table)
    assert told.startswith("frames [8] have less than half the light of the others")
    assert "pixels:" not in told
    wide = metrics(dataclasses.replace(observation, pixel=SquarePixel(1.0)), result)
    clear = summarise_outcome(result, wide | {"clouded_frames": []})
    assert clear.startswith(f"pixels: {SquarePixel(1.0)}\n")


def test_that_no_sky_was_assumed_is_told_where_the_frames_decided_it(outcome):
    observation, result = outcome
    bare = dataclasses.replace(result, background=torch.zeros(N_FRAMES, dtype=torch.float64))
    table, told = metrics(observation, bare), "no sky was assumed: --sky per-frame fits one"
    *_, first, second, _, _, _ = summarise_outcome(bare, table, "if-seen").splitlines()
    assert first.startswith("restored ")
    assert second.startswith(told)
    for sky in ("none", "per-frame", 0.0):  # the user decided
        assert told not in summarise_outcome(bare, table, sky)
    assert told not in summarise_outcome(result, table, "if-seen")


def test_numbers_are_logged_each_by_its_name(outcome):
    pytest.importorskip("matplotlib")
    observation, result = outcome
    scalars, figures = {}, []

    class Logger:
        def scalar(self, name, value, step=None):
            scalars.setdefault(name, []).append(value)

        def figure(self, name, figure):
            figures.append(name)

        def __getattr__(self, name):
            return lambda *arguments, **keywords: None

    table = metrics(observation, result)
    log_outcome(observation, result, table, Logger(), "stack/")
    for name in ("score", "chi_square", "photons_per_frame"):
        assert scalars[f"summary/stack/{name}"] == [table[name]]
    assert {"stack/restored", "stack/comparison"} <= set(figures)

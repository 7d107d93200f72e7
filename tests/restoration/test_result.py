"""What a restoration hands back, on disk and for people."""

import dataclasses

import numpy as np
import pytest
import torch

from torchmask.restoration.result import RestorationResult


def test_result_survives_the_disk(restored, tmp_path):
    path = tmp_path / "result.npz"
    restored.save(path)
    again = RestorationResult.load(path)
    for item in dataclasses.fields(restored):
        one, other = getattr(restored, item.name), getattr(again, item.name)
        assert torch.equal(one, other) if isinstance(one, torch.Tensor) else one == other, item.name
    with pytest.raises(ValueError, match="not overwritten"):
        restored.save(path)
    np.savez(tmp_path / "foreign.npz", object=np.zeros(3))
    with pytest.raises(ValueError, match="has no"):
        RestorationResult.load(tmp_path / "foreign.npz")
    for words in ("48 x 48", "8 frames", "converged", "chi-square"):
        assert words in restored.summary()


def test_frames_have_the_numbers_that_they_are_given(restored):
    chi_square = torch.ones(8)
    chi_square[6] = 3.0
    verdict = dataclasses.replace(restored.verdict, frames=(2, 6), n_frames=8)
    seen = dataclasses.replace(restored, chi_square=chi_square, verdict=verdict)
    told = seen.with_frame_numbers(range(10, 18))
    assert "but frames 12, 16 are not" in told.summary()
    assert "worst frame 16: 3.000" in told.summary()
    assert told.verdict.to_json()["frames"] == (12, 16)
    back = told.with_frame_numbers(range(8))
    assert (back.verdict, back.frame_numbers) == (verdict, tuple(range(8)))
    with pytest.raises(ValueError, match="frame_numbers has 7 numbers for 8 frames"):
        seen.with_frame_numbers(range(7))


def test_a_summary_tells_the_change_of_pistons_against_their_mean_and_what_is_known_of_the_mask(restored):
    """A change of all holes alike, of tilts or of other modes is no change of pistons."""
    motion = torch.zeros(8, 5, 3, dtype=torch.float64)
    motion[..., 0] = 7.0 + torch.tensor([0.5, -0.5, 0.0, 0.0, 0.0])  # 0.1 on average, when squared
    motion[..., 1:] = 3.0
    told = dataclasses.replace(restored, motion=motion, rotation=0.01, magnification=1.02)
    told = dataclasses.replace(told, geometry_std=torch.tensor([0.002, 0.003])).summary()
    assert "pistons change by 0.32 rad rms while a frame lasts" in told
    assert "turned by 0.573 +- 0.115 deg from x to y and magnified by 1.02000 +- 0.00300" in told
    assert "the errors are those of noise, besides which frames of an object are off by some 0.1 deg and 0.3%" in told


def result_of_version_0_1(n_frames=2):
    """The arrays that 0.1.0 wrote, as numpy writes them: gains and a weight of total variation."""
    frames = np.random.default_rng(0).random((n_frames, 8, 8))
    return {
        "object": 100 * frames[0],
        "extended_object": np.ones((10, 10)),
        "coefficients": np.zeros((n_frames, 3, 4)),
        "gains": np.linspace(0.9, 1.1, n_frames),
        "model": frames,
        "residuals": frames - 0.5,
        "chi_square": np.linspace(1.0, 1.5, n_frames),
        "tv_weight": 0.5,
        "r0": 0.2,
        "noise": 21.3,
        "cost": np.array([3.0, 2.0, 1.5]),
        "converged": False,
        "message": "stopped at max_iterations = 3",
        "n_evaluations": 5,
        "seconds": 0.7,
    }


@pytest.mark.parametrize("deviations", [{}, {"object_std": np.ones((8, 8)), "coefficients_std": np.ones((3, 4))}])
def test_results_of_version_0_1_are_read(deviations, tmp_path):
    old = result_of_version_0_1() | deviations
    np.savez(tmp_path / "old.npz", **old)
    back = RestorationResult.load(tmp_path / "old.npz")
    same = old.keys() - {"gains", "tv_weight"}
    for name in same:
        found = getattr(back, name)
        assert np.array_equal(found.numpy(), old[name]) if isinstance(found, torch.Tensor) else found == old[name], name
    assert np.array_equal(back.transmission.numpy(), old["gains"])
    assert back.prior == "TotalVariation(weight=0.5, epsilon=0.01)"
    if not deviations:
        assert back.object_std is None
        assert back.coefficients_std is None
    assert "prior TotalVariation(weight=0.5" in back.summary()
    back.save(tmp_path / "new.npz")  # from now on under today's names
    again = np.load(tmp_path / "new.npz")
    assert "gains" not in again
    assert np.array_equal(again["transmission"], old["gains"])


@pytest.mark.parametrize("name", ["gains", "tv_weight", "object", "coefficients", "r0", "message", "seconds"])
def test_a_file_that_lacks_something_is_refused(name, tmp_path):
    old = result_of_version_0_1()
    np.savez(tmp_path / "old.npz", **{key: value for key, value in old.items() if key != name})
    with pytest.raises(ValueError, match=r"old\.npz has no"):
        RestorationResult.load(tmp_path / "old.npz")


def test_no_file_and_no_archive_are_refused(tmp_path):
    (tmp_path / "text.npz").write_text("not at all")
    for name in ("text.npz", "missing.npz"):
        with pytest.raises(ValueError, match=name):
            RestorationResult.load(tmp_path / name)

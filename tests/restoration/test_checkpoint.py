"""Restorations that are interrupted and go on, and to what a checkpoint belongs."""

import pytest
import torch

from torchmask.record import Record
from torchmask.restoration.myopic import MyopicDeconvolution


def test_interrupted_and_resumed_is_the_same(observation, restoring, tmp_path):
    method = restoring(max_iterations=250, tolerance=0)
    whole = method.restore(observation.frames)

    def interrupt(record: Record) -> None:
        if record.step == 150:
            raise KeyboardInterrupt

    path = tmp_path / "state.npz"
    with pytest.raises(KeyboardInterrupt):
        method.restore(observation.frames, checkpoint=path, callback=interrupt)
    steps = []
    resumed = method.restore(observation.frames, checkpoint=path, callback=lambda record: steps.append(record.step))
    assert steps[0] == 101
    assert torch.equal(resumed.object, whole.object)
    assert torch.equal(resumed.coefficients, whole.coefficients)
    assert torch.equal(resumed.cost, whole.cost)
    assert resumed.n_evaluations == whole.n_evaluations
    with pytest.raises(ValueError, match="other frames or settings"):
        method.restore(observation.frames * 1.1, checkpoint=path)
    spread = method.restore(observation.frames, checkpoint=path, n_samples=2)  # of what is there, without a step more
    assert torch.equal(spread.object, whole.object)
    assert torch.equal(spread.object_std, method.restore(observation.frames, checkpoint=path, n_samples=2).object_std)


def test_a_checkpoint_belongs_to_what_was_known(observation, restored, restoring, tmp_path):
    method = restoring(max_iterations=2)
    for number, name in enumerate(("known_object", "coefficients")):
        given = {"known_object": observation.object, "coefficients": restored.coefficients}[name]
        path = tmp_path / f"{number}.npz"
        result = method.restore(observation.frames, checkpoint=path, **{name: given})
        assert torch.equal(method.restore(observation.frames, checkpoint=path, **{name: given}).object, result.object)
        with pytest.raises(ValueError, match="other frames or settings"):
            method.restore(observation.frames, checkpoint=path, **{name: given.flip(1)})
    path = tmp_path / "open.npz"
    instrument = (observation.aperture, observation.grid)
    MyopicDeconvolution(*instrument, r0=None, max_iterations=2).restore(observation.frames, checkpoint=path)
    with pytest.raises(ValueError, match="other frames or settings"):  # the first guess, taken for known now
        MyopicDeconvolution(*instrument, r0=0.22, max_iterations=2).restore(observation.frames, checkpoint=path)

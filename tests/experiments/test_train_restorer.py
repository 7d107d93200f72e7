"""A small network that learns from simulated stacks: a tiny run, and that its input is the estimate it claims to be."""

import json

import pytest
import torch
import train_restorer
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from torchmask.io import load_npz


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "tiny"
    assert train_restorer.main(["--smoke", "--out", str(folder)]) == 0
    return folder


def test_the_network_beats_its_input_on_stacks_it_has_not_seen(finished):
    scores = json.loads((finished / "scores.json").read_text())
    assert scores["network"] < 0.9 * scores["Wiener"] < scores["mean frame"]
    assert scores["improved"] > 0.5  # of the stacks, of which few are held out


def test_the_run_folder_holds_log_figure_and_network(finished):
    assert (finished / "comparison.png").is_file()
    events = EventAccumulator(str(finished), size_guidance={"scalars": 0})
    events.Reload()
    loss = [event.value for event in events.Scalars("training/held_out_loss")]
    assert len(loss) == 40
    assert loss[-1] < 0.9 * loss[0]
    assert {"training/restored", "training/truth", "figures/comparison"} <= set(events.Tags()["images"])
    assert load_npz(finished / "checkpoints" / "training.npz")["restored"].shape == (32, 32)
    network = train_restorer.Restorer(8, 4)
    network.load_state_dict(torch.load(finished / "network.pt", weights_only=True))
    assert any(bool(values.any()) for values in network.layers[-1].parameters())


def test_an_untrained_network_returns_the_linear_estimate():
    images = torch.rand(3, 2, 16, 16)
    assert torch.equal(train_restorer.Restorer(8, 3)(images), images[:, :1])


def test_without_blur_and_with_much_light_the_linear_estimate_is_the_truth():
    generator = torch.Generator().manual_seed(0)
    truth = 1e9 * torch.rand(6, 16, 16, generator=generator)
    psfs = torch.zeros(6, 2, 16, 16)
    psfs[..., 8, 8] = 1
    data = {
        "frames": truth[:, None].expand(6, 2, 16, 16),
        "object": truth,
        "psfs": psfs,
        "n_photons": truth.sum((1, 2)),
    }
    images, targets = train_restorer.linear_restorations(data, 4, cutoff=0.8)  # all frequencies pass
    # S_n / S_o is 1e-9 at most, so float32 rounding remains
    torch.testing.assert_close(images[:, :1], targets, rtol=0, atol=1e-5)
    torch.testing.assert_close(images[:, 1:], targets, rtol=0, atol=1e-5)


def test_turning_keeps_pairs_together():
    image = torch.rand(2, 1, 8, 8)
    generator = torch.Generator().manual_seed(0)
    seen = set()
    for _ in range(60):
        turned, target = train_restorer.turned(torch.cat([image, image], dim=1), image, generator)
        assert torch.equal(turned[:, :1], target)
        seen.add(tuple(target.flatten().tolist()))
    assert len(seen) == 8


def test_an_existing_folder_is_refused(finished, capsys):
    assert train_restorer.main(["--smoke", "--out", str(finished)]) == 1
    assert "tiny-2" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--mask", "none"], "no mask is called 'none'"),
        (["--fill-factor", "0"], "--fill-factor is 0.0"),
        (["--ranges.r0", "-1", "2"], "--ranges.r0 is (-1.0, 2.0)"),
        (["--n-train", "0"], "--n-train is 0"),
        (["--depth", "1"], "--depth is 1"),
        (["--workers", "-1"], "--workers is -1"),
    ],
)
def test_a_bad_setting_is_one_line_and_leaves_nothing(tmp_path, capsys, options, message):
    assert train_restorer.main([*options, "--out", str(tmp_path / "new" / "run")]) == 1
    err = capsys.readouterr().err
    assert err.startswith(f"train_restorer: error: {message}")
    assert err.count("\n") == 1
    assert not list(tmp_path.iterdir())

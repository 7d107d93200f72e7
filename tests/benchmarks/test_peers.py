"""The side-by-side benchmark: that each peer is used as it should be, and that the table says what was measured."""

import dataclasses
import json
import logging
from importlib.metadata import PackageNotFoundError

import numpy as np
import peer_methods
import peer_mfbd
import peers
import pytest
import torch

from torchmask.grid import Grid
from torchmask.metrics import relative_error
from torchmask.optics.aperture import FullAperture
from torchmask.restoration.myopic import MyopicDeconvolution
from torchmask.restoration.recipe import FULL_MODES
from torchmask.simulation.scene import SceneOptions, make_scene

GRID = Grid.nyquist(1.0, 550e-9, 48)


@pytest.fixture(scope="module")
def observation(observe_satellite):
    return observe_satellite(FullAperture(0.95), GRID, d_over_r0=3.0, n_frames=8)


def best_score(candidates, observation):
    return min(relative_error(candidate.image, observation.object, 0.5) for candidate in candidates)


@pytest.mark.parametrize("method", ["richardson_lucy", "unsupervised_wiener", "known_psfs"])
def test_each_deconvolution_improves_on_shift_and_add(observation, method):
    effort = peer_methods.Effort()
    before = best_score(peer_methods.added(observation, effort), observation)
    assert best_score(getattr(peer_methods, method)(observation, effort), observation) < 0.8 * before


def test_plain_descent_improves_on_shift_and_add_with_its_iterations(observation, monkeypatch):
    monkeypatch.setattr(peer_methods, "_PLAIN_SETTINGS", ((10.0, 10),))
    before = best_score(peer_methods.added(observation, peer_methods.Effort()), observation)
    few, more = (
        best_score(peer_methods.plain_lbfgs(observation, peer_methods.Effort(iterations=count)), observation)
        for count in (20, 100)
    )
    assert more < 0.8 * few
    assert more < 0.8 * before


def test_the_limit_is_ahead_of_every_peer(observation):
    effort = peer_methods.Effort()
    names = ("added", "richardson_lucy", "unsupervised_wiener")
    scores = [best_score(getattr(peer_methods, name)(observation, effort), observation) for name in names]
    assert best_score(peer_methods.known_psfs(observation, effort), observation) < min(scores)


def test_torchmfbd_restores_and_leaves_nothing_behind(observation, tmp_path, monkeypatch, capsys):
    pytest.importorskip("torchmfbd")
    monkeypatch.chdir(tmp_path)
    state, disabled = torch.get_rng_state(), logging.root.manager.disable
    monkeypatch.setattr(peer_methods, "MFBD_SETTINGS", (peer_mfbd.MFBDSettings(20, 0.1, 1e-3),))
    candidates = list(peer_methods.mfbd(observation, peer_methods.Effort(mfbd_iterations=60, mfbd_starts=1)))
    assert len(candidates) == len(peer_mfbd.CUTOFFS)
    added = best_score(peer_methods.added(observation, peer_methods.Effort()), observation)
    assert best_score(candidates, observation) < 0.8 * added
    assert torch.equal(torch.get_rng_state(), state)
    assert logging.root.manager.disable == disabled
    assert torch.get_default_dtype() == torch.float32
    assert list(tmp_path.iterdir()) == []
    assert capsys.readouterr() == ("", "")


def test_torchmfbd_gets_the_telescope_in_its_own_units(observation, monkeypatch):
    torchmfbd = pytest.importorskip("torchmfbd")
    from torchmfbd.util import psf_scale

    class Seen(Exception):
        pass

    def look(config):
        raise Seen(config)

    monkeypatch.setattr(torchmfbd, "Deconvolution", look)
    with pytest.raises(Seen) as caught:
        peer_mfbd.run_start(observation, peer_mfbd.MFBD_SETTINGS[0], 1)
    config = caught.value.args[0]
    scale = psf_scale(config["object1"]["wavelength"], config["telescope"]["diameter"], config["images"]["pix_size"])
    # How many times the diameter the pupil plane is wide: wavelength / (pixel_scale D), 2 / 0.95 here.
    assert scale == pytest.approx(2 / 0.95, rel=1e-12)


def test_the_loss_of_torchmfbd_falls_as_it_iterates(observation):
    pytest.importorskip("torchmfbd")
    settings = peer_mfbd.MFBDSettings(20, 0.1, 1e-3)
    short, long = (peer_mfbd.best_start(observation, settings, iterations, 1) for iterations in (10, 60))
    assert 0 < long.loss < 0.5 * short.loss


@pytest.mark.parametrize("n_starts", [1, 2, 4])
def test_the_start_of_torchmfbd_is_kept_by_its_own_loss(observation, monkeypatch, n_starts):
    """Also where the truth is found by the start of the highest loss."""
    losses, drawn = [0.4, 0.3, 0.1, 0.2], []

    def start(observation, settings, iterations):
        drawn.append(float(torch.rand(())))
        loss = losses[(len(drawn) - 1) % n_starts]
        worse = torch.rand(observation.grid.shape, dtype=torch.float64)
        return peer_mfbd.MFBDStart(loss, {0.9: observation.object if loss == 0.4 and n_starts > 1 else loss * worse})

    monkeypatch.setattr(peer_mfbd, "run_start", start)
    effort = peer_methods.Effort(mfbd_iterations=7, mfbd_starts=n_starts)
    candidates = list(peer_methods.mfbd(observation, effort))
    assert len(candidates) == len(peer_mfbd.MFBD_SETTINGS)
    for candidate in candidates:
        assert float(candidate.image.max()) == pytest.approx(min(losses[:n_starts]), rel=0.01)
        assert f"of {n_starts} starts that of the lowest loss" in candidate.settings
    assert len(drawn) == n_starts * len(peer_mfbd.MFBD_SETTINGS)
    assert len(set(drawn)) == n_starts  # every start is another one, the same ones for all settings


def test_torchmfbd_gets_as_many_modes_as_this_library():
    assert FULL_MODES - 1 in {settings.n_modes for settings in peer_mfbd.MFBD_SETTINGS}  # its own are without piston


@pytest.mark.parametrize("name", ["satellite_mask", "satellite_full"])
def test_plain_descent_begins_at_the_mean_frame_with_zero_aberrations(monkeypatch, name):
    class Seen(Exception):
        pass

    def look(cost, start, *, bounds, method, options, jac):
        assert jac
        raise Seen(cost, start, bounds, method, options)

    monkeypatch.setattr(peer_methods, "minimize", look)
    stack = peers.simulated(smoke=True)[name]
    with pytest.raises(Seen) as caught:
        list(peer_methods.plain_lbfgs(stack, peer_methods.Effort()))
    cost, start, bounds, method, options = caught.value.args
    assert method == "L-BFGS-B"
    assert options["maxiter"] == 1000
    n_modes = 66 if stack.aperture.is_full else 6 * stack.aperture.n_subapertures
    n_aberrations = len(stack.frames) * (n_modes - 1)  # the piston of a whole frame does not show
    n_pixels = len(start) - n_aberrations
    assert bounds == [(0.0, None)] * n_pixels + [(None, None)] * n_aberrations
    assert (start[n_pixels:] == 0).all()
    window = MyopicDeconvolution(stack.aperture, stack.grid, 6).model.window
    image = window.crop(torch.from_numpy(start[:n_pixels]).view(window.field.shape))
    mean = stack.frames.double().mean(0).clamp(min=0)
    assert float((image * mean).sum() / image.norm() / mean.norm()) > 0.999  # but for the frames' own light
    # The gradient is that of the cost, in the very units of the minimiser.
    rng = np.random.default_rng(0)
    point = start + rng.random(start.shape) * np.where(np.arange(len(start)) < n_pixels, start.max(), 0.1)
    way = rng.standard_normal(start.shape) * np.where(np.arange(len(start)) < n_pixels, start.max(), 1.0)
    slope = (cost(point + 1e-5 * way)[0] - cost(point - 1e-5 * way)[0]) / 2e-5
    assert slope == pytest.approx(cost(point)[1] @ way, rel=1e-5)


def test_torchmfbd_is_not_asked_to_model_a_mask():
    stack = peers.simulated(smoke=True)["satellite_mask"]
    assert list(peer_methods.mfbd(stack, peer_methods.Effort())) == []


def test_a_peer_gets_the_best_of_its_candidates_and_of_clipping():
    truth = make_scene((48, 48), 1e4, SceneOptions(size=0.5))
    noise = torch.randn(48, 48, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    images = {"worse": truth + 20 * noise, "better": truth + 5 * noise}
    candidates = [peer_methods.Candidate(name, image, 1.0) for name, image in images.items()]
    row = peers.best("peer", iter(candidates), truth, 0.5)
    assert row["settings"] == "better"
    assert (
        row["score"]
        == relative_error(images["better"].clamp(min=0), truth, 0.5)
        < relative_error(images["better"], truth, 0.5)
    )
    assert peers.best("peer", iter([]), truth, 0.5) is None


def test_the_lead_leaves_out_who_knows_the_psfs():
    scores = {peers.OURS: 0.1, "torchmfbd": 0.2, "shift-and-add": 0.4, peers.LIMIT: 0.05}
    rows = [{"stack": "s", "method": name, "score": value} for name, value in scores.items()]
    lead = peers.lead(rows)
    assert lead["best_peer"] == "torchmfbd"
    assert (lead["lead"], lead["over_limit"]) == (pytest.approx(2.0), pytest.approx(2.0))


def test_versions_are_those_of_everything_that_is_compared():
    pytest.importorskip("torchmfbd")
    assert set(peers.versions()) == {"torchmask", "torchmfbd", "scikit-image", "torch", "numpy", "scipy"}


def test_the_table_holds_every_method_with_versions(tmp_path, monkeypatch, capsys):
    """With a stand-in for torchmfbd, which need not be installed."""

    def full_pupils(observation, effort):
        if observation.aperture.n_subapertures == 1:
            yield peer_methods.Candidate("mean", observation.frames.mean(0), 0.0)

    monkeypatch.setitem(peers.METHODS, "torchmfbd", full_pupils)
    monkeypatch.setattr(peers, "versions", lambda: {"torchmask": "1.2.3", "torchmfbd": "4.5.6"})
    argv = ["--smoke", "--out", str(tmp_path / "peers")]
    assert peers.main(argv) == 0
    record = json.loads((tmp_path / "peers" / "peers.json").read_text())
    found = {(row["stack"], row["method"]) for row in record["rows"]}
    everything = {(stack, method) for stack in ("satellite_mask", "satellite_full") for method in peers.METHODS}
    assert everything - found == {("satellite_mask", "torchmfbd")}
    assert all(0 < row["score"] < 1 and row["seconds"] >= 0 for row in record["rows"])
    text = (tmp_path / "peers" / "peers.md").read_text()
    assert text in capsys.readouterr().out
    assert "torchmask 1.2.3, torchmfbd 4.5.6; " in text
    assert peers.main(argv) == 1  # nothing is overwritten
    assert "exists" in capsys.readouterr().err


def test_a_missing_package_or_truth_is_one_line_before_any_work(observation, tmp_path, monkeypatch, capsys):
    path = tmp_path / "blind.npz"
    dataclasses.replace(observation, object=None, psfs=None).save(path)
    monkeypatch.setattr(peers, "versions", dict)
    assert peers.main([str(path), "--out", str(tmp_path / "new")]) == 1
    assert "lacks object, psfs" in capsys.readouterr().err
    monkeypatch.undo()

    def missing(name):
        raise PackageNotFoundError(name)

    monkeypatch.setattr(peers, "version", missing)
    assert peers.main(["--out", str(tmp_path / "new")]) == 1
    assert "torchmask[bench]" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()

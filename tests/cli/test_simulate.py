"""`torchmask simulate` with all that a telescope adds, in the units of its options, and what it refuses."""

import dataclasses
import math
import re

import pytest
import torch

from torchmask.atmosphere.profiles import named_layers
from torchmask.cli.main import main
from torchmask.cli.simulate import ConditionOptions, Options, TurbulenceOptions
from torchmask.design.manufacture import save_json
from torchmask.grid import ARCSEC
from torchmask.observation import Observation
from torchmask.optics.aperture import SparseAperture
from torchmask.tracking import RunLogger

pytestmark = pytest.mark.usefixtures("coarse_figures")

MASK = ["simulate", "--mask", "golay6", "--mask-diameter", "1", "--fill-factor", "0.15"]
MASK += ["--wavelength", "550e-9"]
FINE_ENOUGH = 0.99 * 550e-9 / (2 * SparseAperture.from_catalog("golay6", 1.0, 0.15).extent) / ARCSEC  # at 550 nm alone
SMALL = ["--n-pixels", "16", "--n-frames", "2", "--scene.size", "0.4"]


def test_all_effects_at_once_leave_their_truths_in_the_stack(tmp_path, capsys):
    turbulence = ["--r0", "0.2", "--turbulence.profile", "hv57", "--turbulence.layers", "2"]
    turbulence += ["--turbulence.frame-interval", "0.01", "--turbulence.exposure-time", "0.001"]
    conditions = ["--conditions.sky", "40", "--conditions.transparency-scatter", "0.2"]
    conditions += ["--conditions.band-width", "5e-8", "--conditions.n-wavelengths", "2"]
    conditions += ["--pixel-fill", "0.9", "--n-photons", "1e5"]
    conditions += ["--true-mask.rotation-deg", "90", "--true-mask.magnification", "0.99"]
    assert main([*MASK, *SMALL, *turbulence, *conditions, "--out", str(tmp_path / "run")]) == 0
    stack = Observation.load(tmp_path / "run/stack.npz")
    assert stack.background == 40.0
    assert stack.transmission.shape == (2,)
    assert float(stack.transmission.std()) > 0
    assert stack.r0 == pytest.approx(0.2)
    # Nyquist at the shorter of two wavelengths, Gauss and Legendre's
    shortest = 550e-9 - 25e-9 / 3**0.5
    assert stack.grid.wavelength == 550e-9
    assert stack.grid.pixel_scale == pytest.approx(shortest / 2, rel=1e-9)
    told, true = stack.aperture, stack.true_aperture
    turned = 0.99 * torch.stack([-told.centers[:, 1], told.centers[:, 0]], dim=-1)
    torch.testing.assert_close(true.centers, turned)
    assert true.subaperture_diameter == pytest.approx(0.99 * told.subaperture_diameter)
    out = capsys.readouterr().out
    assert "| theta0 |" in out
    assert "% of the light inside the field" in out


def test_options_are_the_turbulence_that_they_name():
    hv57 = named_layers("hv57", 3)
    as_it_is = TurbulenceOptions("hv57", 3).make(Options.r0, 550e-9, 20.0)
    assert as_it_is.layers == hv57
    stronger = TurbulenceOptions("hv57", 3, (3.0, 4.0)).make(0.05, 550e-9, 20.0)
    assert stronger.r0 == pytest.approx(0.05)
    assert stronger.layers.heights == hv57.heights
    assert stronger.layers.winds == ((3.0, 4.0),) * 3
    assert TurbulenceOptions().make(Options.r0, 550e-9, 20.0).r0 == 0.15
    assert TurbulenceOptions().make(math.inf, 550e-9, 20.0) is None
    assert TurbulenceOptions("hv57", 3).make(math.inf, 550e-9, 20.0) is None
    wind = TurbulenceOptions(wind=(3.0, 4.0), frame_interval=0.02).make(0.1, 550e-9, 20.0)
    assert (wind.layers.heights, wind.frame_interval) == ((0.0,), 0.02)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--conditions.sky", "-1"], r"sky is -1\.0: it must be finite and at least 0"),
        (["--turbulence.exposure-time", "-0.1"], r"--turbulence.exposure-time is -0\.1: .* in s"),
        (["--turbulence.exposure-time", "0.1"], "--turbulence.exposure-time needs --turbulence.wind"),
        (["--turbulence.profile", "hv58"], "profile 'hv58' is unknown: known ones are hv57, las_campanas, mauna_kea"),
        (["--turbulence.frame-interval", "0.1"], "--turbulence.frame-interval needs --turbulence.wind"),
        (
            ["--conditions.temperature", "3000"],
            r"--conditions.temperature is that of light in a band: give --conditions",
        ),
        (["--conditions.band-width", "-1e-9"], r"--conditions.band-width is -1e-09: it must be at least 0 m"),
        (["--conditions.band-width", "8e-8", "--pixel-scale-arcsec", f"{FINE_ENOUGH:.6f}"], r"undersamples .* 5\.1\d"),
        (["--pixel-scale-arcsec", "0"], "--pixel-scale-arcsec is 0: it must be finite and positive, in arcsec"),
        (["--pixel-scale-arcsec", "0.5"], r"--pixel-scale-arcsec 0\.5 arcsec undersamples .* at most 0\.06\d+ arcsec"),
        (["--scene.path", "none.png"], "none.png"),
        (["--pixel-fill", "1.5"], r"--pixel-fill is 1\.5"),
        (["--pixel-fill", "2"], r"--pixel-fill is 2\.0"),  # as is --n-frames
        (["--seed", str(2**63)], f"--seed is {2**63}: it must be a whole number from 0 to {2**63 - 1}"),
        (["--seed", str(-(10**20))], "--seed is -1"),
        (["--n-photons", "1e30"], r"--n-photons is 1e\+30: .* at most 1e\+15 electrons per frame"),
        (["--n-photons", "-1"], r"--n-photons is -1\.0: it must be finite and positive"),
        (["--mask-diameter", "8200"], r"--mask-diameter is 8200\.0: .* in m, so 8\.2 m are 8\.2"),
        (["--jitter", "-1"], r"--jitter is -1\.0"),
        (["--jitter", "9"], r"--jitter is 9\.0: .* at most 8 pixels, half the field"),
        (["--turbulence.wind", "800", "0"], r"--turbulence\.wind is 800\.0: .* the nearest possible is 200 m/s"),
        (["--true-mask.magnification", "0"], "--true-mask.magnification is"),
    ],
)
def test_what_cannot_be_is_one_line_and_leaves_nothing(tmp_path, capsys, options, message):
    assert main([*MASK, *SMALL, *options, "--out", str(tmp_path / "new" / "run")]) == 1
    err = capsys.readouterr().err
    assert err.startswith("torchmask simulate: error: ")
    assert err.count("\n") == 1
    assert re.search(message, err), err
    assert not list(tmp_path.iterdir())


def test_vanes_without_a_width_are_told_which_option_is_missing(tmp_path, capsys):
    full = ["simulate", "--mask", "full", "--mask-diameter", "1", "--wavelength", "550e-9", *SMALL]
    assert main([*full, "--vane-angles", "0", "90", "--out", str(tmp_path / "run")]) == 1
    assert "--vane-width is 0 m and --vane-angles are [0.0, 90.0] degrees" in capsys.readouterr().err


def test_the_largest_seed_and_the_most_photons_are_simulated(tmp_path):
    most = ["--seed", str(2**63 - 1), "--n-photons", "1e15"]
    assert main([*MASK, *SMALL, *most, "--out", str(tmp_path / "run")]) == 0
    assert float(Observation.load(tmp_path / "run/stack.npz").frames.min()) >= 0


def test_the_defaults_are_what_they_were(tmp_path):
    assert main([*MASK, *SMALL, "--seed", "3", "--out", str(tmp_path / "run")]) == 0
    stack = Observation.load(tmp_path / "run/stack.npz")
    assert stack.background == 0
    assert torch.equal(stack.transmission, torch.ones(2, dtype=stack.transmission.dtype))


def test_the_wavelength_is_the_masks_unless_another_is_given(tmp_path, capsys):
    mask = SparseAperture.from_catalog("golay6", 1.0, 0.15)
    save_json(tmp_path / "mask.json", mask, 633e-9)
    save_json(tmp_path / "old.json", mask)
    simulate = ["simulate", *SMALL, "--mask"]
    assert main([*simulate, str(tmp_path / "mask.json"), "--out", str(tmp_path / "run")]) == 0
    assert Observation.load(tmp_path / "run/stack.npz").grid.wavelength == 633e-9
    given = ["--wavelength", "1e-6", "--out", str(tmp_path / "other")]
    assert main([*simulate, str(tmp_path / "mask.json"), *given]) == 0
    assert Observation.load(tmp_path / "other/stack.npz").grid.wavelength == 1e-6
    for mask_without in (str(tmp_path / "old.json"), "keck_nirc2_9"):
        capsys.readouterr()
        assert main([*simulate, mask_without, "--out", str(tmp_path / "new")]) == 1
        said = f"--wavelength is missing: give it in m, such as 550e-9. --mask {mask_without} has none"
        assert said in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


def test_a_filter_gives_the_band_and_without_a_wavelength_its_mean(tmp_path):
    curve = tmp_path / "filter.txt"
    curve.write_text("# even\n5e-7 1\n6e-7, 1\n")
    golay = MASK[:-2]
    conditions = ["--conditions.filter", str(curve), "--conditions.n-wavelengths", "2"]
    assert main([*golay, *SMALL, *conditions, "--out", str(tmp_path / "by_filter")]) == 0
    stack = Observation.load(tmp_path / "by_filter/stack.npz")
    even = ["--conditions.band-width", "1e-7", "--conditions.n-wavelengths", "2"]
    assert main([*MASK, *SMALL, *even, "--out", str(tmp_path / "by_width")]) == 0
    assert stack.grid.wavelength == pytest.approx(550e-9, rel=1e-12)
    torch.testing.assert_close(stack.frames, Observation.load(tmp_path / "by_width/stack.npz").frames)


@pytest.mark.parametrize("band", [{"band_width": 600e-9}, {"filter": "bessell-V", "n_wavelengths": 2}])
def test_few_wavelengths_of_a_band_are_warned_of(band):
    with pytest.warns(UserWarning, match="n_wavelengths is .* for a band .* wavelengths do"):
        ConditionOptions(**band).make(0.0, 550e-9)


def test_the_figure_without_turbulence_is_of_the_same_light_and_pixels(tmp_path, monkeypatch):
    drawn = {}

    def keep(self, name, figure):
        drawn[name] = {line.get_label(): line.get_ydata() for line in figure.axes[-2].lines} if "mtf" in name else {}

    monkeypatch.setattr(RunLogger, "figure", keep)
    broad = ["--conditions.band-width", "2e-7", "--conditions.n-wavelengths", "4", "--r0", "inf", "--pixel-fill", "0.9"]
    turned = ["--true-mask.rotation-deg", "20"]
    assert main([*MASK, *SMALL, "--n-pixels", "64", *broad, *turned, "--out", str(tmp_path / "run")]) == 0
    still, exposed = (drawn["observation/mtf"][name][1:] for name in ("no turbulence", "exposures"))
    assert exposed == pytest.approx(still, abs=0.01)  # but at 0, which light outside the field lacks


def test_the_scene_has_the_size_of_the_instruments_target(recorded):
    for size, share in ((0.5, 0.5 * ARCSEC / recorded.field_of_view), (None, 0.7)):
        known = dataclasses.replace(recorded, source=dataclasses.replace(recorded.source, size=size))
        assert Options.of_instrument(known).scene.size == pytest.approx(share, rel=1e-12)
    for size in (30.0, 3e-6):  # neither fits
        with pytest.warns(UserWarning, match="source.size"):
            known = dataclasses.replace(recorded, source=dataclasses.replace(recorded.source, size=size))
        assert Options.of_instrument(known).scene.size == 0.7


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--conditions.filter", "bessell-Q"], "of bessell they are bessell-U"),
        (["--conditions.filter", "bessell-V", "--conditions.band-width", "1e-8"], "both given: give only one"),
        (["--conditions.filter", "twomass-Ks"], "and not the wavelength 5.5e-07 m"),
    ],
)
def test_filters_that_are_none_or_elsewhere_are_refused(options, said, tmp_path, capsys):
    assert main([*MASK, *SMALL, *options, "--out", str(tmp_path / "run")]) == 1
    assert said in capsys.readouterr().err

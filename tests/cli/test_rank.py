"""torchmask rank: masks of the catalogue and of files, on one telescope."""

import json
import math

import pytest

from torchmask.cli.main import main
from torchmask.cli.rank import Options, name_masks, patterns
from torchmask.design.manufacture import load_mask, save_fits, save_json
from torchmask.design.pattern import Pattern
from torchmask.design.ranking import rank_masks
from torchmask.design.turbulent import TurbulentMSE
from torchmask.grid import ARCSEC, Grid
from torchmask.optics.aperture import SparseAperture
from torchmask.viz.ranking import ranking_figure

TINY = ["--n-frequencies", "32", "--budget", "60"]


def observed(options):
    return options.observation(options.n_frequencies, options.fill_factor)


def test_masks_of_catalogue_files_and_searches_are_ranked(tmp_path, capsys):
    mine = SparseAperture.from_catalog("golay6", 2.0, 0.05)
    save_json(tmp_path / "mine.json", mine)
    masks = ["golay9", "keck_lws_pattern2a_9", str(tmp_path / "mine.json")]
    assert main(["rank", *masks, "--search", "6", *TINY, "--fill-factor", "0.1", "--out", str(tmp_path / "run")]) == 0
    written = json.loads((tmp_path / "run/ranking.json").read_text())
    rows = {(row["mask"], row["layout"]): row for row in written["rows"]}
    assert set(rows) == {
        ("golay9", "laid afresh"),
        ("keck_lws_pattern2a_9", "laid afresh"),
        ("mine", "laid afresh"),
        ("mine", "as built"),
        ("torchmask_6", "searched"),
    }
    assert rows["mine", "as built"]["area"] == pytest.approx(float(mine.area) / 4, rel=1e-12)
    own = load_mask(tmp_path / "run/torchmask_6.json")
    criterion = observed(Options(n_frequencies=32, fill_factor=0.1)).criterion()
    assert rows["torchmask_6", "searched"]["relative_mse"] == pytest.approx(float(criterion.relative(own)), rel=1e-9)
    assert (tmp_path / "run/ranking.png").read_bytes().startswith(b"\x89PNG")
    events = [path.parent for path in (tmp_path / "run").rglob("events.*")]
    assert events == [tmp_path / "run"]  # one run in TensorBoard, in one folder
    said = capsys.readouterr().out
    assert "not ranked: keck_lws_pattern2a_9, as built: 3 pairs of holes overlap" in said
    assert "give --allow-overlap to accept it" in said
    assert "not ranked: golay9, as built: it has no size of its own" in said


def test_what_is_not_ranked_is_told_in_words_of_the_command_line(tmp_path, capsys):
    words = ["golay6", "vlt_sphere_irdis_7", "vlt_naco_7", "--min-gap", "0.12", "--fill-factor", "0.03"]
    assert main(["rank", *words, *TINY, "--out", str(tmp_path / "run")]) == 0
    said = capsys.readouterr().out
    assert "not ranked: vlt_sphere_irdis_7, as built: no source gives the diameter of its holes" in said
    assert "not ranked: vlt_naco_7, as built: --min-gap 0.12 is broken by" in said
    assert "as built: no source gives" in (tmp_path / "run/ranking.md").read_text()


def test_masks_are_named_by_their_folders_where_their_files_are_named_alike(tmp_path):
    files = ["one/mask.json", "other/mask.json", "a/other/mask.json", "mine.json", "golay6.json"]
    for file in files:
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        save_json(tmp_path / file, SparseAperture.from_catalog("golay6", 2.0, 0.05))
    paths = [str(tmp_path / file) for file in files]
    named = name_masks([*paths, "golay-6"])
    here = tmp_path.name
    assert named == ["one/mask", f"{here}/other/mask", "a/other/mask", "mine", f"{here}/golay6", "golay6"]
    found = patterns(Options(masks=tuple(paths[:2])))
    assert [pattern.name for pattern in found] == ["one/mask", "other/mask"]


def test_files_that_differ_by_their_suffix_alone_keep_it(tmp_path):
    mask = SparseAperture.from_catalog("golay6", 2.0, 0.05)
    save_json(tmp_path / "m.json", mask)
    save_fits(tmp_path / "m.fits", mask, 512)
    (tmp_path / "other").mkdir()
    save_json(tmp_path / "other/m.json", mask)
    files = [str(tmp_path / name) for name in ("m.json", "m.fits", "other/m.json")]
    assert name_masks(files) == ["m.json", "m.fits", "m"]
    assert [pattern.name for pattern in patterns(Options(masks=tuple(files[:2])))] == ["m.json", "m.fits"]


def test_a_ranking_states_its_light(tmp_path):
    words = [
        "golay6",
        *TINY,
        "--fill-factor",
        "0.1",
        "--n-photons",
        "3e5",
        "--readout-noise",
        "1.5",
        "--n-pixels",
        "64",
    ]
    turbulent = ["--criterion", "turbulent", "--r0", "0.3", "--wavelength", "550e-9", "--sky", "2"]
    assert main(["rank", *words, *turbulent, "--out", str(tmp_path / "run")]) == 0
    text = (tmp_path / "run/ranking.md").read_text()
    assert "turbulence of r0 = 0.3 m and outer scale infinite" in text
    assert (
        "3e+05 photons a frame at N d^2 / D^2 = 0.1, 2 electrons of sky in each of 64 x 64 pixels, read-out noise 1.5 "
        "electrons rms"
    ) in text
    light = {"fill_factor": 0.1, "n_photons": 3e5, "readout_noise": 1.5, "n_pixels": 64, "sky": 2.0}
    assert json.loads((tmp_path / "run/ranking.json").read_text())["light"] == light


def test_the_axis_of_numbers_of_holes_has_whole_ticks(tmp_path):
    patterns = [Pattern.from_catalog("jwst_niriss_ami_7")]
    light = observed(Options(n_frequencies=32, fill_factor=0.05)).criterion()
    figure = ranking_figure(rank_masks(patterns, lambda _: light, 1.0, 0.05), "")
    assert [tick for tick in figure.axes[1].get_xticks() if tick % 1] == []


def test_two_masks_of_one_name_are_refused_before_any_search(tmp_path, capsys):
    file = str(tmp_path / "mask.json")
    save_json(file, SparseAperture.from_catalog("golay6", 2.0, 0.05))
    for words, name in (([file, file, "--search", "6"], "mask"), (["golay6", "--search", "6", "6"], "torchmask_6")):
        assert main(["rank", *words, *TINY, "--out", str(tmp_path / "run")]) == 1
        assert f"two masks are named {name}: leave one out" in capsys.readouterr().err
        assert not (tmp_path / "run").exists()


def test_light_and_sky_are_in_proportion_to_the_area():
    seen = {
        "criterion": "turbulent",
        "wavelength": 550e-9,
        "r0": 0.2,
        "outer_scale": 20.0,
        "sky": 3.0,
        "n_photons": 1e6,
    }
    whole = observed(Options(**seen, n_frequencies=32, readout_noise=2.0, n_pixels=64))
    assert whole.area == pytest.approx(0.15 * math.pi / 4, rel=1e-12)
    full, half = whole.criterion(), whole.through(whole.area / 2).criterion()
    assert isinstance(half, TurbulentMSE)
    assert half.seeing == full.seeing
    assert half.seeing.r0 == 0.2
    noise = [float(each.noise_psd[0, 0]) for each in (full, half)]
    assert noise == pytest.approx([1e6 + 64**2 * (4 + 3.0), 5e5 + 64**2 * (4 + 1.5)], rel=1e-12)
    assert float(half.object_psd[0, 0]) == pytest.approx(5e5**2, rel=1e-12)


def test_pixels_may_be_finer_than_needed():
    grid = observed(Options(wavelength=550e-9, pixel_scale_arcsec=0.02, n_frequencies=32)).grid
    assert grid == Grid(32, 0.02 * ARCSEC, 550e-9)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (["golay"], "no mask is called 'golay'"),
        (["--fill-factor", "-0.15"], "--fill-factor is -0.15"),
        (["--mask-diameter", "8200"], "in m, so 8.2 m are 8.2"),
        (["--wavelength", "550"], "550 nm are 550e-9"),
        (["--pixel-scale-arcsec", "-1", "--wavelength", "550e-9"], "--pixel-scale-arcsec is -1"),
        (["--pixel-scale-arcsec", "0.5", "--wavelength", "550e-9"], "undersamples"),
        (["--central-obstruction", "0.95"], "no mask is left to rank"),
        (["--search", "5", "1"], "--search is 1: masks of at least two holes can be ranked"),
        (["--wind", "3"], "--wind needs --criterion turbulent"),
    ],
)
def test_impossible_requests_are_refused(given, said, tmp_path, capsys):
    assert main(["rank", *given, *TINY, "--out", str(tmp_path / "new" / "run")]) == 1
    assert said in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_what_is_said_of_a_missing_wavelength_is_accepted(tmp_path, capsys):
    argv = ["rank", "golay6", *TINY, "--r0", "0.2", "--fill-factor", "0.1", "--out", str(tmp_path / "run")]
    assert main(argv) == 1
    assert "--instrument tells it too, and --filter with --criterion turbulent" in capsys.readouterr().err
    assert main([*argv, "--filter", "bessell-V"]) == 1
    assert "error: --filter needs --criterion turbulent: the asymptotic" in capsys.readouterr().err
    assert main([*argv, "--wavelength", "5e-7", "--wavelengths", "5e-7", "6e-7"]) == 1
    assert "error: --wavelengths needs --criterion turbulent: the asymptotic" in capsys.readouterr().err
    assert main([*argv, "--filter", "bessell-V", "--n-wavelengths", "3", "--criterion", "turbulent"]) == 0

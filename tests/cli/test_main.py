"""The command line as a whole: exit status, one line for a mistake, help with units, what a plain install says."""

import dataclasses
import importlib
import re
import subprocess
import sys
import typing
from pathlib import Path

import pytest

from torchmask.cli.main import COMMANDS, main


def options_of(command):
    return importlib.import_module(f"torchmask.cli.{command}").Options


def leaves(options, prefix=""):
    """(dotted name, type) of every option."""
    hints = typing.get_type_hints(options)
    for field in dataclasses.fields(options):
        if dataclasses.is_dataclass(hints[field.name]):
            yield from leaves(hints[field.name], f"{prefix}{field.name}.")
        else:
            yield f"{prefix}{field.name}", hints[field.name]


def help_of(command, capsys):
    with pytest.raises(SystemExit) as end:
        main([command, "--help"])
    assert end.value.code == 0
    return " ".join(re.sub(r"[│╭╮╰╯─]", " ", capsys.readouterr().out).split())


@pytest.mark.parametrize("command", COMMANDS)
def test_help_shows_every_option(command, capsys):
    text = help_of(command, capsys)
    positional = {
        "stacks",
        "files",
        "folder",
        "name" if command == "masks" else "",
        "path" if command == "view" else "",
    }
    positional |= {"masks"} if command == "rank" else set()
    for name, _ in leaves(options_of(command)):
        if name not in positional:
            assert f"--{name.replace('_', '-')}" in text


# What is measured in a unit, and how help writes it; numbers that are not here count things or have none.
UNITS = {
    "temperature": r"\[K\]",
    "conditions.temperature": r"\[K\]",
    "pixel_scale": r"\[rad\]",
    "reference_fill_factor": "Fill factor",
    "diameter_over_r0": "D / r0",
    "max_hole_over_r0": "units of r0",
    "wavelength": r"\[m\]",
    "wavelengths": r"\[m\]",
    "bandwidth": r"\[m\]",
    "mask_diameter": r"\[m\]",
    "imaging.diameter": r"\[m\]",
    "central_obstruction": r"\[m\]",
    "vane_width": r"\[m\]",
    "vane_angles": r"\[degrees\]",
    "min_gap": r"\[m\]",
    "rim_margin": r"\[m\]",
    "keep_out": r"\[m\]",
    "spiders": r"\[m\]",
    "r0": r"\[m\]",
    "imaging.outer_scale": "units of D",
    "outer_scale": r"\[m\]",
    "star_diameter_mas": r"\[mas\]",
    "star_diameter_error_mas": r"\[mas\]",
    "pixel_scale_arcsec": r"\[arcsec\]",
    "least_arcsec": r"\[arcsec\]",
    "most_arcsec": r"\[arcsec\]",
    "exposure_time": r"\[s\]",
    "crop": r"\[pixels\]",
    "wind": r"\[m/s\]",
    "pixel_fill": "fraction of the area",
    "jitter": r"\[pixels\]",
    "gain": "[Ee]lectrons per adu",
    "saturation": "in its unit",
    "readout_noise": "[Ee]lectrons rms",
    "imaging.readout_noise": "[Ee]lectrons rms",
    "n_photons": "Electrons per frame",
    "imaging.n_photons": "Electrons per frame",
    "knee": r"\[cycles/pixel\]",
    "design.knee": r"\[cycles/pixel\]",
    "scene.attitude": r"\[degrees\]",
    "scene.size": "fraction of the field",
    "imaging.wavelength": r"\[m\]",
    "keep": "Fraction",
    "sky": "[Ee]lectrons per pixel",
    "turbulence.wind": r"\[m/s\]",
    "turbulence.frame_interval": r"\[s\]",
    "turbulence.exposure_time": r"\[s\]",
    "conditions.sky": "[Ee]lectrons per pixel and frame",
    "conditions.band_width": r"\[m\]",
    "true_mask.rotation_deg": r"\[degrees\]",
    "scale": "millimetres on the plate for each metre",
    "width": r"\[m\]",
    "widths": r"\[m\]",
    "exposure": r"\[s\]",
    "exposures": r"\[s\]",
    "observing_time": r"\[s\]",
    "hole_diameters": r"\[m\]",
    "telescope.diameter": r"\[m\]",
    "telescope.central_obstruction": r"\[m\]",
    "telescope.vane_width": r"\[m\]",
    "telescope.vane_angles": r"\[degrees\]",
    "telescope.throughput": "Electrons for each photon",
    "source.magnitude": "in the band",
    "source.photon_rate": "[Pp]hotons per second and square metre",
    "source.temperature": r"\[K\]",
    "source.size": r"\[arcsec\]",
    "site.r0": r"\[m\]",
    "site.wind": r"\[m/s\]",
    "site.outer_scale": r"\[m\]",
    "site.sky": "magnitudes per square arcsec",
    "camera.pixel_scale": r"\[arcsec\]",
    "camera.pixel_fill": "fraction of the area",
    "camera.readout_noise": "[Ee]lectrons rms",
    "camera.readout_time": r"\[s\]",
    "fill_factor": r"N d\^2 / D\^2",
    "design.fill_factor": r"N d\^2 / D\^2",
}
WITHOUT_UNIT = {
    *("exponent", "design.exponent", "tv_weight", "tolerance", "weights", "imaging.d_over_r0"),
    "source.exponent",
    "scene.sun",  # of any length
    *("conditions.transparency_scatter", "true_mask.magnification"),
}


@pytest.mark.parametrize("command", COMMANDS)
def test_help_says_the_unit_of_every_number(command, capsys):
    text = help_of(command, capsys)
    for name, hint in leaves(options_of(command)):
        if "float" not in str(hint) or name in WITHOUT_UNIT:
            continue
        # the option itself, with what it takes in capitals or braces, and not where another one mentions it
        flag = rf"--{re.escape(name.replace('_', '-'))} (?=[A-Z{{\[])"
        own = re.split(flag, text, maxsplit=1)[1].split(" --", 1)[0]
        assert re.search(UNITS[name], own), (name, own)


def test_wrong_usage_is_2(capsys):
    for argv in ([], ["nonsense"], ["design", "--nonsense", "1"], ["design", "--n-subapertures", "many"]):
        with pytest.raises(SystemExit) as end:
            main(argv)
        assert end.value.code == 2
    assert "Traceback" not in capsys.readouterr().err


def test_version(capsys):
    with pytest.raises(SystemExit) as end:
        main(["--version"])
    assert end.value.code == 0
    assert re.fullmatch(r"torchmask \d+\.\d+\.\d+\n", capsys.readouterr().out)


def test_a_mistake_is_one_line_and_1_and_a_traceback_with_debug(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    argv = ["simulate", "--mask", "no-such-mask"]
    assert main(argv) == 1
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("torchmask simulate: error: ")
    assert err.count("\n") == 1
    assert "no-such-mask" in err
    with pytest.raises(ValueError, match="no-such-mask"):
        main([*argv, "--debug"])
    assert list(tmp_path.iterdir()) == []


def test_an_interruption_is_130(monkeypatch, capsys):
    def interrupt(_):
        raise KeyboardInterrupt

    monkeypatch.setattr("torchmask.cli.masks.run", interrupt)
    assert main(["masks"]) == 130
    assert capsys.readouterr().err == "torchmask masks: interrupted\n"


def test_a_plain_install_names_the_extra():
    """In a process of its own, where what the extra brings cannot be imported; --help works all the same."""
    program = """
import sys
for name in ("tyro", "rich", "yaml", "tensorboard", "matplotlib"):
    sys.modules[name] = None
from torchmask.cli.main import COMMANDS, main
for command in COMMANDS:
    print(main([command]))
main(["--help"])
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 0
    assert done.stdout.split("usage")[0].split() == ["1"] * len(COMMANDS)
    lines = done.stderr.splitlines()
    assert len(lines) == len(COMMANDS)
    assert all("pip install 'torchmask[experiments]'" in line for line in lines)


def test_a_reader_that_has_read_enough_is_no_error():
    command = f"{Path(sys.executable).with_name('torchmask')} masks | head -n 1"
    done = subprocess.run(command, shell=True, capture_output=True, text=True, check=False)
    assert done.stdout.startswith("name")
    assert done.stderr == ""


def test_the_console_script_runs(tmp_path):
    """The installed command itself, once."""
    program = str(Path(sys.executable).with_name("torchmask"))
    done = subprocess.run(
        [program, "masks", "golay6", "--out", "golay6.json"], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "15, 15 distinct" in done.stdout
    assert (tmp_path / "golay6.json").is_file()

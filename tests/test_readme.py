"""The command line of README.md: its first three lines do what they say, one after the other, as they are printed."""

import json
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from torchmask.design.manufacture import mask_wavelength

ROOT = Path(__file__).parents[1]


def printed_commands():
    """The words of each command of the section's console block, without its comment."""
    section = (ROOT / "README.md").read_text(encoding="utf-8").split("\n## Command line\n", 1)[1]
    block = re.search(r"```console\n(.*?)```", section, re.DOTALL)
    assert block is not None
    lines = block[1].replace("\\\n", " ").splitlines()
    return [shlex.split(line.removeprefix("$ "), comments=True) for line in lines]


def test_the_section_prints_commands():
    assert all(words[0] == "torchmask" for words in printed_commands())
    assert [words[1] for words in printed_commands()[:3]] == ["design", "simulate", "restore"]


@pytest.mark.slow
def test_design_simulate_restore_work_one_after_the_other_as_printed(tmp_path):
    program = str(Path(sys.executable).with_name("torchmask"))
    for words in printed_commands()[:3]:
        done = subprocess.run([program, *words[1:]], cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
    for name in ("mask/mask.json", "mask/mask.svg", "mask/metrics.json", "stack/stack.npz", "image/restored.fits"):
        assert (tmp_path / "runs" / name).is_file(), name
    assert mask_wavelength(tmp_path / "runs/mask/mask.json") == 2.2e-6
    numbers = json.loads((tmp_path / "runs/image/metrics.json").read_text())
    assert numbers["score"] < 0.5 * numbers["mean_frame_score"]

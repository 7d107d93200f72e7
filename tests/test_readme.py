"""README.md is true: its commands and its Python work one after the other, as they are printed."""

import contextlib
import io
import json
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from torchmask.design.manufacture import mask_wavelength
from torchmask.metrics import relative_error

TEXT = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")


def section(title):
    return TEXT.split(f"\n## {title}\n", 1)[1].split("\n## ", 1)[0]


def printed_commands(title="Command line"):
    """The words of each command of the section's console block, without its comment."""
    block = re.search(r"```console\n(.*?)```", section(title), re.DOTALL)
    assert block is not None
    lines = block[1].replace("\\\n", " ").splitlines()
    return [shlex.split(line.removeprefix("$ "), comments=True) for line in lines]


def test_it_is_one_page():
    assert len(TEXT.split()) <= 900


def test_the_section_prints_commands():
    assert [words[:2] for words in printed_commands()] == [
        ["torchmask", name] for name in ("design", "simulate", "restore")
    ]


@pytest.mark.slow
def test_design_simulate_restore_work_one_after_the_other_as_printed(tmp_path):
    program = str(Path(sys.executable).with_name("torchmask"))
    for words in printed_commands():
        done = subprocess.run([program, *words[1:]], cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
    for name in ("mask/mask.json", "mask/mask.svg", "mask/metrics.json", "stack/stack.npz", "image/restored.fits"):
        assert (tmp_path / "runs" / name).is_file(), name
    assert mask_wavelength(tmp_path / "runs/mask/mask.json") == 2.2e-6
    numbers = json.loads((tmp_path / "runs/image/metrics.json").read_text())
    assert numbers["score"] < 0.5 * numbers["mean_frame_score"]


@pytest.mark.slow
def test_the_plan_works_as_printed(tmp_path):
    (words,) = printed_commands("Plan an observation")
    assert words[:2] == ["torchmask", "plan"]
    program = str(Path(sys.executable).with_name("torchmask"))
    done = subprocess.run([program, *words[1:]], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    for name in ("plan.md", "plan.png", "mask.json", "instrument.json"):
        assert (tmp_path / "runs/plan" / name).is_file(), name


@pytest.mark.slow
def test_the_python_works_one_block_after_the_other_as_printed():
    blocks = re.findall(r"```python\n(.*?)```", section("In Python"), re.DOTALL)
    assert len(blocks) == 4
    names, printed = {}, io.StringIO()
    with contextlib.redirect_stdout(printed):
        for block in blocks:
            exec(block, names)
    cutoff = names["grid"].cutoff(1.0)
    mean_frame = relative_error(names["seen"].frames.mean(0), names["scene"], cutoff)
    assert relative_error(names["result"].object, names["scene"], cutoff) < 0.5 * mean_frame
    assert float(names["criterion"].relative(names["trained"])) < float(names["criterion"].relative(names["first"]))
    assert printed.getvalue().count("torch.Size([4, 4, 64, 64]) torch.Size([4, 64, 64])") == 2

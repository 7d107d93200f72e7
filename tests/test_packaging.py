"""What is published: an sdist and a wheel that hold all that is needed, and import quickly where nothing else is."""

import json
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import tomllib
import zipfile
from email.parser import Parser
from importlib import metadata
from pathlib import Path

import pytest

import torchmask

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
EXTRAS = PROJECT["optional-dependencies"]


# Of the processes below: a PYTHONPATH to the sources would hide what is installed.
ENVIRONMENT = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}


def run(*command, **options):
    command = [str(part) for part in command]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=ENVIRONMENT, **options)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def name_of(requirement):
    return requirement.split("[")[0].split("=")[0].strip("<>~! ").lower()


def test_all_is_every_extra():
    (everything,) = EXTRAS["all"]
    assert sorted(everything.removeprefix("torchmask[").removesuffix("]").split(",")) == sorted(set(EXTRAS) - {"all"})


def test_the_citation_and_the_changelog_name_the_version():
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert re.findall(r"^version: (.*)$", citation, re.MULTILINE) == [torchmask.__version__]
    assert re.findall(r"^## ([\d.]+)", changes, re.MULTILINE)[0] == torchmask.__version__


@pytest.fixture(scope="module")
def dist(tmp_path_factory):
    """Both built from a copy, because setuptools writes beside what it builds; the wheel from the sdist."""
    folder = tmp_path_factory.mktemp("source")
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, folder)
    shutil.copytree(ROOT / "torchmask", folder / "torchmask", ignore=shutil.ignore_patterns("__pycache__"))
    run(sys.executable, "-m", "build", "--no-isolation", folder)
    return folder / "dist"


@pytest.fixture(scope="module")
def wheel(dist):
    (path,) = dist.glob("*.whl")
    return path


@pytest.mark.slow
def test_the_wheel_holds_the_package_and_nothing_else(wheel):
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        information = next(name for name in names if name.endswith("METADATA")).removesuffix("METADATA")
        described = Parser().parsestr(archive.read(information + "METADATA").decode())
        entries = archive.read(information + "entry_points.txt").decode()
    inside = {name for name in names if not name.startswith(information)}
    source = ROOT / "torchmask"
    wanted = {f"torchmask/{path.relative_to(source).as_posix()}" for path in source.rglob("*.py")}
    assert information == f"torchmask-{torchmask.__version__}.dist-info/"
    data = (
        "py.typed",
        "optics/masks.json",
        "planning/smearing_full.json",
        "planning/smearing_mask.json",
        "planning/success_full.json",
        "planning/success_mask.json",
    )
    assert inside == wanted | {f"torchmask/{name}" for name in data}
    assert information + "licenses/LICENSE" in names
    assert entries.split() == ["[console_scripts]", "torchmask", "=", PROJECT["scripts"]["torchmask"]]
    assert set(described.get_all("Provides-Extra")) == set(EXTRAS)
    plain = {name_of(line) for line in described.get_all("Requires-Dist") if "extra ==" not in line}
    assert plain == {"torch", "numpy", "scipy"}


@pytest.mark.slow
def test_the_sdist_holds_what_builds_the_wheel(dist):
    (path,) = dist.glob("*.tar.gz")
    with tarfile.open(path) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    assert {"pyproject.toml", "README.md", "LICENSE", "torchmask/py.typed", "torchmask/optics/masks.json"} <= names


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory):
    """The wheel without its dependencies, in an environment that sees those of this one, but not this torchmask."""
    folder = tmp_path_factory.mktemp("environment")
    run(sys.executable, "-m", "venv", "--without-pip", folder)
    python = folder / "bin" / "python"
    run(sys.executable, "-m", "pip", "--python", python, "install", "--quiet", "--no-deps", "--no-index", wheel)
    (site,) = folder.glob("lib/python*/site-packages")
    (site / "dependencies.pth").write_text(sysconfig.get_path("purelib"), encoding="utf-8")
    return python


@pytest.mark.slow
def test_the_installed_package_imports_quickly_and_alone(installed, tmp_path):
    program = """
import json, sys, time
import torch
before, start = set(sys.modules), time.process_time()
import torchmask
seconds = time.process_time() - start
new = {name.partition(".")[0] for name in set(sys.modules) - before}
mask = torchmask.SparseAperture.from_catalog("golay6", 1.0, 0.15)
print(json.dumps([torchmask.__file__, seconds, sorted(new - set(sys.stdlib_module_names)), mask.n_subapertures]))
"""
    file, seconds, new, n_subapertures = json.loads(run(installed, "-c", program, cwd=tmp_path))
    assert Path(file).is_relative_to(installed.parents[1])
    assert seconds < 3
    optional = {name_of(line) for lines in EXTRAS.values() for line in lines} - {"torchmask"}
    providers = metadata.packages_distributions()
    assert {dist.lower() for name in new for dist in providers.get(name, [])}.isdisjoint(optional)
    assert {"torchmask", "scipy"} <= set(new)
    assert n_subapertures == 6


@pytest.mark.slow
def test_the_installed_command_runs(installed, tmp_path):
    assert "golay6" in run(installed.parent / "torchmask", "masks", cwd=tmp_path)


@pytest.mark.slow
def test_the_public_names_are_typed(installed, tmp_path):
    """As a type checker of a user's project sees them; what is left are attributes whose types it has to infer."""
    environment = {**ENVIRONMENT, "PATH": f"{installed.parent}:{os.environ['PATH']}"}
    environment["VIRTUAL_ENV"] = str(installed.parents[1])
    command = [sys.executable, "-m", "pyright", "--verifytypes", "torchmask", "--ignoreexternal", "--outputjson"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path, env=environment)
    report = json.loads(done.stdout)["typeCompleteness"]
    assert report["exportedSymbolCounts"]["withKnownType"] > 1000
    assert report["completenessScore"] > 0.97


@pytest.mark.slow
def test_a_type_checker_takes_masks_of_lists_arrays_and_tensors(installed, tmp_path):
    script = tmp_path / "script.py"
    script.write_text(
        "import numpy as np\nimport torch\nimport torchmask as tm\n"
        "mask = tm.SparseAperture([[0.0, 0.4], [0.3, -0.2]], 0.1, 1.0).replace(centers=[[0.0, 0.4], [0.3, -0.2]])\n"
        "tm.SparseAperture(np.zeros((2, 2)), 0.1, 1.0), tm.SparseAperture(torch.zeros(2, 2), 0.1, 1.0)\n"
    )
    run(sys.executable, "-m", "pyright", "--pythonpath", installed, script, cwd=tmp_path)

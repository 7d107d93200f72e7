"""The manual names tests that exist, and its reference holds every public name. `make docs` builds it."""

import re
from pathlib import Path

import pytest

import torchmask

ROOT = Path(__file__).parents[1]
PAGES = [*sorted((ROOT / "docs").rglob("*.md")), ROOT / "CONTRIBUTING.md"]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_tests_that_are_named_exist(page):
    for file, test in re.findall(r"`(tests/[\w/]+\.py)(?:::(\w+))?`", page.read_text(encoding="utf-8")):
        assert (ROOT / file).is_file(), file
        if test:
            assert f"def {test}(" in (ROOT / file).read_text(encoding="utf-8"), f"{file}::{test}"


def test_every_convention_is_on_the_page_of_conventions():
    text = (ROOT / "docs" / "conventions.md").read_text(encoding="utf-8")
    for file in (ROOT / "tests" / "conventions").glob("test_*.py"):
        assert f"tests/conventions/{file.name}" in text


def test_the_plan_is_the_second_thing_that_a_newcomer_meets():
    index = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
    rows = [line for line in index.splitlines() if line.startswith("| ")][1:]
    assert ["quickstart" in rows[0], "(planning.md)" in rows[1]] == [True, True]
    start = index.split(":caption: Start\n\n")[1].splitlines()
    assert start[:3] == ["install", "notebooks/1_quickstart", "planning"]
    titles = re.findall(r"^## (.+)$", (ROOT / "README.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert titles[:2] == ["Two commands", "Plan an observation"]


@pytest.mark.parametrize("name", torchmask.__all__)
def test_the_reference_holds_every_public_name(name):
    path = f"{getattr(torchmask, name).__module__}.{name}"
    assert path in (ROOT / "docs" / "api" / "index.md").read_text(encoding="utf-8")
    reference = "\n".join(page.read_text(encoding="utf-8") for page in (ROOT / "docs" / "api").glob("*.md"))
    module = re.escape(path.rpartition(".")[0])
    listed = rf"automodule:: {module}\n   :members:( .*\b{name}\b.*)?\n"
    assert f":: {path}\n" in reference or re.search(listed, reference)

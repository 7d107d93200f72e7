"""The examples in docstrings and in the manual run, and every public name has one."""

import doctest
import importlib
import pkgutil
import re
from pathlib import Path

import pytest
import torch

import torchmask

MODULES = [torchmask.__name__, *(m.name for m in pkgutil.walk_packages(torchmask.__path__, "torchmask."))]
MODULES = [name for name in MODULES if not name.startswith("torchmask.interop.")]  # what they need may be missing
PAGES = sorted((Path(__file__).parents[1] / "docs").glob("*.md"))
FLAGS = doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS


def run(test):
    out = []
    result = doctest.DocTestRunner(optionflags=FLAGS).run(test, out=out.append)
    assert result.failed == 0, "".join(out)


@pytest.fixture(autouse=True)
def seeded():
    """Examples that do not care about chance are still the same every time."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        yield


@pytest.mark.parametrize("name", MODULES)
def test_examples_in_docstrings(name):
    module = importlib.import_module(name)
    for test in doctest.DocTestFinder().find(module, name):
        run(test)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_examples_in_the_manual(page):
    text = re.sub(r"^```.*$", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE)
    run(doctest.DocTestParser().get_doctest(text, {}, page.name, str(page), 0))


@pytest.mark.parametrize("name", torchmask.__all__)
def test_every_public_name_has_an_example(name):
    public = getattr(torchmask, name)
    found = doctest.DocTestFinder().find(public, name, module=importlib.import_module(public.__module__))
    assert any(test.examples for test in found), f"{name} has no example in its docstring"

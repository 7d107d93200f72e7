"""Figures of whole runs are drawn, but coarsely: tests/viz looks at them."""

import pytest


@pytest.fixture(scope="module", autouse=True)
def figures_are_coarse(coarse_figures):
    """For all files of this folder, before any fixture that runs a command."""

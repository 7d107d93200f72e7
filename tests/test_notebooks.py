"""The notebooks run, here with tiny sizes; `make notebooks` runs them whole and keeps what they show."""

import importlib.util
from pathlib import Path

import nbformat
import pytest

FOLDER = Path(__file__).parents[1] / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
by_name = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


@pytest.fixture(scope="module")
def execute():
    spec = importlib.util.spec_from_file_location("execute", FOLDER / "execute.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.execute


def outputs(notebook):
    return [output for cell in notebook.cells for output in cell.get("outputs", [])]


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of the messaging between notebook and kernel
@by_name
def test_notebook_runs(path, execute, monkeypatch):
    monkeypatch.setenv("TORCHMASK_SMOKE", "1")
    shown = outputs(execute(path))
    assert any("image/png" in output.get("data", {}) for output in shown)
    assert not any(output.get("name") == "stderr" for output in shown), "a cell writes warnings"


@by_name
def test_what_is_committed_is_small_whole_and_in_order(path):
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    assert path.stat().st_size < 500_000
    counts = [cell.execution_count for cell in notebook.cells if cell.cell_type == "code"]
    assert counts == list(range(1, len(counts) + 1)), "run `make notebooks`: cells were changed after they ran"
    shown = outputs(notebook)
    assert sum("image/png" in output.get("data", {}) for output in shown) >= 1
    assert not any(output.get("name") == "stderr" or output.output_type == "error" for output in shown)


def test_there_are_four():
    assert [path.stem for path in NOTEBOOKS] == ["1_quickstart", "2_design", "3_layers", "4_your_data"]

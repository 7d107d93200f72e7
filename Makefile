# Two commands matter to a newcomer: `make demo` and `make test`.
PYTHON ?= python3
BIN := .venv/bin
export OMP_NUM_THREADS ?= 1
# Threads that wait for each other sleep: spinning, they take the time of whatever else runs.
export OMP_WAIT_POLICY ?= passive
# Types and manual take over a minute each, on one core.
MAKEFLAGS += --jobs=2

.venv/.torch: constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet -c constraints.txt torch
	touch $@

.venv/.experiments: pyproject.toml .venv/.torch
	$(BIN)/pip install --quiet -c constraints.txt -e '.[experiments]'
	touch $@

.venv/.test: pyproject.toml .venv/.torch
	$(BIN)/pip install --quiet -c constraints.txt -e '.[test]'
	touch $@ .venv/.experiments

# All dependencies but torch at the lowest version that pyproject.toml allows, those of the extra `test` among them.
.venv-oldest/.done: pyproject.toml constraints.txt .venv/.test
	rm -rf .venv-oldest
	$(BIN)/python -m venv .venv-oldest
	.venv-oldest/bin/pip install --quiet uv -c constraints.txt torch
	.venv-oldest/bin/uv pip install --quiet --python .venv-oldest/bin/python --resolution lowest-direct -c constraints.txt -e '.[test]'
	touch $@

.PHONY: demo test quick oldest lint docs notebooks dist clean
demo: .venv/.experiments
	OMP_NUM_THREADS=2 $(BIN)/python experiments/codesign.py

test: lint docs
	$(BIN)/pytest -n 2 --dist worksteal

quick: .venv/.test
	$(BIN)/pytest -n 2 --dist worksteal -m 'not slow'

# Old versions warn of what their own dependencies have since renamed.
oldest: .venv-oldest/.done
	.venv-oldest/bin/python -m pytest -n 2 --dist worksteal -m 'not slow' -W ignore::DeprecationWarning

lint: .venv/.test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright

docs: .venv/.test
	$(BIN)/sphinx-build -W --keep-going -q -b html docs docs/_build/html

# Executes the notebooks whole, each in less than two minutes on two cores, and keeps their outputs.
notebooks: .venv/.test
	OMP_NUM_THREADS=2 $(BIN)/python notebooks/execute.py

# An sdist and a wheel, in dist/.
dist: .venv/.test
	$(BIN)/python -m build --no-isolation

clean:
	rm -rf .venv .venv-oldest build dist *.egg-info docs/_build

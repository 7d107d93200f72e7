# Two commands matter to a newcomer: `make demo` and `make test`.
PYTHON ?= python3
BIN := .venv/bin
export OMP_NUM_THREADS ?= 1

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

.PHONY: demo test quick lint clean
demo: .venv/.experiments
	OMP_NUM_THREADS=2 $(BIN)/python experiments/codesign.py

test: lint
	$(BIN)/pytest -n 2

quick: .venv/.test
	$(BIN)/pytest -n 2 -m 'not slow'

lint: .venv/.test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright

clean:
	rm -rf .venv build dist *.egg-info

# Two commands set everything up: `make bench` and `make test`. `make fast` is what a change needs before it is committed;
# `make timing` measures every budget.
# FATHOM_DATA names the folder of recordings.

PYTHON ?= python3
DATA := $(firstword $(FATHOM_DATA) $(wildcard ../shared/data))
BIN := .venv/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt
PYTEST := $(BIN)/python -m pytest -q -n auto --dist worksteal

# Python keeps the bytecode it compiles, whatever the shell says: dozens of processes read the same sources
export PYTHONDONTWRITEBYTECODE :=

.PHONY: bench test fast timing reference lint types warm clean

bench: .venv/core
	$(BIN)/fathom run filter_vs_smoother $(if $(DATA),--data $(DATA))

# types are checked on one core while the other compiles
test: .venv/dev lint
	$(MAKE) --jobs 2 types warm
	$(PYTEST) --durations 40

fast: .venv/dev lint
	$(PYTEST) -m 'not slow'

timing: .venv/dev
	$(BIN)/fathom timing budgets

# results/reference/*.csv anew; recorded logs among them where FATHOM_DATA has them
reference: .venv/core
	$(if $(DATA),FATHOM_DATA=$(DATA)) $(BIN)/python -m fathom.bench.execution.reference

lint: .venv/dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

# basedpyright cannot follow an editable install, so it sees a plain one
types: .venv/dev
	rm -rf build
	$(PIP) --no-deps --no-build-isolation --target build/types .
	$(BIN)/basedpyright

warm: .venv/dev
	$(BIN)/python tests/warm.py

.venv/core: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(PIP) --editable '.[report]'
	touch $@

.venv/dev: .venv/core
	$(PIP) --editable '.[dev]'
	touch $@

clean:
	rm -rf .venv build *.egg-info

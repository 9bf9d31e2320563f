# Two commands set everything up: `make bench` and `make test`; `make timing` measures every budget.
# FATHOM_DATA names the folder of recordings.

PYTHON ?= python3
DATA := $(firstword $(FATHOM_DATA) $(wildcard ../shared/data))
BIN := .venv/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt

.PHONY: bench test timing reference lint clean

bench: .venv/core
	$(BIN)/fathom run filter_vs_smoother $(if $(DATA),--data $(DATA))

test: .venv/dev lint
	$(BIN)/python -m pytest -q -n auto --dist worksteal --durations 40

timing: .venv/dev
	$(BIN)/fathom timing budgets

# results/reference/*.csv anew; recorded logs among them where FATHOM_DATA has them
reference: .venv/core
	$(if $(DATA),FATHOM_DATA=$(DATA)) $(BIN)/python -m fathom.bench.execution.reference

# basedpyright cannot follow an editable install, so it sees a plain one
lint: .venv/dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	rm -rf build
	$(PIP) --no-deps --target build/types .
	$(BIN)/basedpyright

.venv/core: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(PIP) --editable '.[report]'
	touch $@

.venv/dev: .venv/core
	$(PIP) --editable '.[dev]'
	touch $@

clean:
	rm -rf .venv build *.egg-info

# Two commands set everything up: `make bench` and `make test`. `make fast` is what a change needs before it is committed;
# `make timing` measures every budget.
# FATHOM_DATA names the folder of recordings.

PYTHON ?= python3
DATA := $(firstword $(FATHOM_DATA) $(wildcard ../shared/data))
BIN := .venv/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check
PINS := $(BIN)/uv pip compile --generate-hashes --no-header --no-annotate --no-emit-index-url --quiet --python-version 3.11
PYTEST := $(BIN)/python -m pytest -q -n auto --dist worksteal

# Python keeps the bytecode it compiles, whatever the shell says: dozens of processes read the same sources
export PYTHONDONTWRITEBYTECODE :=

.PHONY: bench test fast timing reference honesty lint types warm pins lowest clean

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

# README's figures of honesty and of wrong starts, and their tables: twenty minutes on two cores. A start that is refused is
# a run that failed, so fathom's status is 1
honesty: .venv/core
	$(BIN)/fathom run honesty || test $$? = 1
	$(BIN)/fathom run initial_error || test $$? = 1
	cp results/honesty/honesty.csv results/reference/full/honesty.csv
	cp results/initial_error/convergence.csv results/reference/full/initial_error.csv
	cp results/honesty/figures/honesty.png docs/honesty.png
	cp results/initial_error/figures/convergence.png docs/initial-error.png

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

.venv/core: pyproject.toml constraints-bench.txt
	$(PYTHON) -m venv .venv
	$(PIP) --require-hashes --requirement constraints-bench.txt
	$(PIP) --no-deps --no-build-isolation --editable .
	touch $@

.venv/dev: .venv/core constraints.txt
	$(PIP) --require-hashes --requirement constraints.txt
	touch $@

# after a change of dependencies; what is pinned stays, as long as it fits
pins: .venv/dev
	$(PINS) --universal --extra dev pyproject.toml --output-file constraints.txt
	grep -o '^setuptools==[^ ]*' constraints.txt | $(PINS) --universal --extra report --constraint constraints.txt \
		pyproject.toml - --output-file constraints-bench.txt
	printf 'setuptools==84.2.1\npytest>=8\nhypothesis>=6.100\n' | $(PINS) --resolution lowest-direct --extra report \
		pyproject.toml - --output-file constraints-lowest.txt

# the lower bounds of pyproject.toml are true: what needs no compiling passes with them
lowest: .venv/dev
	rm -rf build/lowest
	$(BIN)/uv venv --quiet --python $(BIN)/python build/lowest
	$(BIN)/uv pip install --quiet --python build/lowest --require-hashes --requirement constraints-lowest.txt
	$(BIN)/uv pip install --quiet --python build/lowest --no-deps --no-build-isolation .
	build/lowest/bin/fathom list experiments >build/lowest/experiments
	build/lowest/bin/python -m pytest -q -o addopts=--import-mode=importlib -W ignore -m 'not slow' \
		tests/datasets/test_errors.py tests/datasets/test_quantities.py \
		tests/datasets/described/test_conversions.py tests/datasets/formats/test_columns.py \
		tests/bench/output/test_hostile_text.py

clean:
	rm -rf .venv build *.egg-info

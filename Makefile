# make repro   everything from nothing: environment, then `dvc repro` on the scenes of pipeline/plan.yaml
# make test    lint, types, layers, tests
# make ui      the MLflow UI on the embedded store
# make bench   benchmarks (not part of the tests)
# make clean   removes what the targets above made, but no data and no results

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

export MLFLOW_DISABLE_TELEMETRY = true
export DO_NOT_TRACK = true
export DVC_NO_ANALYTICS = 1
# One thread a process: steadier on few cores, and the same sums in the same order everywhere.
export OMP_NUM_THREADS = 1

.PHONY: repro test lint ui bench readme clean
.DEFAULT_GOAL := repro

$(STAMP): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "make: Python 3.11 or newer is needed; got " + sys.version.split()[0] + ". Try: make PYTHON=python3.11")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[dev]'
	@touch $@

repro: $(STAMP)
	$(BIN)/reskin scenes check
	$(BIN)/dvc repro

test: lint
	$(BIN)/python -m pytest -q -n 2 --dist loadfile --no-loadscope-reorder

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

ui: $(STAMP)
	$(BIN)/reskin publish
	$(BIN)/mlflow ui --backend-store-uri sqlite:///mlflow.db

bench: $(STAMP)
	$(BIN)/python -m pytest tests/benchmarks -s -q --override-ini addopts= -p no:xdist

readme: $(STAMP)
	$(BIN)/reskin readme

clean:
	rm -rf $(VENV) .pytest_cache .mypy_cache .ruff_cache .hypothesis *.egg-info

# make repro   installs the environment, then runs `dvc repro` for the scenes in pipeline/plan.yaml
# make test    checks the style, the types and the imports between packages, then runs the tests
# make lint    only checks the style, the types and the imports
# make ui      starts the MLflow UI, which shows the runs that are stored in this checkout
# make bench   runs the benchmarks (python -m tools.benchmarks --help lists all), then the tests including slow ones
# make constraints   finds the newest compatible versions -> constraints.txt; then run make test, and commit
# make clean   removes the files made by the targets above, except data and results

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

export MLFLOW_DISABLE_TELEMETRY = true
export DO_NOT_TRACK = true
export DVC_NO_ANALYTICS = 1
# One thread per process: run times vary less on few cores, and sums are always computed in the same order.
export OMP_NUM_THREADS = 1
# Empty, so that bytecode is written even if the user's environment forbids it. Without bytecode, every stage and every
# test worker compiles all its modules again.
export PYTHONDONTWRITEBYTECODE =
# Stages run `python`, which must be the one of this environment.
export PATH := $(CURDIR)/$(BIN):$(PATH)

.PHONY: repro test compiled lint ui bench constraints clean
.DEFAULT_GOAL := repro

# Versions are exact, but pip compares no hashes: with --require-hashes it installs no editable project, and torch is
# another file (and with CUDA brings other packages) on PyPI, on the index without CUDA and on the disk of some machines.
$(STAMP): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "make: Python 3.11 or newer is needed; got " + sys.version.split()[0] + ". Try: make PYTHON=python3.11")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[dev]'
	@touch $@

repro: $(STAMP)
	$(BIN)/reskin scenes check
	$(BIN)/dvc repro
	@[ -e mlflow.db ] || $(BIN)/reskin publish # DVC skips stage report if all results equal those in dvc.lock
	@echo "results: reports/index.html; training runs: make ui; next: docs/tutorial.md"

# Three workers are used even on two cores, because tests of live boards wait for most of their time.
test: $(STAMP)
	@$(MAKE) --no-print-directory --jobs=2 lint compiled
	$(BIN)/python -m pytest -q -n 3 --dist loadfile --no-loadscope-reorder

# Compiles and imports everything once, so that the workers of `make test` do not compile the same modules at the same
# time. Errors in tests are ignored here, because `make test` shows them.
compiled: $(STAMP)
	@$(BIN)/python -m tests.compiled
	@$(BIN)/python -m pytest -q --collect-only -p no:xdist >/dev/null || true

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

ui: $(STAMP)
	$(BIN)/reskin publish
	MLFLOW_SERVER_ENABLE_JOB_EXECUTION=false $(BIN)/mlflow ui --workers 1 --backend-store-uri sqlite:///mlflow.db

bench: $(STAMP)
	$(BIN)/python -m tools.benchmarks
	RESKIN_SLOW_TESTS=1 $(BIN)/python -m pytest -q -n 2 --dist loadfile

constraints: $(STAMP)
	$(BIN)/python -m release.constraints

clean:
	rm -rf $(VENV) .venv-* .audit build .pytest_cache .mypy_cache .ruff_cache .hypothesis *.egg-info

# make repro   installs the environment, then runs `dvc repro` for the scenes in pipeline/plan.yaml
# make test    checks the style, the types and the imports between packages, then runs the tests
# make test-pythons   make test on each supported Python that is installed, each in an environment of its own
# make test-processors   checks that training gives the same bits on emulated Intel and AMD processors (needs qemu-user)
# make ui      starts the MLflow UI, which shows the runs that are stored in this checkout
# make bench   runs the benchmarks at full size (`make test` runs each of them at a tiny size), and slow tests
# make faults   causes real faults and checks the messages and results (Linux; mounts need root) -> docs/faults.md
# make time-repro   times `make repro` in a fresh clone (three runs of its stages) -> reports/time.json
# make constraints   finds the newest compatible versions -> constraints.txt; then run make test, and commit
# make licences   lists the licences of all installed packages; fails if one is not compatible
# make audit   lists known vulnerabilities of the versions in constraints.txt, according to pypi.org
# make time-install   installs the wheel in an empty environment: measures time and size, and opens `reskin live`
# make team-server FOLDER=... [HOST=0.0.0.0] [PORT=5000]   starts an MLflow server on PostgreSQL; Ctrl-C stops it
# make teams   tests the workflows of a team, on servers that it starts and stops -> docs/measured/teams.md
# make clean   removes the files made by the targets above, except data and results

PYTHON ?= python3
PYTHONS := 3.11 3.12 3.13
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

.PHONY: repro test test-pythons test-processors compiled collected lint ui bench faults time-repro time-install readme constraints licences audit clean
.PHONY: team-server teams
.DEFAULT_GOAL := repro

$(STAMP): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "make: Python 3.11 or newer is needed; got " + sys.version.split()[0] + ". Try: make PYTHON=python3.11")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[dev]'
	@touch $@

repro: $(STAMP)
	$(BIN)/reskin scenes check
	$(BIN)/dvc repro
	@[ -e mlflow.db ] || $(BIN)/reskin publish # DVC skips stage report if all results equal those in dvc.lock
	@$(BIN)/reskin summary

# Three workers are used even on two cores, because tests of live boards wait for most of their time.
test: $(STAMP)
	@$(MAKE) --no-print-directory --jobs=2 lint compiled collected
	$(BIN)/python -m pytest -q -n 3 --dist loadfile --no-loadscope-reorder

test-pythons:
	@for version in $(PYTHONS); do \
		if python$$version -c '' 2>/dev/null; then \
			$(MAKE) --no-print-directory test PYTHON=python$$version VENV=.venv-$$version || exit 1; \
		else echo "python$$version is not installed: not tested"; fi; \
	done

# Trains tiny networks on processors that QEMU emulates. Their weights must equal those of networks that are trained on
# this processor. Needs qemu-user.
test-processors: $(STAMP)
	$(BIN)/python -m tests.arithmetic Haswell-v2 Skylake-Client-v1 EPYC-v1

compiled: $(STAMP)
	$(BIN)/python -m tests.compiled

# Imports all tests once after each edit, so that their bytecode exists before the workers of `make test` import them at
# the same time.
collected: .pytest_cache/collected
.pytest_cache/collected: $(STAMP) $(shell find pipeline reskin tests release tools -name '*.py')
	@output=$$($(BIN)/python -m pytest -q --collect-only -p no:xdist) || { echo "$$output" | tail -40; exit 1; }
	@mkdir -p $(@D) && touch $@

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

ui: $(STAMP)
	$(BIN)/reskin publish
	MLFLOW_SERVER_ENABLE_JOB_EXECUTION=false $(BIN)/mlflow ui --workers 1 --backend-store-uri sqlite:///mlflow.db

bench: $(STAMP)
	RESKIN_BENCHMARKS=full $(BIN)/python -m pytest -s -q -p no:xdist tests/benchmarks \
		tests/stages tests/experiments tests/models tests/live/test_gripper.py \
		tests/recordings/readers/test_lateness.py tests/test_numerics.py tests/test_pyfunc.py tests/test_tutorial.py

# Causes faults such as killed processes, full disks, truncated files and dead servers, each in a copy of a small
# checkout whose stages have run.
faults: $(STAMP)
	$(BIN)/python -m tests.faults

# Measures the time and the disk space that a newcomer needs: makes a fresh clone, and runs its stages three times
# without any cache.
time-repro:
	$(PYTHON) tests/benchmarks/time_repro.py --times 3

# Measures the time and the disk space that somebody needs who has a board and Python, but no clone.
time-install:
	$(PYTHON) tests/benchmarks/time_install.py --constraint constraints.txt

constraints: $(STAMP)
	$(BIN)/python -m release.constraints

licences: $(STAMP)
	$(BIN)/python -m release.licences

# The audit uses a separate environment, because its tool is not a dependency of the project.
audit:
	$(PYTHON) -m venv .audit
	.audit/bin/python -m pip install --quiet --disable-pip-version-check pip-audit
	.audit/bin/pip-audit --strict --requirement constraints.txt --no-deps --disable-pip # strict: fails if a package cannot be audited

# Installs the extras dask and team, and an S3-compatible server for the tests.
$(VENV)/.team: $(STAMP)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[dask,team]' 'moto[server]'
	@touch $@

HOST ?= 127.0.0.1
PORT ?= 5000
team-server: $(VENV)/.team
	$(BIN)/python -m deploy.team_server $(or $(FOLDER),$(error FOLDER=... is missing: the folder for the database and the artifacts)) --host $(HOST) --port $(PORT)

teams: $(VENV)/.team
	$(BIN)/python -m tests.benchmarks.teams

readme: $(STAMP)
	$(BIN)/reskin readme

clean:
	rm -rf $(VENV) .venv-* .audit build .pytest_cache .mypy_cache .ruff_cache .hypothesis *.egg-info

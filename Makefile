# make repro   everything from nothing: environment, then `dvc repro` on the scenes of pipeline/plan.yaml
# make test    lint, types, layers, tests
# make test-processors   trainings on emulated processors of Intel and AMD: the same bits (needs qemu-user)
# make ui      the MLflow UI on the embedded store
# make bench   benchmarks at full size (the tests run each at a tiny size)
# make faults   injects every fault for real (Linux, root for mounts) -> docs/faults.md
# make time-repro   `make repro` in a fresh clone, its stages three times: seconds, CPU seconds, disk -> reports/time.json
# make constraints   the newest versions that fit together -> constraints.txt; then make test, then commit
# make licences   the licences of all that is installed; fails on one that is not compatible
# make audit   known faults of the versions in constraints.txt; asks pypi.org
# make time-install   the wheel in an empty environment: seconds, MB, and a page of `reskin live`
# make team-server FOLDER=... [HOST=0.0.0.0] [PORT=5000]   MLflow on PostgreSQL, until Ctrl-C
# make teams      what a team does, on servers of its own, which it ends -> docs/measured/teams.md
# make cluster-test   a sweep on a cluster in network namespaces, as root -> docs/measured/cluster.md, scaling.md
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
# Where an environment forbids it, every stage and every worker of the tests would compile all its modules again.
export PYTHONDONTWRITEBYTECODE =
# Stages run `python`: the one of this environment.
export PATH := $(CURDIR)/$(BIN):$(PATH)

.PHONY: repro test test-processors lint ui bench faults time-repro time-install readme constraints licences audit clean
.PHONY: team-server teams cluster-test
.DEFAULT_GOAL := repro

$(STAMP): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "make: Python 3.11 or newer is needed; got " + sys.version.split()[0] + ". Try: make PYTHON=python3.11")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[dev]'
	@touch $@

repro: $(STAMP)
	$(BIN)/reskin scenes check
	$(BIN)/dvc repro
	@[ -e mlflow.db ] || $(BIN)/reskin publish # DVC skips stage publish if all results equal those in dvc.lock
	@$(BIN)/reskin compare || true # compares with the committed reports; a scene of your own has none

test: lint
	$(BIN)/python -m pytest -q -n 2 --dist loadfile --no-loadscope-reorder

# Tiny trainings on processors that QEMU emulates: their weights must be those of this processor. Needs package qemu-user.
test-processors: $(STAMP)
	$(BIN)/python -m tests.arithmetic Haswell-v2 Skylake-Client-v1 EPYC-v1

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

ui: $(STAMP)
	$(BIN)/reskin publish
	$(BIN)/mlflow ui --backend-store-uri sqlite:///mlflow.db

bench: $(STAMP)
	RESKIN_BENCHMARKS=full $(BIN)/python -m pytest tests/benchmarks -s -q -p no:xdist

# Kills, full disks, cut files, dead servers: each hits a copy of a small checkout that has finished.
faults: $(STAMP)
	$(BIN)/python -m tests.faults

# How long a newcomer waits, and what it takes on disk: a fresh clone, its stages three times from nothing.
time-repro:
	$(PYTHON) tests/benchmarks/time_repro.py --times 3

# What somebody with a board and nothing but Python waits for, and what it takes on disk.
time-install:
	$(PYTHON) tests/benchmarks/time_install.py --constraint constraints.txt

constraints: $(STAMP)
	$(BIN)/python -m release.constraints

licences: $(STAMP)
	$(BIN)/python -m release.licences

# In an environment of its own: what audits is no package of the project.
audit:
	$(PYTHON) -m venv .audit
	.audit/bin/python -m pip install --quiet --disable-pip-version-check pip-audit
	.audit/bin/pip-audit --strict --requirement constraints.txt --no-deps --disable-pip # strict: what cannot be asked about fails

# Both extras, and for the tests a server that speaks S3.
$(VENV)/.team: $(STAMP)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[dask,team]' 'moto[server]'
	@touch $@

HOST ?= 127.0.0.1
PORT ?= 5000
team-server: $(VENV)/.team
	$(BIN)/python -m deploy.team_server $(or $(FOLDER),$(error FOLDER=... is where the database and the artifacts lie)) --host $(HOST) --port $(PORT)

teams: $(VENV)/.team
	$(BIN)/python -m tests.benchmarks.teams

cluster-test: $(VENV)/.team
	$(BIN)/python -m tests.benchmarks.cluster

readme: $(STAMP)
	$(BIN)/reskin readme

clean:
	rm -rf $(VENV) .audit build .pytest_cache .mypy_cache .ruff_cache .hypothesis *.egg-info

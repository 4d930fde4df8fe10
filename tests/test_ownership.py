"""Each thing has one home: who may import what, and who may say what."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SOURCES = {str(file.relative_to(ROOT)): file.read_text() for file in (ROOT / "pipeline").rglob("*.py")}

HOMES = {
    r"\bimport mlflow|from mlflow": {"pipeline/tracking.py"},
    r"\bimport matplotlib|from matplotlib": {
        "pipeline/reporting/figures.py", "pipeline/reporting/sweeps.py", "pipeline/reporting/trade_offs.py",
        "pipeline/reporting/work_precision.py", "pipeline/reporting/experiments/ambient.py",
        "pipeline/reporting/experiments/contacts.py", "pipeline/reporting/experiments/drift.py",
        "pipeline/reporting/experiments/dynamics.py", "pipeline/reporting/experiments/flexible.py",
        "pipeline/reporting/experiments/logs.py", "pipeline/reporting/experiments/sensitivity.py",
        "pipeline/reporting/experiments/shear.py", "pipeline/reporting/experiments/sleeve.py",
        "pipeline/reporting/experiments/variation.py",
    },
    r"\bimport argparse|from argparse": {"pipeline/stages/_run.py"},
    r"\bimport typer|from typer": {"pipeline/cli.py"},
    r"optimizer\.step\(": {"pipeline/learning/train.py"},
    r"np\.random\.(?!Generator\b)|default_rng|\.manual_seed\(": {"pipeline/seeds.py"},
    r"\bimport serial|from serial": {"pipeline/capture/port.py"},
    r"ruamel": {"pipeline/strict.py", "pipeline/plan.py", "pipeline/registry.py", "pipeline/tidying.py"},
    r"\bimport torch|from torch": {
        "pipeline/learning/stack.py", "pipeline/learning/losses.py", "pipeline/learning/model.py",
        "pipeline/learning/train.py", "pipeline/learning/feed.py",
    },
    r"from sklearn": {
        "pipeline/dataset/single.py", "pipeline/dataset/splits.py", "pipeline/evaluation/oddness.py",
        "pipeline/learning/classical.py",
    },
    r"os\.environ": {
        "pipeline/learning/executors.py", "pipeline/numerics.py", "pipeline/provenance.py", "pipeline/server.py",
        "pipeline/tracking.py",
    },
    r"import pickle|torch\.load\(|allow_pickle=True": set(),
}  # fmt: skip


@pytest.mark.parametrize("word", sorted(HOMES))
def test_a_word_is_said_only_at_home(word):
    said = {name for name, text in SOURCES.items() if re.search(word, text)}
    assert said <= HOMES[word]


@pytest.mark.parametrize("name", sorted(SOURCES))
def test_a_module_fits_on_a_few_screens(name):
    assert len(SOURCES[name].splitlines()) <= 300


@pytest.mark.parametrize("name", sorted(name for name in SOURCES if name.startswith("pipeline/stages/")))
def test_a_stage_is_thin(name):
    assert len(SOURCES[name].splitlines()) <= 80


def test_every_module_says_what_it_is_for():
    assert [name for name, text in SOURCES.items() if not text.lstrip().startswith('"""')] == []

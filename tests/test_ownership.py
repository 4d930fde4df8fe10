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
        "pipeline/reporting/work_precision.py", "pipeline/experiments/ambient/show.py",
        "pipeline/experiments/contacts/show.py", "pipeline/experiments/drift/show.py",
        "pipeline/experiments/dynamics/show.py", "pipeline/experiments/flexible/show.py",
        "pipeline/experiments/logs/show.py", "pipeline/experiments/sensitivity/show.py",
        "pipeline/experiments/shear/show.py", "pipeline/experiments/sleeve/show.py",
        "pipeline/experiments/variation/show.py",
    },
    r"\bimport argparse|from argparse": {"pipeline/core/stage.py"},
    r"\bimport typer|from typer": {"pipeline/cli.py"},
    r"optimizer\.step\(": {"pipeline/learning/train.py"},
    r"np\.random\.(?!Generator\b)|default_rng|\.manual_seed\(": {"pipeline/core/seeds.py"},
    r"\bimport serial|from serial": {"pipeline/capture/port.py"},
    r"ruamel": {"pipeline/core/config.py", "pipeline/plan.py", "pipeline/registry.py", "pipeline/tidying.py"},
    r"\bimport torch|from torch": {
        "pipeline/learning/stack.py", "pipeline/learning/losses.py", "pipeline/learning/model.py",
        "pipeline/learning/train.py", "pipeline/learning/feed.py",
    },
    r"from sklearn": {
        "pipeline/dataset/single.py", "pipeline/dataset/splits.py", "pipeline/experiments/contacts/pairs.py",
        "pipeline/learning/classical.py",
    },
    r"os\.environ": {
        "pipeline/core/numerics.py", "pipeline/core/provenance.py", "pipeline/core/server.py",
        "pipeline/learning/executors.py", "pipeline/tracking.py",
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
    assert len(SOURCES[name].splitlines()) <= 90


def test_every_module_says_what_it_is_for():
    assert [name for name, text in SOURCES.items() if not text.lstrip().startswith('"""')] == []

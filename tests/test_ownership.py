"""Each thing has one home: who may import what, and who may say what. A new experiment needs no edit here."""

import re
from fnmatch import fnmatch
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SOURCES = {str(file.relative_to(ROOT / "pipeline")): file.read_text() for file in (ROOT / "pipeline").rglob("*.py")}

HOMES = {
    r"\bimport mlflow|from mlflow": ["tracking.py"],
    r"\bimport matplotlib|from matplotlib": ["reporting/*.py", "experiments/*/show.py"],
    r"\bimport argparse|from argparse": ["core/stage.py", "stages/code.py"],
    r"\bimport typer|from typer": ["cli.py", "live/commands.py"],
    r"\bimport aiohttp|from aiohttp": ["live/server.py"],
    r"\bimport socket|openpty": ["live/emulate.py"],
    r"optimizer\.step\(": ["learning/train.py", "learning/adversarial.py", "twin/training.py"],
    r"np\.random\.(?!Generator\b)|default_rng|\.manual_seed\(": ["core/seeds.py"],
    r"\bimport serial|from serial": ["capture/port.py"],
    r"ruamel": ["core/config.py", "plan.py", "registry.py", "tidying.py"],
    r"\bimport torch|from torch": [f"learning/{name}.py" for name in ("model", "train", "job", "adversarial")]
    + ["core/reproducible.py", "twin/network.py", "twin/training.py"],
    r"from sklearn": ["dataset/splits.py", "learning/regressors.py", "experiments/*.py"],
    r"os\.environ": [
        "core/numerics.py",
        "core/provenance.py",
        "core/server.py",
        "core/executors.py",
        "core/cluster.py",
        "origins.py",
        "core/progress.py",
        "tracking.py",
        "verifying.py",
    ],
    r"import pickle\b|from pickle |torch\.load\(|allow_pickle=True": [],
}  # by pattern: the files that may match it


@pytest.mark.parametrize("word", HOMES)
def test_a_word_is_said_only_at_home(word):
    said = [name for name, text in SOURCES.items() if re.search(word, text)]
    assert [name for name in said if not any(fnmatch(name, home) for home in HOMES[word])] == []

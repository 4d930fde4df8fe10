"""Test that our methods reach the scores of their entries that are committed to the benchmark.

Only dataset `simulated` is used.
"""

from pathlib import Path

import pytest

from pipeline.benchmark.entries import entry_file
from pipeline.benchmark.folds import read_dataset
from pipeline.benchmark.methods import METHODS
from pipeline.benchmark.predictions import read_predictions, write
from pipeline.benchmark.scoring import Entry, score_predictions
from reskin import io
from reskin.config import parse
from tests.benchmarks import size

NAMES = [name for name, method in METHODS.items() if "simulated" in method.datasets]


@pytest.mark.parametrize("name", size(NAMES, ["ridge regression"]))
def test_scores_of_a_committed_entry_are_reproduced(name: str, tmp_path: Path) -> None:
    data, file = read_dataset("simulated"), entry_file("simulated", name)
    committed = parse(Entry, io.read_json(file), str(file))
    write(list(METHODS[name].predict(data.tasks())), tmp_path / "again.csv")
    again = score_predictions(tmp_path / "again.csv", read_predictions(tmp_path / "again.csv"), data, committed.about)
    for task, before in zip(again.tasks, committed.tasks, strict=True):
        # The tolerance allows for networks that are trained differently on another processor. It is less than the width
        # of the intervals over boards.
        assert task.scores["accuracy_pct"]["mean"] == pytest.approx(before.scores["accuracy_pct"]["mean"], abs=2)

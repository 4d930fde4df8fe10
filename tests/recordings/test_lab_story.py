"""Tests of real recordings, from `reskin add` to the scores on held-out boards.

A board is added to the scene and removed again.
"""

import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from ruamel.yaml import YAML

from pipeline import SCENES, plan
from pipeline.manage import add
from reskin.recordings import preparing
from reskin.recordings.preparing import CaptureNames
from tests.stages.checkout import copy_checkout, run

pytestmark = pytest.mark.timeout(1800)


@pytest.fixture(scope="module")
def lab(tmp_path_factory, shared_data, empty_store) -> Iterator[Path]:
    root = copy_checkout(tmp_path_factory.mktemp("lab"))
    shutil.copy(empty_store, root / "mlflow.db")
    scene = root / SCENES / "lab.yaml"
    settings = YAML(typ="safe").load(scene.read_text())
    settings["train_multi"]["seeds_n"] = 1
    settings["train_multi"] |= {"steps_n": 100, "variants": {}}
    # A single experiment is enough, because the other experiments are tested with scene ci.
    settings |= {"experiments": ["lobo"], "split": {}}
    for section in ("train_triplet", "adapt", "rig", "new_board", "audit", "compare"):
        del settings[section]
    with scene.open("w") as stream:
        YAML().dump(settings, stream)
    plan.use(root, [])
    for board in (1, 2):
        labels = CaptureNames(f"board{board}", f"skin{board}", None)
        prepared = preparing.foreign(shared_data / f"lab/board{board}_depth2.csv", "lab", labels, {})
        add.add(root, "lab", prepared, allow_copy=False)
    plan.use(root, ["lab"])
    run(root, "dvc", "repro")
    return root


def by_board(root: Path) -> dict:
    numbers = json.loads((root / "reports/lab/numbers.json").read_text())
    assert numbers["provenance"]["source"] == "recorded"
    return numbers["lobo"]["by_board"]


def boards_in_folds(root: Path) -> set[str]:
    folds = json.loads((root / "data/models/lab/folds.json").read_text())["folds"]
    return {board for fold in folds for board in fold["test_boards"]}


def test_scene_with_two_boards_has_two_folds(lab):
    boards = by_board(lab)
    assert sorted(boards) == ["board1", "board2"]
    for parts in boards.values():
        assert parts["trained_on_skins_n"] == 1
        assert set(parts["as_labelled"]) == {"accuracy_pct", "mse_xy_mm2", "mse_f_N2", "r2_f"}


def test_board_can_be_added_and_removed(lab, shared_data):
    file = str(shared_data / "lab/board1_depth1.csv")  # This file is used as the recording of a third board.
    run(lab, "reskin", "add", file, "--layout", "lab", "--board", "board3", "--skin", "skin3", "--scene", "lab")
    output = run(lab, "dvc", "repro", "split@lab").stdout  # Stage split is the first stage that combines boards.
    assert "Stage 'ingest@lab-board1_skin1_board1_depth2' didn't change, skipping" in output
    assert boards_in_folds(lab) == {"board1", "board2", "board3"}
    run(lab, "reskin", "remove", "lab", "board3_skin3_board1_depth1")
    run(lab, "dvc", "repro", "split@lab")
    assert boards_in_folds(lab) == {"board1", "board2"}

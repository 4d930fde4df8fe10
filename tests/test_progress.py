"""Tests of the position of a stage among all stages, which each stage prints."""

from pathlib import Path

import pytest

from pipeline import plan, progress
from reskin.config import read_yaml
from tests.stages.checkout import copy_checkout

ORDER = ["code", "split@tiny", "ingest@tiny-tiny_1", "report@tiny"]


@pytest.fixture
def checkout(tmp_path, monkeypatch) -> Path:
    """Create a checkout with dvc.yaml and a plan, change to it, and return its folder."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "pipeline").mkdir()
    (tmp_path / "pipeline/plan.yaml").write_text("scenes: {tiny: [lobo]}\n")
    (tmp_path / "dvc.yaml").write_text("")
    return tmp_path


@pytest.mark.parametrize(
    ("stage", "line"),
    [("split@tiny", "stage 2 of 4"), ("dvc.yaml:report@tiny", "stage 4 of 4"), ("other@tiny", None)],
)
def test_stage_prints_its_position(checkout, monkeypatch, stage, line):
    monkeypatch.setattr(progress, "_ask_dvc", lambda: ORDER)
    monkeypatch.setenv(progress.VARIABLE, stage)
    assert progress.stage_position() == line


def test_positions_are_computed_again_after_a_change_of_the_plan(checkout, monkeypatch):
    for stages in (ORDER, ORDER[:2]):
        monkeypatch.setattr(progress, "_ask_dvc", lambda stages=stages: stages)
        assert progress.stages_in_order() == stages
        with (checkout / "pipeline/plan.yaml").open("a") as plan:
            plan.write("stages: {}\n")


def test_unknown_position_is_printed_as_unknown(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv(progress.VARIABLE, "split@tiny")
    assert "unknown (FileNotFoundError" in progress.stage_position()


def test_stage_outside_dvc_prints_nothing(monkeypatch):
    monkeypatch.delenv(progress.VARIABLE, raising=False)
    assert progress.stage_position() is None


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # libraries that DVC uses cause warnings
def test_stages_that_table_2_needs_run_before_all_other_stages(tmp_path, monkeypatch):
    root = copy_checkout(tmp_path)
    plan.use(root, ["ci"])
    monkeypatch.chdir(root)
    order = progress.stages_in_order()
    needed = {"code", "simulate@ci", "ingest_simulated@ci", "split@ci", "train_single@ci", "train_multi@ci",
              "train_triplet@ci", "adapt@ci"}  # fmt: skip
    assert set(order[: order.index("table2@ci")]) == needed
    planned = read_yaml(Path("pipeline/plan.yaml"))["stages"]
    assert len(order) == 1 + sum(len(keys) for keys in planned.values())
    monkeypatch.setattr(progress, "_ask_dvc", lambda: pytest.fail("DVC must not be asked again"))
    assert progress.stages_in_order() == order

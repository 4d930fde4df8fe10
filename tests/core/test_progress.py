"""Which stage of how many, and how long the rest may take."""

import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.core import progress
from pipeline.core.config import PLAN, read_yaml
from pipeline.core.provenance import COSTS
from tests.stages.checkout import ROOT, copy_checkout, run

ORDER = ["code", "simulate@tiny", "simulate@tiny-wear", "report@tiny"]


@given(st.lists(st.floats(0, 1e4), min_size=4, max_size=4))
def test_what_is_left_shrinks_from_stage_to_stage(seconds):
    took_s = dict(zip(ORDER, seconds, strict=True))
    left = [int(progress.describe(stage, ORDER, took_s).split("about ")[1].split()[0]) for stage in ORDER]
    assert left == sorted(left, reverse=True)


def test_nothing_is_said_of_time_before_the_first_run():
    assert progress.describe("simulate@tiny", ORDER, {}) == "stage 2 of 4"


def test_a_fresh_clone_tells_a_time_for_all_but_the_stages_that_are_read_before_they_end(monkeypatch):
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(progress, "home", lambda: ROOT / "no costs of its own")
    order = ["code", *(f"{stage}@{key}" for stage, keys in read_yaml(Path(PLAN))["stages"].items() for key in keys)]
    assert set(order) - set(progress.read_seconds(order)) <= {"code", "report@quick", "publish@quick"}


def test_what_cannot_be_told_is_said_and_ends_no_stage(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv(progress.VARIABLE, "split@tiny")
    assert "cannot be told (FileNotFoundError" in progress.announce()


def test_seconds_are_those_of_the_last_run_here_and_else_the_committed_ones(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("pipeline").mkdir()
    Path("pipeline/plan.yaml").write_text("scenes: {tiny: [lobo]}\n")
    stages = {"simulate-wear": {"seconds": 8.0, "computed_s": 8.0}, "report": {"seconds": 5.0, "computed_s": 30.0}}
    stages["code"] = {"seconds": 1.0}  # as older code wrote them
    committed = {"runtime": {"stages": stages}}
    for file, words in {
        Path("reports/tiny/provenance.json"): committed,
        COSTS / "tiny/report.json": {"seconds": 2.0, "trainings_s": {"a": 9.0}},
    }.items():
        file.parent.mkdir(parents=True)
        file.write_text(json.dumps(words))
    assert progress.read_seconds(ORDER) == {"simulate@tiny-wear": 8.0, "report@tiny": 4.5}


def test_a_stage_that_a_person_starts_says_nothing(monkeypatch):
    monkeypatch.delenv(progress.VARIABLE, raising=False)
    assert progress.announce() is None


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of DVC's own libraries
def test_table_2_comes_before_every_further_protocol_and_dvc_is_asked_once(tmp_path, monkeypatch):
    root = copy_checkout(tmp_path)
    run(root, "reskin", "scenes", "use", "ci")
    monkeypatch.chdir(root)
    order = progress.stages_in_order()
    needed = {"code", "simulate@ci", "ingest_simulated@ci", "split@ci", "train_single@ci", "train_multi@ci",
              "train_triplet@ci", "adapt@ci"}  # fmt: skip
    assert set(order[: order.index("table2@ci")]) == needed
    planned = read_yaml(Path("pipeline/plan.yaml"))["stages"]
    assert len(order) == 1 + sum(len(keys) for keys in planned.values())
    monkeypatch.setattr(progress, "_ask_dvc", lambda: pytest.fail("asked DVC again"))
    assert progress.stages_in_order() == order

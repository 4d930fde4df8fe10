"""Which stage of how many, and how long the rest may take."""

import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline import PLAN, progress
from pipeline.progress import settings_of
from pipeline.provenance import COSTS
from pipeline.stage import run as run_stage
from reskin import io
from reskin.config import read_yaml
from tests.stages.checkout import copy_checkout, run

ORDER = ["code", "simulate@tiny", "simulate@tiny-wear", "report@tiny"]


@pytest.fixture
def checkout(tmp_path, monkeypatch) -> Path:
    """A checkout of one scene, in which no stage ran; it is the working directory."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "pipeline/scenes").mkdir(parents=True)
    (tmp_path / PLAN).write_text("scenes: {tiny: [lobo]}\ncaptures: {tiny: [a]}\nstages: {split: [tiny]}\n")
    (tmp_path / "pipeline/scenes/tiny.yaml").write_text("steps_n: 100 # a hundred\n")
    (tmp_path / "params.yaml").write_text("rate: 1e-3\n")
    (tmp_path / "dvc.yaml").write_text("")
    return tmp_path


class Clock:
    """A made-up clock, by which each stage takes as long as it is told to."""

    now_s = 0.0

    def monotonic(self) -> float:
        return self.now_s

    def run(self, monkeypatch, stage: str, seconds: float) -> str:
        """Run a stage as DVC does; give what it says at its start."""

        def work(indentations: Path) -> None:
            self.now_s += seconds

        said = []
        work.__name__ = stage.partition("@")[0]
        monkeypatch.setenv(progress.VARIABLE, stage)
        monkeypatch.setattr(progress, "_ask_dvc", lambda: ["code", "split@tiny", "ingest@tiny-tiny_1", "report@tiny"])
        monkeypatch.setattr("pipeline.stage.time", self)
        monkeypatch.setattr("pipeline.stage.say", said.append)
        run_stage(work, ["--scene", "tiny", "--indentations", "tiny_1.parquet"])
        return said[0].partition(": ")[2]


def run_all(monkeypatch) -> list[str]:
    """Run three stages that take 10, 30 and 1 min by a made-up clock; give what each says."""
    took_min = {"split@tiny": 10, "ingest@tiny-tiny_1": 30, "report@tiny": 1}
    return [Clock().run(monkeypatch, stage, minutes * 60.0) for stage, minutes in took_min.items()]


PLACES = ["stage 2 of 4", "stage 3 of 4", "stage 4 of 4"]


def test_a_second_run_with_the_same_settings_says_what_the_first_took(checkout, monkeypatch):
    assert run_all(monkeypatch) == PLACES
    (checkout / "pipeline/scenes/tiny.yaml").write_text("steps_n: 100 # the same number\n")
    left_min = [41, 31, 1]
    basis = "by what it took here with these settings"
    assert run_all(monkeypatch) == [
        f"{place}; at most about {minutes} min left, {basis}" for place, minutes in zip(PLACES, left_min, strict=True)
    ]


@pytest.mark.parametrize(
    ("file", "text"),
    [
        ("pipeline/scenes/tiny.yaml", "steps_n: 9000\n"),
        ("params.yaml", "rate: 2e-3\n"),
        (PLAN, "scenes: {tiny: [lobo]}\ncaptures: {tiny: [a, b]}\nstages: {split: [tiny]}\n"),
    ],
)
def test_times_with_other_settings_or_captures_are_no_basis_for_an_estimate(checkout, monkeypatch, file, text):
    run_all(monkeypatch)
    (checkout / file).write_text(text)
    assert run_all(monkeypatch) == PLACES


def test_a_stage_that_never_ended_leaves_the_whole_without_an_estimate(checkout, monkeypatch):
    for stage in ("split@tiny", "ingest@tiny-tiny_1"):  # and no report: the run was stopped
        Clock().run(monkeypatch, stage, 60.0)
    assert [Clock().run(monkeypatch, stage, 60.0) for stage in ("split@tiny", "ingest@tiny-tiny_1")] == PLACES[:2]


def test_committed_results_of_another_machine_are_no_basis_for_an_estimate(checkout, monkeypatch):
    stages = {name: {"seconds": 60.0, "computed_s": 60.0} for name in ("split", "ingest-tiny_1", "report")}
    (checkout / "reports/tiny").mkdir(parents=True)
    (checkout / "reports/tiny/numbers.json").write_text(json.dumps({"runtime": {"stages": stages}}))
    assert run_all(monkeypatch) == PLACES


def test_trainings_that_were_not_repeated_count_as_long_as_they_took_once(checkout):
    cost = {"seconds": 2.0, "other_s": 1.0, "trainings_s": {"a": 9.0, "b": 5.0}}
    for unit, reused_n in (("train", 2), ("adapt", 0)):
        io.write_json(COSTS / f"tiny/{unit}.json", cost | {"reused_n": reused_n, "settings": settings_of("tiny")})
    assert progress.read_seconds(["train@tiny", "adapt@tiny"]) == {"train@tiny": 15.0, "adapt@tiny": 2.0}


@given(st.lists(st.floats(0, 1e4), min_size=4, max_size=4))
def test_what_is_left_shrinks_from_stage_to_stage(seconds):
    took_s = dict(zip(ORDER, seconds, strict=True))
    left = [int(progress.describe(stage, ORDER, took_s).split("about ")[1].split()[0]) for stage in ORDER]
    assert left == sorted(left, reverse=True)


def test_what_cannot_be_told_is_said_and_ends_no_stage(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv(progress.VARIABLE, "split@tiny")
    assert "cannot be told (FileNotFoundError" in progress.announce()


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

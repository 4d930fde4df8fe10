"""Tests of the estimated progress of a run: which stages count, their expected times, the printed sentence."""

import hashlib
import json
import os
import re

import pytest
from ruamel.yaml import YAML

from pipeline.manage import remaining, running
from pipeline.manage.remaining import expected_seconds, planned, progress
from reskin import io
from tests.stages.checkout import ROOT, copy_checkout, run

ORDER = ["code", "simulate@tiny-wear", "train_multi@tiny", "report@tiny", "publish@tiny"]
NONE = {"trainings_n": 0, "reused_n": 0}
COSTS = {
    "simulate-wear": {"seconds": 28.5, "cpu_s": 31.0, "computed_s": 28.5, **NONE},
    "train_multi": {"seconds": 8.5, "cpu_s": 8.5, "computed_s": 108.5, "trainings_n": 6, "reused_n": 6},
    "report": {"seconds": 50.0, "cpu_s": 8.5, "computed_s": 50.0, **NONE},  # The machine was busy during this stage.
}
EXPECTED_S = {
    "code": 1.5,
    "simulate@tiny-wear": 30.0,
    "train_multi@tiny": 60.0,
    "report@tiny": 10.0,
    "publish@tiny": 1.5,
}


def md5(text: str) -> str:
    return hashlib.md5(text.encode()).hexdigest()


@pytest.fixture
def checkout(tmp_path, monkeypatch):
    """Create a checkout in which a run of scene tiny is finished, change to it, and return its folder."""
    stages = {
        "code": {"outs": [{"path": "data/code"}]},
        "simulate@tiny-wear": {"deps": [], "outs": [{"path": "data/raw/tiny-wear"}]},
        "train_multi@tiny": {
            "deps": [{"path": "data/code/train_multi", "md5": md5("a")}, {"path": "data/raw/tiny-wear"}],
            "params": {"params.yaml": {"recipes.paper": {"steps_n": 9}}},
            "outs": [{"path": "data/models/tiny/train_multi"}],
        },
        "report@tiny": {"deps": [{"path": "data/models/tiny"}], "outs": [{"path": "reports/tiny/numbers.json"}]},
        "publish@tiny": {"deps": [{"path": "reports/tiny/numbers.json"}]},
    }
    for stage in stages.values():
        for out in stage.get("outs", ()):
            io.write_text(tmp_path / out["path"] / "file" if "." not in out["path"] else tmp_path / out["path"], "{}")
    with (tmp_path / "dvc.lock").open("w") as lock:
        YAML(typ="safe").dump({"stages": stages}, lock)
    io.write_text(tmp_path / "data/code/train_multi", "a")
    io.write_text(tmp_path / "params.yaml", "recipes: {paper: {steps_n: 9}, other: {steps_n: 1}}\n")
    io.write_json(tmp_path / "reports/tiny/provenance.json", {"runtime": {"stages": COSTS}})
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(remaining, "stages_in_order", lambda: ORDER)
    return tmp_path


@pytest.fixture
def start(checkout, monkeypatch):
    """Return a function that starts a stage at a time in seconds and returns the sentence on the progress."""
    now = [0.0]
    monkeypatch.setattr(remaining.time, "time", lambda: now[0])

    def stage(name: str, time_s: float, command: str = "dvc repro", pid: int | None = None) -> str | None:
        now[0] = time_s
        entry = {"pid": pid or os.getpid(), "cmd": command}
        io.write_json(checkout / running.DVC_FILES / running.RWLOCK, {"write": {"data/out": entry}, "read": {}})
        monkeypatch.setenv(remaining.VARIABLE, name)
        return progress()

    return stage


def minutes_left(sentence: str) -> float:
    value, unit = re.search(r"about ([\d.]+) (s|min) left", sentence).groups()
    return float(value) / (60 if unit == "s" else 1)


@pytest.mark.parametrize(
    ("change", "stages"),
    [
        (lambda root: None, ["simulate@tiny-wear", *ORDER[2:]]),
        (lambda root: io.write_text(root / "params.yaml", "recipes: {paper: {steps_n: 8}}\n"), ORDER[1:]),
    ],
)
def test_stages_after_a_running_stage_are_planned(checkout, change, stages):
    change(checkout)
    assert planned(checkout, ORDER[1], ORDER[1:]) == stages


@pytest.mark.parametrize(
    ("change", "stages"),
    [
        (lambda root: None, ["code"]),
        (lambda root: io.write_text(root / "params.yaml", "recipes: {paper: {steps_n: 8}}\n"), ["code", *ORDER[2:]]),
        (lambda root: io.write_text(root / "data/code/train_multi", "b"), ["code", *ORDER[2:]]),
        (lambda root: io.remove(root / "reports/tiny/numbers.json"), ["code", "report@tiny", "publish@tiny"]),
        (lambda root: io.remove(root / "dvc.lock"), ORDER),
    ],
)
def test_stages_with_a_changed_setting_code_or_output_are_planned(checkout, change, stages):
    change(checkout)
    assert planned(checkout, "code", ORDER) == stages


def test_expected_seconds_come_from_the_last_report(checkout):
    assert expected_seconds(checkout, ORDER) == EXPECTED_S
    assert expected_seconds(checkout, ["split@mine"]) == {"split@mine": None}


def test_remaining_time_is_exact_at_the_recorded_speed(checkout, start):
    (checkout / "dvc.lock").unlink()
    time_s = 100.0
    for stage in ORDER:
        left_s = sum(EXPECTED_S[name] for name in ORDER[ORDER.index(stage) :])
        # The sentence gives the time with one decimal.
        assert minutes_left(start(stage, time_s)) == pytest.approx(left_s / 60, abs=0.06)
        time_s += EXPECTED_S[stage]


@pytest.mark.parametrize("slower", [0.25, 4.0])
def test_remaining_time_is_within_a_factor_of_two_on_other_machines(checkout, start, slower):
    (checkout / "dvc.lock").unlink()
    start(ORDER[0], 0.0)
    start(ORDER[1], 1.5 * slower)
    sentence = start(ORDER[2], 31.5 * slower)
    # The stages that have ended account for 31.5 of the expected 103 s.
    assert sentence.startswith("progress: 31 % after ")
    assert 0.5 < minutes_left(sentence) / (71.5 * slower / 60) < 2


def test_remaining_time_excludes_other_scenes_and_stages_after_the_target(checkout, start, monkeypatch):
    (checkout / "dvc.lock").unlink()
    monkeypatch.setattr(remaining, "stages_in_order", lambda: [*ORDER[:2], "split@other", *ORDER[2:]])
    sentence = start(ORDER[0], 0.0, "/usr/bin/dvc repro train_multi@tiny")
    assert minutes_left(sentence) == pytest.approx(91.5 / 60, abs=0.06)


def test_progress_starts_again_with_the_next_run(checkout, start):
    (checkout / "dvc.lock").unlink()
    start(ORDER[0], 0.0)
    start(ORDER[1], 1.5)
    assert "progress: about 1.7 min left" in start(ORDER[0], 5000.0)


def test_progress_of_a_scene_without_report_is_unknown(checkout, start):
    (checkout / "dvc.lock").unlink()
    (checkout / "reports/tiny/provenance.json").unlink()
    assert start(ORDER[1], 0.0) is None


def test_stage_outside_dvc_prints_nothing(checkout, monkeypatch):
    monkeypatch.delenv(remaining.VARIABLE, raising=False)
    assert progress() is None
    monkeypatch.setenv(remaining.VARIABLE, ORDER[1])  # The variable is set, but no `dvc repro` runs.
    assert progress() is None


def test_stage_prints_the_progress_of_its_run(tmp_path):
    root = copy_checkout(tmp_path / "copy")
    for file in ("dvc.lock", "reports/quick/provenance.json"):
        io.write_text(root / file, (ROOT / file).read_text())
    entry = {"pid": os.getpid(), "cmd": "dvc repro table2@quick"}
    io.write_json(root / running.DVC_FILES / running.RWLOCK, {"write": {"data/code": entry}, "read": {}})
    done = run(root, "python", "-m", "pipeline", "code", "--digests", "data/code", DVC_STAGE="code")
    assert minutes_left(done.stderr) > 0


def test_broken_state_file_does_not_stop_a_stage(checkout, start):
    io.write_text(remaining.STATE, json.dumps({"process": os.getpid()}))
    assert "the remaining time is unknown (KeyError" in start(ORDER[1], 0.0)

"""Tests that run the whole pipeline on scene ci, the small scene for tests.

They check the results, repeated and killed runs, deleted outputs, and wrong settings.
"""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest

from pipeline.catalogue import ANALYSES
from reskin import io
from reskin.models.inputs import Scaler
from tests.compiled import compile_kernels
from tests.sizes import FULL
from tests.stages.checkout import ENVIRONMENT, copy_checkout, run, warm_stages

EXPERIMENTS_OF_CI = set(ANALYSES) - {"compare"}  # scene ci runs all experiments except this, which needs recordings
OUTPUT = "output.txt"  # file with the output of the first run
# The time limit (in s) ends tests that hang. It is long, because a busy machine can be four times as slow as an idle
# one.
pytestmark = pytest.mark.timeout(1800)
slow = pytest.mark.skipif(not FULL, reason="slow: run `make bench`")


@pytest.fixture(scope="module")
def checkout(tmp_path_factory) -> Path:
    compile_kernels()
    folder = copy_checkout(tmp_path_factory.mktemp("story"))
    run(folder, "reskin", "scenes", "use", "ci")
    return folder


@pytest.fixture(scope="module")
def run_stages(checkout) -> Iterator[Callable[..., str]]:
    with warm_stages(checkout) as run_stages:
        yield run_stages


@pytest.fixture(scope="module")
def story(checkout, run_stages) -> Path:
    (checkout / OUTPUT).write_text(run_stages())
    return checkout


@pytest.fixture
def numbers(story) -> dict[str, Any]:
    return json.loads((story / "reports/ci/numbers.json").read_text())


def test_report_contains_provenance_scores_and_byte_counts(story, numbers):
    assert numbers["provenance"]["source"] == "simulated"
    provenance = json.loads((story / "reports/ci/provenance.json").read_text())
    assert {"git", "trained", "device", "versions", "runtime"} == set(provenance)
    for row in ("single", "multi", "triplet", "adapted"):
        for metric in ("accuracy_pct", "mse_xy_mm2", "mse_f_N2"):
            assert {"mean", "sd", "n"} <= set(numbers["table2"][row][metric])
    assert numbers["table2"]["multi"]["accuracy_pct"]["n"] == 3  # n counts boards
    assert {"mean", "sd"} <= set(numbers["single_sensor"]["accuracy_pct"])
    capture = numbers["capture"]
    skipped = sum(n for key, n in capture.items() if key.startswith("skipped_") and key.endswith("_bytes_n"))
    assert capture["frame_bytes_n"] + skipped == capture["bytes_n"]
    assert "<svg" in (story / "data/reports/ci/figures/error_grid_lobo.svg").read_text()


def test_dvc_metrics_equal_the_numbers_of_the_report(story, numbers):
    shown = json.loads(run(story, "dvc", "metrics", "show", "--json").stdout)
    scores = shown[""]["data"]["reports/ci/scores.json"]["data"]
    assert set(scores) == {"table2", "single_sensor", "shear", "new_board"}
    assert set(scores["table2"]) == {"single", "multi", "triplet", "adapted"}
    assert scores["table2"]["multi"]["mse_xy_mm2"] == numbers["table2"]["multi"]["mse_xy_mm2"]["mean"]


def test_experiments_on_many_skins_have_scores_for_each_board(story, numbers):
    assert [row["pokes_n"] for row in numbers["sweep_pokes"]] == [0, 30, 65]
    assert {(row["method"], row["skins_n"]) for row in numbers["sweep_sensors"]} == {
        (method, skins_n) for method in ("multi", "triplet", "adapted") for skins_n in (1, 4)
    }
    assert {(row["of"], row["over"]) for row in numbers["paired"]} >= {("triplet", "multi"), ("adapted", "triplet")}
    boards_n = {(row["of"], row["over"]): row["accuracy_pct"]["n"] for row in numbers["paired"]}
    # The networks of experiment `single` are trained on one skin. The skin is from the first or from the second board,
    # and the test skins are on the third board.
    assert boards_n.pop(("multi", "single")) == 1
    assert set(boards_n.values()) == {3}
    assert all(len(row["by_board"]) == row["accuracy_pct"]["n"] for row in numbers["paired"])
    assert all(row["accuracy_pct"]["n"] == 3 for row in [*numbers["sweep_sensors"], *numbers["sweep_pokes"]])
    shipped = [row for row in numbers["new_board"] if row["method"] == "shipped"]
    assert {row["labels_n"] for row in shipped} == {0, 1, 10}
    assert all({*row["accuracy_pct"]["by_board"]} == {"b0", "b1", "b2"} for row in shipped)
    assert all(check["holds"] or check["known"] for check in numbers["audit"])
    rows_n = {
        json.loads(file.read_text())["scores"]["rows_n"]
        for stage_name in ("train_multi", "train_triplet")
        for file in (story / f"data/models/ci/{stage_name}").glob("*.json")
    }
    assert rows_n == {2 * 130 * 5}  # two skins x 130 presses of the second pass x 5 readings
    for name in ("sweep_pokes", "sweep_sensors"):
        assert "<svg" in (story / f"data/reports/ci/figures/{name}.svg").read_text()


def test_every_experiment_has_numbers_tables_and_figures(story, numbers):
    assert EXPERIMENTS_OF_CI <= set(numbers)
    for policy in ("initial", "regular", "each"):
        assert [row["contacts_n"] for row in numbers["drift"][policy]] == [100, 200]
        assert all({"accuracy_pct", "mse_f_N2"} <= set(row) for row in numbers["drift"][policy])
    assert all("mean" in numbers["shear"][name] for name in ("mse_xy_mm2", "mse_fxy_N2", "mse_fz_N2"))
    for experiment, parts in {"manual": ("before", "after", "control"), "flexible": ("before", "after")}.items():
        assert all("mean" in numbers[experiment][part]["accuracy_pct"] for part in parts)
    assert {"by_indentation", "by_pass"} <= set(numbers["single_sensor"])
    tables = story / "reports/ci/tables"
    named = {file.stem for file in tables.glob("*.csv")}
    assert named >= EXPERIMENTS_OF_CI - {"interference"} | {"table1", "claims", "single_sensor"}
    assert named >= {"interference_contacts", "interference_places"}
    page = (story / "reports/ci/index.html").read_text()
    figures = sorted((story / "data/reports/ci/figures").glob("*.svg"))
    without = {"audit", "extremes", "accuracy_and_cost", "drift", "variation", "manual"}  # a figure of the same name
    assert {file.stem for file in figures} >= EXPERIMENTS_OF_CI - without
    assert all(f'<figure id="{figure.stem}">' in page for figure in figures)
    assert "More figures" not in page
    assert "More tables" not in page


def test_only_provenance_and_the_page_of_the_run_depend_on_commit_machine_and_times(story, tmp_path):
    again = tmp_path / "again"
    shutil.copytree(
        story, again, symlinks=True, ignore=shutil.ignore_patterns(".dvc", "raw", "mlflow.db", "mlartifacts")
    )
    for file in (again / ".reskin").glob("*/ci/*.json"):
        text = re.sub(r"(?<=: )\d+\.\d+(e-?\d+)?", lambda match: str(3 * float(match[0]) + 1), file.read_text())
        file.write_text(text)
    author = ("-c", "user.name=a", "-c", "user.email=a@b")
    for arguments in (["init", "-q"], ["add", "pipeline", "reskin"], [*author, "commit", "-qm", "x"]):
        subprocess.run(["git", *arguments], cwd=again, check=True)
    arguments = ["--scene", "ci", "--indentations", "data/indentations/ci", "--folds", "data/models/ci/folds.json",
             "--models", "data/models/ci", "--scores", "data/scores/ci", "--results", "data/results/ci",
             "--reports", "reports/ci", "--figures", "data/reports/ci/figures"]  # fmt: skip
    on_one_core = "import os, runpy; os.sched_setaffinity(0, [min(os.sched_getaffinity(0))]); "
    on_one_core += "runpy.run_module('pipeline', run_name='__main__', alter_sys=True)"
    run(again, "python", "-c", on_one_core, "report", *arguments)
    before, after = (
        {str(file.relative_to(reports)): file.read_bytes() for file in reports.rglob("*") if file.is_file()}
        for reports in (story / "reports", again / "reports")
    )
    assert after.keys() == before.keys()
    changed = {name for name in after if after[name] != before[name]}
    assert changed == {"ci/provenance.json", "ci/run.html"}


def test_reskin_predict_estimates_contacts_from_a_log_of_an_sd_card(story):
    model = min((story / "data/models/ci/train_multi").glob("lobo.paper.b0.*.safetensors"))
    (log,) = (story / "data/raw/ci-log").glob("*/log.csv")
    run(story, "reskin", "predict", str(log), "--model", str(model), "--out", "contacts.csv")
    estimates, readings = (pd.read_csv(file) for file in (story / "contacts.csv", log))
    assert len(estimates) == len(readings)
    contact = estimates["contact"].astype(bool)
    assert 0.1 < contact.mean() < 0.9  # the log of a walk has rest, steps and swings
    assert np.isfinite(estimates.loc[contact, ["x_mm", "y_mm", "F_N"]]).all(axis=None)


def test_each_capture_has_a_parquet_file_with_units(story):
    files = sorted((story / "data/indentations/ci").glob("*.parquet"))
    assert [file.stem for file in files] == ["b0_s0", "b0_s1", "b1_s0", "b1_s1", "b2_s0", "b2_s1"]
    assert pq.read_schema(files[0]).field("b_uT").metadata[b"unit"] == b"uT"


def test_score_equals_the_score_computed_by_a_naive_loop(story):
    card = json.loads((story / "data/models/ci/train_multi/lobo.paper.b1.seed0.json").read_text())
    predictions = pq.read_table(story / "data/models/ci/train_multi/predictions.parquet").to_pylist()
    predicted = [row for row in predictions if (row["recipe"], row["fold"], row["seed_i"]) == ("paper", "b1", 0)]
    truths = []
    for skin in ("b1_s0", "b1_s1"):
        for reading in pq.read_table(story / f"data/indentations/ci/{skin}.parquet").to_pylist():
            # The first pass is kept for adaptation, and the scene selects forces of 0 N or more.
            if reading["pass_i"] >= 1 and reading["Fz_N"] >= 0:
                truths.append((skin, reading["x_mm"], reading["y_mm"], reading["Fz_N"]))
    assert [(row["skin"], row["true_x_mm"], row["true_y_mm"], row["true_Fz_N"]) for row in predicted] == truths
    hits = sum(
        abs(row["predicted_x_mm"] - x_mm) <= 1 and abs(row["predicted_y_mm"] - y_mm) <= 1
        for row, (_, x_mm, y_mm, _) in zip(predicted, truths, strict=True)
    )
    assert card["scores"]["all"]["accuracy_pct"] == pytest.approx(100 * hits / len(truths))


def test_saved_predictions_equal_those_computed_from_the_saved_weights(story):
    folder = story / "data/models/ci/train_multi"
    tensors, _ = io.read_tensors(folder / "lobo.paper.b1.seed0.safetensors")
    reading = pq.read_table(story / "data/indentations/ci/b1_s0.parquet").filter(pc.field("pass_i") == 1).slice(0, 1)
    reading = reading.to_pylist()[0]
    scaler = Scaler.of_arrays(tensors)
    features = scaler.encode(np.array([reading["b_uT"]], np.float32) - np.array([reading["noload_uT"]], np.float32))[0]
    for i in range(1, 7):
        features = tensors[f"layer{i}.weight"] @ features + tensors[f"layer{i}.bias"]
        # a ReLU after the layers that have one in the paper
        features = np.maximum(features, 0) if i in (1, 4, 5) else features
    expected = scaler.decode(features[None].astype(np.float32))[0]
    first = pq.read_table(folder / "predictions.parquet").filter(pc.field("fold") == "b1").slice(0, 1).to_pylist()[0]
    # The tolerance allows for single-precision sums in another order.
    assert [first[f"predicted_{name}"] for name in ("x_mm", "y_mm", "Fz_N")] == pytest.approx(expected, abs=1e-3)


def test_dvc_repro_restores_deleted_models_without_running_stages(story):
    models = sorted((story / "data/models/ci/train_multi").iterdir())
    content = models[0].read_bytes()
    for file in models:
        file.unlink()
    for file in (story / ".reskin/cells").glob("*.safetensors"):
        file.unlink()
    output = run(story, "dvc", "repro").stdout
    assert "Stage 'train_multi@ci' is cached" in output
    assert "Running stage" not in output
    assert models[0].read_bytes() == content
    assert list((story / ".reskin/cells").glob("*.safetensors")) == []


def test_stage_that_was_killed_does_not_repeat_finished_training_runs(story):
    models = story / "data/models/killed"
    arguments = ["--scene", "ci", "--indentations", "data/indentations/ci",
             "--folds", "data/models/ci/folds.json", "--models", str(models),
             "--scores", str(models.with_suffix(".parquet")), "--plots", str(story / "data/plots/killed")]  # fmt: skip
    command = [sys.executable, "-m", "pipeline", "train_triplet", *arguments]
    environment = {**os.environ, **ENVIRONMENT, "PYTHONPATH": str(story), "RESKIN_EXECUTOR": "processes:1"}
    trials = story / ".reskin/cells"
    for file in trials.glob("*.safetensors"):
        file.unlink()

    def finished() -> int:  # more than 0 if all three networks of a stack (trained together) have been written
        stacks = Counter(file.stem.rpartition("-")[0] for file in trials.glob("*.safetensors"))
        return sum(written_n for written_n in stacks.values() if written_n == 3)

    stage = subprocess.Popen(command, cwd=story, env=environment, stderr=subprocess.DEVNULL)
    while not finished():
        time.sleep(0.005)
        assert stage.poll() is None, "the stage ended before it could be killed"
    stage.send_signal(signal.SIGKILL)
    stage.wait()
    finished_n = finished()
    assert not models.exists()
    environment |= ENVIRONMENT  # the remaining training runs run in the process of the stage
    again = subprocess.run(command, cwd=story, env=environment, capture_output=True, text=True, check=True)
    assert f"{finished_n} of 6 training runs were finished before" in again.stderr
    assert len(list(models.glob("*.safetensors"))) == 6


def test_unknown_parameter_is_reported_without_traceback(story, run_stages):
    scene = story / "pipeline/scenes/ci.yaml"
    before = scene.read_text()
    scene.write_text(before.replace("random_repeats_n:", "random_repeets_n:"))
    output = run_stages("split@ci", succeed=False)
    scene.write_text(before)
    assert "split: random_repeets_n is not a known parameter (its value: 2)" in output
    assert "Traceback" not in output

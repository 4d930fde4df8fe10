"""Tests of the benchmark: frozen folds, files of predictions, scores, entries and our own methods."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from pipeline import benchmark
from pipeline.benchmark import draw, entries, folds, methods
from pipeline.benchmark.folds import Dataset, FoldFile, Presses, read_dataset, read_folds, write_simulated
from pipeline.benchmark.predictions import read_predictions
from pipeline.benchmark.scoring import About, score_file, score_predictions
from pipeline.cli import app
from reskin import io
from reskin.config import parse
from reskin.errors import ReskinError, SchemaError

# The SHA-256 of the files of published versions. These files never change: for a correction, a new version is added.
PUBLISHED = {
    "v1/eflesh.json": "d7aeb2c6e57811c916b9bfadc59e30d226c6314ec7401d17a9fdd82479e28f6b",
    "v1/lab.json": "b5a0b3cdf9a882aa4ea66765a2ffbc6ec828183af4ff9e7d8468eff973ad71b7",
    "v1/simulated.json": "870a584d929bce827727cd10070b53aea923e2bdf63f729471a7d0b70ec7fd36",
    "v1/simulated.parquet": "76c2ce37a37876aeafcabc37b3c483c44349b6acfd050f9ac7cce86fb7aebe5c",
}
ABOUT = About(method="mine", by="A. Name", trained_on="labels", code="none")


def test_files_of_published_versions_have_not_changed():
    found = {f"v{version}/{file.name}" for version in (1,) for file in (folds.FOLDER / f"v{version}").iterdir()}
    assert found == set(PUBLISHED)
    assert {name: io.sha256(folds.FOLDER / name) for name in PUBLISHED} == PUBLISHED


@pytest.mark.parametrize("dataset", ["lab", "eflesh", "simulated"])
def test_each_press_has_only_one_role_in_a_fold(dataset):
    content = read_folds(dataset)
    for one in content.draws:
        assert one.board not in one.train
        assert not set(one.tests) & {*one.unlabelled, *one.labels}
        for numbers in (one.tests, one.labels, one.unlabelled):
            assert len(set(numbers)) == len(numbers)
            assert set(numbers) <= set(range(content.presses_n[one.board]))
        assert len(one.labels) == max(content.labels_n)


def recordings(shared_data: Path, dataset: str) -> Path:
    return shared_data / {"lab": "lab", "eflesh": "eflesh/spatial_resolution"}[dataset]


@pytest.fixture(scope="module")
def lab(shared_data) -> Dataset:
    return read_dataset("lab", recordings(shared_data, "lab"))


def test_published_folds_of_lab_recordings_equal_those_that_the_code_draws(lab):
    drawn = draw.draw_lab(list(lab.folds.recordings), lab.presses)
    content = json.loads((folds.FOLDER / "v1/lab.json").read_text())
    assert {name: content[name] for name in drawn} == json.loads(json.dumps(drawn))


def test_eflesh_recordings_are_tested_on_their_last_pass(shared_data):
    (task,) = benchmark.tasks("eflesh", recordings(shared_data, "eflesh"))
    assert (len(task.labels), len(task.tests_uT), len(task.train)) == (4 * 961, 961, 0)
    assert np.unique(task.labels.place_mm[:961], axis=0).shape == (961, 2)  # Each pass visits each place once.
    assert np.isnan(task.labels.force_N).all()


def test_tested_presses_of_lab_recordings_are_far_from_labels(lab):
    for one in lab.folds.draws:
        place_mm = lab.presses[one.board].place_mm
        tests_mm, labels_mm = place_mm[list(one.tests)], place_mm[list(one.labels)]
        assert np.linalg.norm(tests_mm[:, None] - labels_mm, axis=2).min() >= 2  # Places are 2 mm apart.
    assert len(lab.readings["board1"]) == 195 * 100
    assert lab.presses["board1"].recording.tolist() == [0] * 65 + [1] * 65 + [2] * 65


def test_task_contains_only_the_data_that_a_method_may_use():
    data = read_dataset("simulated")
    one = data.folds.draws[0]
    task = data.task(one, 10)
    own = data.presses[one.board]
    assert task.labels.press.tolist() == list(one.labels[:10])
    assert set(task.train.board) == {f"train{i}" for i in range(40)}
    np.testing.assert_array_equal(task.tests_uT, own.db_uT[list(one.tests)])
    np.testing.assert_allclose(task.noload_uT, own.noload_uT[list(one.unlabelled)].mean(axis=0))
    assert "\n" not in repr(task)
    with pytest.raises(SchemaError, match="place_mm has shape"):
        task.predictions([[8.0, 8.0]])


def test_recording_that_was_changed_is_refused(shared_data, tmp_path):
    for name in (f"board{board}_depth{depth}.csv" for board in (1, 2) for depth in (1, 2, 3)):
        (tmp_path / name).symlink_to(shared_data / "lab" / name)
    changed = tmp_path / "board2_depth3.csv"
    text = changed.read_text()
    changed.unlink()
    with pytest.raises(SchemaError, match=r"board2_depth3.csv: file not found. Run `reskin fetch`"):
        benchmark.tasks("lab", tmp_path)
    changed.write_text(text.replace("1", "2", 1))
    with pytest.raises(SchemaError, match="not the one of the benchmark"):
        benchmark.tasks("lab", tmp_path)


def test_example_of_the_page_writes_a_complete_file_of_predictions(tmp_path, monkeypatch):
    page = (folds.ROOT / "docs/benchmark.md").read_text(encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    exec(page.split("```python\n")[1].split("```")[0].replace('"lab"', '"simulated"'), {})
    entry = score_file(Path("mine.csv"), ABOUT)
    assert [task.labels_n for task in entry.tasks] == [10, 40]
    errors_mm2 = [task.scores["mse_xy_mm2"]["mean"] for task in entry.tasks]
    assert errors_mm2[1] < errors_mm2[0]


# --- Tests with a tiny dataset: boards a and b have four presses each, of which two are tested; board c is for training

TRUE = {"x_mm": [0.0, 4.0, 8.0, 16.0], "y_mm": [0.0, 4.0, 8.0, 16.0], "F_N": [1.0, 3.0, 2.0, 2.0]}
HEAD = "fold,press,x_mm,y_mm,F_N,x_low_mm,x_high_mm,y_low_mm,y_high_mm,F_sd_N\n"
# The predictions of the two presses of board a are wrong by (0.5, 0.5) and (3, 4) mm, and by 1 and 0 N. Those of
# board b are exact. The intervals are 2 mm wide.
ROWS = [
    f"t.tiny.{board}.draw0.labels{labels},{press},{x},{y},{F},{x - 1},{x + 1},{y - 1},{y + 1},0"
    for labels in (0, 1)
    for board, press, x, y, F in (("a", 0, 0.5, 0.5, 2), ("a", 1, 7, 8, 3), ("b", 0, 0, 0, 1), ("b", 1, 4, 4, 3))
]


@pytest.fixture(scope="module")
def tiny_folder(tmp_path_factory) -> Path:
    """Make the folder of a benchmark that has one tiny dataset."""
    folder = tmp_path_factory.mktemp("benchmark")
    (folder / "t").mkdir()
    board = np.repeat(["a", "b", "c"], 4)
    rows = np.column_stack(list(TRUE.values()))[np.tile(np.arange(4), 3)]
    fields_uT = np.arange(36.0).reshape(12, 3)
    press = np.tile(np.arange(4), 3)
    presses = Presses(board, press, np.zeros_like(press), rows[:, :2], rows[:, 2], fields_uT, fields_uT)
    write_simulated(folder / "t/tiny.parquet", presses)
    recording = {"path": "tiny.parquet", "layout": "presses", "board": None, "options": {}}
    content = {
        "format": folds.FORMAT, "version": "t", "dataset": "tiny", "source": "simulated", "forces": True, "about": "",
        "seeds": {}, "labels_n": [0, 1], "presses_n": {"a": 4, "b": 4, "c": 4},
        "recordings": [recording | {"files": {"tiny.parquet": io.sha256(folder / "t/tiny.parquet")}}],
        "draws": [
            {"board": name, "draw": "draw0", "train": ["c"], "unlabelled": [2], "labels": [3], "tests": [1, 0]}
            for name in "ab"
        ],
    }  # fmt: skip
    parse(FoldFile, content, "tiny")
    io.write_json(folder / "t/tiny.json", content)
    return folder


@pytest.fixture
def tiny(tiny_folder, monkeypatch) -> Path:
    """Use the tiny benchmark instead of the committed one."""
    monkeypatch.setattr(folds, "FOLDER", tiny_folder)
    monkeypatch.setattr(entries, "FOLDER", tiny_folder)
    return tiny_folder


def write_rows(folder: Path, rows: list[str], head: str = HEAD) -> Path:
    file = folder / "mine.csv"
    file.write_text(head + "".join(f"{row}\n" for row in rows))
    return file


def test_scores_equal_those_computed_by_hand(tiny, tmp_path):
    entry = score_file(write_rows(tmp_path, ROWS), ABOUT)
    assert [task.labels_n for task in entry.tasks] == [0, 1]
    a, b = (entry.tasks[0].by_board[board] for board in "ab")
    expected = {
        "accuracy_pct": 50.0,
        "median_mm": (np.hypot(0.5, 0.5) + 5) / 2,
        "mse_xy_mm2": (0.25 + 0.25 + 9 + 16) / 4,
        "mse_f_N2": 0.5,
        "r2_f": 1 - 0.5 / 1.0,
        "coverage_pct": 50.0,
        "interval_score_mm": 2 + 20 * (0 + 0 + 2 + 3) / 4,
        "coverage_f_pct": 50.0,
        "interval_score_f_N": 20 * 1 / 2,
    }
    # Tolerance: scores are written with six significant digits.
    assert {name: a[name]["mean"] for name in a} == pytest.approx(expected, rel=1e-5)
    assert b["accuracy_pct"]["mean"] == 100
    assert b["interval_score_f_N"]["mean"] == 0
    assert entry.tasks[0].scores["accuracy_pct"]["values"] == [50.0, 100.0]
    assert entry.tasks[0].scores["r2_f"]["mean"] == 0.75
    assert entry.predictions.rows_n == 8


@settings(max_examples=8, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(rows=st.permutations(ROWS))
def test_order_of_rows_in_a_file_of_predictions_does_not_matter(tiny, tmp_path, rows):
    shuffled, ordered = (read_predictions(write_rows(tmp_path, some)) for some in (rows, ROWS))
    for name in ("fold", "press", "place_mm", "force_N"):
        np.testing.assert_array_equal(getattr(shuffled, name), getattr(ordered, name))
    for quantity, limits in ordered.intervals.items():
        np.testing.assert_array_equal(shuffled.intervals[quantity], limits)


def test_reversed_rows_have_the_same_scores(tiny, tmp_path):
    scores = [score_file(write_rows(tmp_path, rows), ABOUT).tasks for rows in (ROWS, ROWS[::-1])]
    assert scores[0] == scores[1]


def test_predictions_have_the_same_scores_as_parquet_and_as_csv(tiny, tmp_path):
    csv = write_rows(tmp_path, ROWS)
    pd.read_csv(csv).to_parquet(tmp_path / "mine.parquet")
    assert score_file(tmp_path / "mine.parquet", ABOUT).tasks == score_file(csv, ABOUT).tasks


def test_predictions_of_all_folds_with_one_number_of_labels_may_be_omitted(tiny, tmp_path):
    entry = score_file(write_rows(tmp_path, ROWS[4:]), ABOUT)
    assert [task.labels_n for task in entry.tasks] == [1]


def edit(row_i: int, column_i: int, text: str) -> Callable[[list[str]], list[str]]:
    """Return a function that replaces one cell of the rows."""

    def change(rows: list[str]) -> list[str]:
        cells = rows[row_i].split(",")
        cells[column_i] = text
        return [*rows[:row_i], ",".join(cells), *rows[row_i + 1 :]]

    return change


def scale(**factors: float) -> Callable[[list[str]], list[str]]:
    """Return a function that multiplies columns of the rows."""

    def change(rows: list[str]) -> list[str]:
        names = HEAD.strip().split(",")
        cells = [row.split(",") for row in rows]
        return [
            ",".join(str(float(cell) * factors[name[0]]) if i > 1 and name[0] in factors else cell
                     for i, (name, cell) in enumerate(zip(names, row, strict=True)))
            for row in cells
        ]  # fmt: skip

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda rows: rows[1:], r"mine.csv: 1 of 2 tested presses of fold t.tiny.a.draw0.labels0 are missing: 0"),
        (lambda rows: rows[2:], r"2 of 2 tested presses of fold .* Predict either all folds with 0 labels or none"),
        (lambda rows: [*rows, rows[1]], r"line 10: press 1 of fold t.tiny.a.draw0.labels0 was predicted .* line 3"),
        (edit(2, 1, "3"), r"line 4: press 3 is not tested in fold t.tiny.b.draw0.labels0\. "),
        (edit(6, 1, "3"), r"line 8: press 3 is not tested in fold t.tiny.b.draw0.labels1, where it is labelled"),
        (edit(2, 1, "2"), r"line 4: press 2 .* where it is unlabelled"),
        (edit(2, 1, ""), r"line 4: press is empty"),
        (edit(2, 1, "1.5"), r"row 4: press must be a whole number; got '1.5'"),
        (edit(3, 0, "t.tiny.a.draw1.labels0"), r"line 5: fold t.tiny.* is unknown. Did you mean t.tiny.a.d"),
        (edit(3, 0, "v1.lab.board1.draw0.labels0"), r"line 5: fold v1.lab.* is not in t.tiny, .* Write one file"),
        (edit(0, 0, "v9.lab.board1.draw0.labels0"), r"version 'v9' does not exist. Existing versions: t"),
        (edit(0, 0, "t.lab.board1.draw0.labels0"), r"line 2: .* dataset 'lab' does not exist. Existing datasets: ti"),
        (edit(3, 2, "nan"), r"line 5: x_mm is not a finite number"),
        (edit(3, 4, ""), r"line 5: F_N is not a finite number"),
        (edit(3, 3, "inf"), r"line 5: y_mm is not a finite number"),
        (edit(3, 3, "four"), r"row 5: y_mm must be a number; got 'four'"),
        (edit(3, 5, "99"), r"line 5: x_low_mm is above x_high_mm"),
        (edit(3, 9, "-1"), r"line 5: F_sd_N is negative"),
        (edit(3, 0, "t.tiny,x"), r"row 5: the row has 11 columns, but row 1 has 10"),
        (scale(x=1e-3, y=1e-3), r"the presses have x_mm from 0 to 16 and .* Are they in m or cm instead of mm\?"),
        (scale(x=1e3, y=1e3), r"the median place is \(2250, 2250\), but the presses have .* Are places in mm"),
        (scale(x=0.0), r"with the same origin as the labels"),
        (scale(F=1e3), r"the median of F_N is .* true forces are at most 3 N. Are forces in N"),
        (scale(F=-1.0), r"positive in compression"),
        (scale(F=1e-3), r"Are forces in N"),
        (lambda rows: [], r"the file has no predictions"),
    ],
)  # fmt: skip
def test_invalid_rows_of_predictions_are_refused(tiny, tmp_path, change, message):
    with pytest.raises(SchemaError, match=message):
        score_file(write_rows(tmp_path, change(ROWS)), ABOUT)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("press", "pres", r"column 'pres' is unknown. Did you mean press\?"),
        ("x_mm,", "", r"column x_mm is missing"),
        ("F_N,", "", r"column F_N is missing. Dataset tiny has forces"),
        ("y_mm", "x_mm", r"column x_mm occurs twice"),
        ("x_low_mm,", "", r"of x_low_mm and x_high_mm, only x_high_mm is given"),
        ("x_low_mm,x_high_mm,", "", r"intervals must be given for both x and y"),
        ("F_sd_N", "x_sd_mm", r"both x_sd_mm and x_low_mm are given"),
    ],
)
def test_invalid_columns_of_predictions_are_refused(tiny, tmp_path, old, new, message):
    names = HEAD.strip().split(",")
    kept = [i for i, name in enumerate(names) if new or name not in old.split(",")]
    rows = [",".join(row.split(",")[i] for i in kept) for row in ROWS]
    with pytest.raises(SchemaError, match=message):
        read_predictions(write_rows(tmp_path, rows, HEAD.replace(old, new, 1)))


def test_files_that_contain_no_predictions_are_refused(tiny, tmp_path):
    with pytest.raises(SchemaError, match=r"must end in .csv or .parquet"):
        read_predictions(tmp_path / "mine.txt")
    with pytest.raises(SchemaError, match="file not found"):
        read_predictions(tmp_path / "none.csv")
    for head, message in (("", "line 1 is empty"), ("fold;press;x_mm;y_mm", "no comma"), (f",{HEAD}", "has no name")):
        (tmp_path / "head.csv").write_text(head)
        with pytest.raises(SchemaError, match=message):
            read_predictions(tmp_path / "head.csv")
    pd.DataFrame({"fold": ["t.tiny.a.draw0.labels0"], "press": ["one"], "x_mm": [1.0], "y_mm": [1.0]}).to_parquet(
        tmp_path / "text.parquet"
    )
    with pytest.raises(SchemaError, match="a column has a wrong type"):
        read_predictions(tmp_path / "text.parquet")


def test_command_writes_the_scores_and_an_entry(tiny, tmp_path):
    file = write_rows(tmp_path, ROWS)
    done = CliRunner().invoke(app, ["score", str(file)], catch_exceptions=False)
    assert done.exit_code == 0
    assert "within 1 mm, %" in done.stdout
    assert json.loads((tmp_path / "mine.scores.json").read_text())["predictions"]["sha256"] == io.sha256(file)
    with pytest.raises(ReskinError, match="reskin score --enter: --by is missing"):
        CliRunner().invoke(app, ["score", str(file), "--enter", "--method", "M 1"], catch_exceptions=False)

    options = ["--method", "M 1", "--by", "A. Name", "--trained-on", "labels", "--code", "none"]
    CliRunner().invoke(app, ["score", str(file), "--enter", *options], catch_exceptions=False)
    (entry,) = entries.read_entries(tiny)
    assert entry.about.method == "M 1"
    blocks = entries.blocks([entry], {})
    assert "| 1        | M 1      |" in blocks["benchmark-simulated"]
    assert blocks["benchmark-recorded"] == entries.NONE_YET

    written = entries.entry_file("tiny", "M 1", tiny)
    written.rename(written.with_name("tiny.other.json"))
    with pytest.raises(SchemaError, match=r"must be called tiny.m-1.json"):
        entries.read_entries(tiny)


# --- Tests of our own methods


def test_method_nearest_label_has_its_committed_scores_on_simulated_boards(tmp_path):
    check_nearest_label(read_dataset("simulated"), tmp_path)


def test_method_nearest_label_has_its_committed_scores_on_recorded_boards(lab, tmp_path):
    check_nearest_label(lab, tmp_path)


def check_nearest_label(dataset: Dataset, folder: Path) -> None:
    file = entries.entry_file(dataset.folds.dataset, "nearest label")
    committed = parse(entries.Entry, io.read_json(file), str(file))
    written = folder / "nearest.csv"
    benchmark.write(list(methods.nearest_label(dataset.tasks())), written)
    assert score_predictions(written, read_predictions(written), dataset, committed.about) == committed


def test_universal_model_predicts_places_and_forces_with_intervals():
    data = read_dataset("simulated")
    task = data.task(data.folds.draws[0], 40)
    (rows,) = methods.universal([task])
    predicted, true = rows.to_pandas(), data.presses[task.board][rows["press"].to_numpy()]
    # The committed mean over boards is about 0.1 mm2; a constant place would have a mean of about 15 mm2.
    assert np.mean((predicted[["x_mm", "y_mm"]].to_numpy() - true.place_mm) ** 2) < 0.5
    assert np.mean((predicted["F_N"] - true.force_N) ** 2) < true.force_N.var() / 2
    inside = (predicted["F_low_N"] <= true.force_N) & (true.force_N <= predicted["F_high_N"])
    assert inside.mean() > 0.8

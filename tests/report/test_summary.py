"""Tests of the summary of a scene that is printed in a terminal."""

import subprocess

import pytest
from typer.testing import CliRunner

from pipeline.cli import app
from pipeline.formatting import TITLES
from pipeline.paper import TABLE_2
from pipeline.report.summary import summarise
from reskin import io
from tests.report.synthetic import new_board
from tests.stages.checkout import ROOT

SCENES = sorted(file.parent.name for file in (ROOT / "reports").glob("*/numbers.json"))


def numbers_of(scene: str) -> dict:
    return io.read_json(ROOT / f"reports/{scene}/numbers.json")


@pytest.mark.parametrize("scene", SCENES)
def test_summary_fits_into_a_terminal_and_names_the_kind_of_data(scene):
    lines = summarise(numbers_of(scene))
    assert len(lines) <= 12
    assert max(map(len, lines), default=0) <= 100
    assert not lines or lines[0].lower().startswith(numbers_of(scene)["provenance"]["source"])


def test_scores_of_simulated_scenes_are_shown_beside_those_of_the_paper():
    lines = summarise(numbers_of("quick"))
    row = next(line for line in lines if "multi-sensor  " in line)
    for metric, (mean, _) in TABLE_2["multi"].items():
        assert f"({mean:.0f})" in row or f"({mean:.2f})" in row, metric
    assert f"{numbers_of('quick')['table2']['multi']['accuracy_pct']['mean']:.0f} (" in row


def test_scores_of_recorded_scenes_are_shown_without_those_of_the_paper():
    row = {"accuracy_pct": {"mean": 50.0, "n": 2}, "mse_f_N2": {"mean": 1.0, "n": 2}}
    lines = summarise({"provenance": {"source": "recorded"}, "table2": {"multi": row}})
    assert "(" not in "".join(lines)
    assert any("50" in line and "–" in line for line in lines)  # An unknown score is shown as a dash.


def test_summary_names_the_final_model_of_recorded_boards():
    model = {"file": "data/models/mine/final/final.safetensors", "boards_n": 3}
    row = {"accuracy_pct": {"mean": 50.0, "n": 2}}
    for source, named in (("recorded", True), ("simulated", False)):
        lines = summarise({"provenance": {"source": source}, "table2": {"multi": row}, "final_model": model})
        assert (model["file"] in lines[-1]) is named


def test_summary_shows_the_scores_with_the_fewest_and_the_most_labels():
    lines = summarise({"provenance": {"source": "recorded"}, "new_board": new_board()})
    row = next(line for line in lines if TITLES["shipped"] in line)
    assert row.split()[-4:] == ["40", "80", "0.10", "0.50"]


@pytest.fixture
def checkout(tmp_path, monkeypatch):
    """Create a git checkout with a committed report of scene quick. Change to its folder and return it."""
    provenance = {"git": "abc", "trained": "abc", "versions": {"torch": "1"}, "seconds": 1.0}
    io.write_json(tmp_path / "reports/quick/numbers.json", numbers_of("quick"))
    io.write_json(tmp_path / "reports/quick/provenance.json", provenance)
    author = ("-c", "user.name=a", "-c", "user.email=a@b")
    for arguments in (["init", "-q"], ["add", "."], [*author, "commit", "-qm", "x"]):
        subprocess.run(["git", *arguments], cwd=tmp_path, check=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def change(checkout, file: str, **values) -> None:
    path = checkout / "reports/quick" / file
    io.write_json(path, io.read_json(path) | values)


def run(scene: str) -> str:
    done = CliRunner().invoke(app, ["summary", scene])
    assert done.exit_code == 0, done.output
    assert len(done.output.splitlines()) <= 24
    assert max(map(len, done.output.splitlines())) <= 100
    return " ".join(done.output.split())


def test_report_is_called_reproduced_only_if_it_was_computed_again(checkout):
    assert "it was not computed again" in run("quick")
    change(checkout, "provenance.json", seconds=2.0)
    assert "Scene quick is reproduced: all " in run("quick")


def test_summary_counts_differences_from_the_committed_report_and_gives_reasons(checkout):
    scores = numbers_of("quick")["table2"]
    scores["multi"]["accuracy_pct"]["mean"] *= 0.5
    change(checkout, "numbers.json", table2=scores)
    change(checkout, "provenance.json", versions={"torch": "2"})
    output = run("quick")
    assert "not reproduced exactly: 1 (by up to 50 %; 0 verdicts changed) of " in output
    assert "package torch 2 (committed: 1)" in output


def test_summary_lists_reports_that_are_missing_or_not_committed(checkout):
    (checkout / "reports/quick").rename(checkout / "reports/mine")
    assert "Scene mine: its report is not committed" in run("mine")
    assert "Scene other: no results yet. Run: dvc repro report@other" in run("other")

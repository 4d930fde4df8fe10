"""Tests of `reskin verify-reports`: reports of a new run, or finished reports, are compared with the last commit."""

import json
import subprocess

import pytest
from typer.testing import CliRunner

from pipeline import SCENES
from pipeline.cli import app
from pipeline.manage import verify
from reskin import io

SCORES = "question,fold,accuracy_pct\nlobo,b0,{}\n"


def write(reports, accuracy_pct, score=80.0, model="network"):
    io.write_json(reports / "numbers.json", {"table2": {"accuracy_pct": {"mean": accuracy_pct}}})
    io.write_text(reports / "tables/scores.csv", SCORES.format(score))
    io.write_text(reports / "tables/table2.csv", f'model,"accuracy, %"\n{model},{accuracy_pct}\n')


@pytest.fixture
def checkout(tmp_path, monkeypatch):
    """Return a git checkout whose committed reports have an accuracy of 80 %."""
    write(tmp_path / "reports/quick", 80.0)
    io.write_text(tmp_path / "dvc.yaml", "stages: {}\n")
    for name in ("quick", "lab"):
        io.write_text(tmp_path / SCENES / f"{name}.yaml", "")
    io.write_text(tmp_path / "data/captures.yaml", "captures: {}\n")
    author = ("-c", "user.name=a", "-c", "user.email=a@b")
    for arguments in (["init", "-q"], ["add", "."], [*author, "commit", "-qm", "x"]):
        subprocess.run(["git", *arguments], cwd=tmp_path, check=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run_command(*arguments: str) -> tuple[int, str]:
    done = CliRunner().invoke(app, ["verify-reports", *arguments])
    return done.exit_code, done.output


@pytest.mark.parametrize(
    ("changed", "status", "expected"),
    [
        ((80.0,), 0, "quick: reproduced: all 6 values"),
        ((90.0,), 1, "| table2.accuracy_pct.mean "),
        ((80.0, 70.0), 1, "| scores[lobo].accuracy_pct "),
        ((80.0, 80.0, "ridge"), 1, "| tables | table2    | 1       | 1        |"),
    ],
)
def test_finished_reports_are_compared_with_those_of_the_last_commit(
    checkout, tmp_path_factory, changed, status, expected
):
    other = tmp_path_factory.mktemp("other")
    write(other / "quick", *changed)
    write(checkout / "reports/quick", 0.0)  # reports in the working tree must be ignored
    code, output = run_command("quick", "--against", str(other))
    assert code == status
    assert expected in output


def test_rerun_starts_without_old_reports_and_keeps_its_new_reports(checkout, monkeypatch):
    def run(clone, environment, *arguments, quiet=False):
        if arguments[0] == "dvc":
            assert not list((clone / "reports/quick").glob("*"))
            assert arguments[-1] == "report@quick"
            write(clone / "reports/quick", 90.0)

    monkeypatch.setattr(verify, "_run", run)
    code, output = run_command("quick")
    assert code == 1
    assert "| 80          | 90      |" in output
    kept = json.loads((checkout / verify.VERIFIED / "quick/numbers.json").read_text())
    assert kept["table2"]["accuracy_pct"]["mean"] == 90.0
    assert json.loads((checkout / "reports/quick/numbers.json").read_text())["table2"]["accuracy_pct"]["mean"] == 80.0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["lab"], "has no reports/lab/numbers.json"),
        (["zzz"], "no scene zzz. The scenes are: lab, quick"),
        (["quick", "--against", "data"], "data: this folder contains no quick/numbers.json"),
    ],
)
def test_missing_reports_are_an_error(checkout, arguments, message):
    done = CliRunner().invoke(app, ["verify-reports", *arguments])
    assert message in str(done.exception)


def test_error_for_a_failed_command_names_the_command(tmp_path):
    with pytest.raises(verify.SchemaError, match="`json.tool nowhere` failed in a clone of the last commit"):
        verify._run(tmp_path, {}, "json.tool", "nowhere", quiet=True)

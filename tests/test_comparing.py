"""Tests of `reskin compare`: arguments, and the printed differences of values and verdicts."""

import subprocess

import pytest
from typer.testing import CliRunner

from pipeline import SCENES, plan
from pipeline.cli import app
from reskin import io

XEON, EPYC = "cpu x86_64 Intel Xeon (AVX2), 2 cores", "cpu x86_64 AMD EPYC (AVX2), 4 cores"


def write(reports, accuracy_pct: float, *, verdict: str = "yes", device: str = XEON) -> None:
    scores = {"accuracy_pct": {"mean": accuracy_pct}}
    io.write_json(
        reports / "numbers.json", {"provenance": {"seed": 1}, "table2": {"multi": scores, "single": {"n": 6}}}
    )
    io.write_json(reports / "provenance.json", {"device": device, "trained": "abc", "seconds": accuracy_pct})
    order = f'claim,"MSE_xy, mm²"\nadapted better than multi-sensor,"{verdict}: -0.03 [-0.06, 0.01]"\n'
    io.write_text(reports / "tables/order.csv", order)
    io.write_text(reports / "tables/scores.csv", f"question,accuracy_pct\nlobo,{accuracy_pct}\n")
    io.write_text(reports / "runtime/stages.csv", f"stage,minutes\nadapt,{accuracy_pct}\n")


@pytest.fixture
def checkout(tmp_path, monkeypatch):
    """Return a git checkout whose committed reports have an accuracy of 80 %."""
    write(tmp_path / "reports/quick", 80.0)
    io.write_text(tmp_path / "dvc.yaml", "stages: {}\n")
    for name in ("quick", "lab"):
        io.write_text(tmp_path / SCENES / f"{name}.yaml", "")
    author = ("-c", "user.name=a", "-c", "user.email=a@b")
    for arguments in (["init", "-q"], ["add", "."], [*author, "commit", "-qm", "x"], ["tag", "first"]):
        subprocess.run(["git", *arguments], cwd=tmp_path, check=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(*arguments: str) -> tuple[int, str]:
    done = CliRunner().invoke(app, ["compare", *arguments])
    return done.exit_code, done.output


def rows(output: str) -> list[list[str]]:
    """Return the cells of each table row in an output."""
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in output.splitlines() if line[:1] == "|"]


@pytest.mark.parametrize("against", [[], ["--against", "first"]])
def test_one_line_is_printed_if_all_values_are_equal(checkout, against):
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True).stdout.strip()
    provenance = io.read_json(checkout / "reports/quick/provenance.json")
    io.write_json(checkout / "reports/quick/provenance.json", provenance | {"device": EPYC, "seconds": 9.0})
    code, output = run("quick", *against)
    assert code == 0
    assert output == (
        f"quick: reproduced: all 7 values equal those committed at {commit} (3 of numbers.json and 4 of tables).\n"
    )


def test_differing_values_are_printed_with_the_machines_and_the_sizes_of_differences(checkout):
    write(checkout / "reports/quick", 60.0, device=EPYC)
    code, output = run("quick")
    assert code == 1
    assert XEON in output
    assert EPYC in output
    assert ["numbers.json", "table2", "1", "1", "0", "0"] in rows(output)
    assert ["tables", "scores", "1", "1", "0", "0"] in rows(output)
    assert ["table2.multi.accuracy_pct.mean", "80", "60", "25"] in rows(output)
    summary = output.splitlines()[-1]
    assert summary.startswith("quick: not equal: 2 of 7 values differ from those committed at ")
    assert "0 verdicts changed" in summary


def test_difference_in_the_last_digit_is_listed(checkout):
    write(checkout / "reports/quick", 80.00000000000001)
    code, output = run("quick")
    assert code == 1
    assert "not equal: 2 of 7 values" in output


def test_changed_verdicts_are_listed(checkout):
    write(checkout / "reports/quick", 80.0, verdict="inconclusive")
    code, output = run("quick")
    assert code == 1
    assert ["order[adapted better than multi-sensor].MSE_xy, mm²", "yes", "inconclusive"] in rows(output)
    assert "1 verdicts changed" in output.splitlines()[-1]


def test_values_of_only_one_run_are_counted_by_section(checkout):
    numbers = io.read_json(checkout / "reports/quick/numbers.json")
    io.write_json(checkout / "reports/quick/numbers.json", numbers | {"drift": {"each": [{"contacts_n": 1}]}})
    (checkout / "reports/quick/tables/order.csv").unlink()
    code, output = run("quick")
    assert code == 1
    assert ["numbers.json", "drift", "0", "0", "0", "1"] in rows(output)
    assert ["tables", "order", "0", "0", "2", "0"] in rows(output)
    assert "3 are in one run only" in output.splitlines()[-1]


@pytest.mark.parametrize("where", ["", "quick", "reports/quick", "quick/numbers.json"])
def test_option_against_accepts_a_folder_or_a_file_instead_of_a_revision(checkout, where):
    other = checkout / "other"
    write(other / (where.removesuffix("numbers.json") if where.endswith(".json") else where), 80.0)
    assert run("quick", "--against", str(other if where == "reports/quick" else other / where))[0] == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["quick", "--against", "nowhere"], "git revision nowhere has no reports/quick/numbers.json"),
        (["quick", "--against", "reports"], None), (["lab"], "reports/lab/numbers.json: file not found"),
        (["zzz"], "no scene zzz. The scenes are: lab, quick"),
        (["quick", "--against", ".git"], ".git: this folder contains no quick/numbers.json"),
    ],
)  # fmt: skip
def test_missing_reports_are_an_error(checkout, arguments, message):
    code, output = run(*arguments)
    assert code == (2 if message else 0)
    assert message is None or f"error: {message}" in output


def test_checkout_outside_git_is_an_error(tmp_path, monkeypatch):
    write(tmp_path / "reports/quick", 80.0)
    io.write_text(tmp_path / "dvc.yaml", "stages: {}\n")
    monkeypatch.chdir(tmp_path)
    code, output = run("quick")
    assert code == 2
    assert "has no reports/" in output


def test_all_scenes_are_compared_if_no_scene_is_named(checkout, monkeypatch):
    monkeypatch.setattr(plan, "check", lambda root: type("Plan", (), {"scenes": ("lab", "quick")}))
    code, output = run()
    assert code == 2
    assert "lab" in output
    assert "quick: reproduced" in output

"""Tests of `reskin verify`: numbers of a new run are compared with those of the last commit."""

import json
import subprocess

import pytest
from typer.testing import CliRunner

from pipeline import SCENES
from pipeline.cli import app
from pipeline.manage import verify
from reskin import io


def write(reports, numbers):
    io.write_json(reports / "numbers.json", numbers)


@pytest.fixture
def checkout(tmp_path, monkeypatch):
    """Return a git checkout whose committed reports have an accuracy of 80 %."""
    write(tmp_path / "reports/quick", {"table2": {"mean": 80.0, "n": 1}, "seed": 1})
    io.write_text(tmp_path / "dvc.yaml", "stages: {}\n")
    for name in ("quick", "lab"):
        io.write_text(tmp_path / SCENES / f"{name}.yaml", "")
    io.write_text(tmp_path / "data/captures.yaml", "captures: {}\n")
    author = ("-c", "user.name=a", "-c", "user.email=a@b")
    for arguments in (["init", "-q"], ["add", "."], [*author, "commit", "-qm", "x"]):
        subprocess.run(["git", *arguments], cwd=tmp_path, check=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("fresh", "lines"),
    [
        ({"table2": {"mean": 80.0, "n": 1}, "seed": 1}, []),
        ({"table2": {"mean": 90.0, "n": 1}, "seed": 1}, ["table2.mean: committed 80.0, now 90.0"]),
        ({"table2": {"mean": 80.0, "n": True}, "seed": 1}, ["table2.n: committed 1, now true"]),
        (
            {"table2": {"mean": 80.0, "n": 1}, "rows": [2]},
            ["seed: committed 1, now missing", "rows[0]: committed missing, now 2"],
        ),
    ],
)
def test_rerun_starts_without_old_reports_and_differing_values_are_listed(checkout, monkeypatch, fresh, lines):
    def run(clone, environment, *arguments, quiet=False):
        if arguments[0] == "dvc":
            assert not list((clone / "reports/quick").glob("*"))
            assert arguments[-1] == "report@quick"
            write(clone / "reports/quick", fresh)

    monkeypatch.setattr(verify, "_run", run)
    write(checkout / "reports/quick", {"table2": "of the working tree, which is ignored"})
    done = CliRunner().invoke(app, ["verify", "quick"])
    assert done.exit_code == bool(lines)
    assert done.output.splitlines()[1:-1] == [f"quick: {line}" for line in lines]
    kept = json.loads((checkout / verify.VERIFIED / "quick/numbers.json").read_text())
    assert kept["table2"] == fresh["table2"]


@pytest.mark.parametrize(
    ("scene", "message"),
    [("lab", "reports/lab/numbers.json"), ("zzz", "no scene zzz. The scenes are: lab, quick")],
)
def test_scene_without_committed_report_is_an_error(checkout, scene, message):
    done = CliRunner().invoke(app, ["verify", scene])
    assert message in str(done.exception)

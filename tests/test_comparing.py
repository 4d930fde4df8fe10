import subprocess

import pytest
from typer.testing import CliRunner

from pipeline import comparing, plan
from pipeline.cli import app
from pipeline.comparing import compare_scene
from pipeline.core import io
from pipeline.core.errors import SchemaError


def numbers(accuracy_pct: float) -> dict:
    return {"provenance": {"seconds": accuracy_pct}, "table2": {"multi": {"accuracy_pct": {"mean": accuracy_pct}}}}


@pytest.fixture
def checkout(tmp_path, monkeypatch):
    """A checkout whose committed accuracy is 80 %."""
    io.write_json(tmp_path / "reports/quick/numbers.json", numbers(80.0))
    io.write_text(tmp_path / "dvc.yaml", "stages: {}\n")
    author = ("-c", "user.name=a", "-c", "user.email=a@b")
    for words in (["init", "-q"], ["add", "."], [*author, "commit", "-qm", "x"], ["tag", "first"]):
        subprocess.run(["git", *words], cwd=tmp_path, check=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def said(*words: str) -> tuple[int, str]:
    done = CliRunner().invoke(app, ["compare", *words])
    return done.exit_code, done.output


@pytest.mark.parametrize(
    ("accuracy_pct", "status", "verdict"),
    [
        (80.0, 0, "quick: reproduced: all 1 values equal"), (81.0, 0, "quick: reproduced within tolerance"),
        (90.0, 1, "quick: not reproduced"),
    ],
)  # fmt: skip
def test_the_verdict_is_a_sentence_and_an_exit_status(checkout, accuracy_pct, status, verdict):
    io.write_json(checkout / "reports/quick/numbers.json", numbers(accuracy_pct))
    for against in ([], ["--against", "first"]):
        code, output = said("quick", *against)
        assert code == status
        assert output.splitlines()[-1].startswith(verdict)
        assert ("table2.multi.accuracy_pct.mean" in output) == (status == 1)


@pytest.mark.parametrize("where", ["", "quick", "reports/quick", "quick/numbers.json"])
def test_a_folder_or_a_file_may_stand_for_the_revision(checkout, where):
    other = checkout / "other"
    file = other / where if where.endswith(".json") else other / where / "numbers.json"
    io.write_json(file, numbers(80.0))
    assert compare_scene(checkout, "quick", str(other if where == "reports/quick" else other / where)).reproduced


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["quick", "--against", "nowhere"], "git revision nowhere: reports/quick/numbers.json must be committed"),
        (["quick", "--against", "reports"], None), (["lab"], "reports/lab/numbers.json: the file must be there"),
        (["quick", "--against", ".git"], ".git: the folder must be one that holds quick/numbers.json"),
    ],
)  # fmt: skip
def test_what_is_not_there_is_one_sentence_and_exit_status_2(checkout, words, sentence):
    code, output = said(*words)
    assert code == (2 if sentence else 0)
    assert sentence is None or f"error: {sentence}" in output


def test_outside_git_nothing_is_committed(tmp_path):
    io.write_json(tmp_path / "reports/quick/numbers.json", numbers(80.0))
    with pytest.raises(SchemaError, match="must be committed"):
        compare_scene(tmp_path, "quick", "HEAD")


def test_without_a_scene_all_that_run_are_compared_and_the_worst_is_told(checkout, monkeypatch):
    monkeypatch.setattr(plan, "check", lambda root: type("Plan", (), {"scenes": ("lab", "quick")}))
    code, output = said()
    assert code == 2
    assert "lab" in output
    assert "quick: reproduced" in output


def test_values_that_one_side_lacks_are_named_by_question(checkout):
    io.write_json(checkout / "reports/quick/numbers.json", numbers(80.0) | {"drift": {"each": [{"contacts_n": 1}]}})
    done = compare_scene(checkout, "quick", "HEAD")
    assert comparing.table_of(done) == "only fresh: drift (1 values)"
    assert not done.reproduced

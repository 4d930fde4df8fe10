"""Tests of the lock that commands hold while they change a checkout."""

import subprocess
import sys
import time
from pathlib import Path

import pytest
from dvc.repo import Repo

from pipeline.manage.lock import changing
from reskin.errors import ParamsError
from tests.stages.checkout import run, variables

HELD = "held"
DVC_YAML = f"""\
stages:
  wait:
    cmd: touch {HELD}; while [ -e {HELD} ]; do sleep 0.1; done; touch out
    outs: [out]
"""
APPEND = """\
import sys, time
from pathlib import Path
from pipeline.manage.lock import changing
with changing(Path()):
    lines = Path("lines").read_text()
    time.sleep(0.2)
    Path("lines").write_text(lines + sys.argv[1])
"""


@pytest.fixture
def root(tmp_path) -> Path:
    Repo.init(str(tmp_path), no_scm=True).close()
    (tmp_path / "dvc.yaml").write_text(DVC_YAML)
    return tmp_path


def start(root: Path, *command: str) -> subprocess.Popen[str]:
    environment = variables(Path(__file__).resolve().parents[2])
    return subprocess.Popen(
        [sys.executable, *command], cwd=root, env=environment, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
    )  # fmt: skip


def test_commands_wait_for_each_other(root):
    (root / "lines").write_text("")
    processes = [start(root, "-c", APPEND, letter) for letter in "abc"]
    assert [process.communicate() and process.returncode for process in processes] == [0, 0, 0]
    assert sorted((root / "lines").read_text()) == ["a", "b", "c"]


def test_command_is_refused_while_a_stage_runs(root):
    with start(root, "-m", "dvc", "repro") as dvc:
        while not (root / HELD).exists():
            assert dvc.poll() is None, dvc.stdout.read()
            time.sleep(0.1)
        with pytest.raises(ParamsError, match=rf"nothing was changed, .*PID {dvc.pid}"), changing(root):
            pass
        (root / HELD).unlink()
        dvc.communicate()
    assert dvc.returncode == 0
    with changing(root):
        pass


def test_dvc_runs_no_stage_while_a_command_changes_the_checkout(root):
    with changing(root):
        done = run(root, "dvc", "repro", check=False)
    assert done.returncode != 0
    assert "is busy" in done.stderr
    assert not (root / HELD).exists()


def test_block_may_be_nested_and_add_files_to_dvc(root):
    (root / "recording").mkdir()
    with changing(root), changing(root), Repo(str(root)) as repo:
        repo.add([str(root / "recording")])
    assert (root / "recording.dvc").exists()
    assert "pid" not in (root / ".dvc/tmp/rwlock").read_text()


def test_lock_of_a_killed_command_is_ignored(root):
    with start(root, "-c", APPEND.replace("time.sleep(0.2)", "time.sleep(60)"), "a") as killed:
        (root / "lines").write_text("")
        while not (rwlock := root / ".dvc/tmp/rwlock").exists() or not rwlock.read_text():
            time.sleep(0.1)
        killed.kill()
    with changing(root):
        pass

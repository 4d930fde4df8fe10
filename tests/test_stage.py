"""Tests that a stage and its workers end on SIGTERM, and when DVC, their parent process, is killed."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from reskin import io

pytestmark = pytest.mark.skipif(not Path("/proc/self").exists(), reason="reads /proc")
ENDED_MAX_s = 60.0  # this is long, because tests also run on busy machines
# A stage whose worker would run for minutes, and the process that stands for DVC.
STAGE = """
import os, pathlib, time
from pipeline import executors, stage
from reskin import io
stage.end_with_dvc()
with io.replacing(pathlib.Path("out")) as folder, executors.make_executor(2, imports="json") as executor:
    folder.mkdir()
    worker = executor.submit(os.getpid).result()
    running = [executor.submit(time.sleep, 600) for _ in range(3)]
    io.write_json(pathlib.Path("pids.json"), [os.getpid(), worker])
    running[0].result()
"""
DVC = "import subprocess, sys; subprocess.run([sys.executable, '-c', sys.argv[1]])"


def is_running(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def wait_until(condition) -> None:
    end_s = time.monotonic() + ENDED_MAX_s
    while not condition():
        assert time.monotonic() < end_s
        time.sleep(0.05)


@pytest.mark.timeout(200)
@pytest.mark.parametrize("killed", ["stage", "dvc"])
def test_stage_and_workers_end(tmp_path, killed):
    paths = os.pathsep.join([str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "PYTHONPATH": paths, "DVC_STAGE": "train", "RESKIN_EXECUTOR": "processes:2"}
    dvc = subprocess.Popen([sys.executable, "-c", DVC, STAGE], env=environment, cwd=tmp_path)
    try:
        wait_until((tmp_path / "pids.json").exists)
        pids = io.read_json(tmp_path / "pids.json")
        assert all(map(is_running, pids))
        os.kill(dvc.pid if killed == "dvc" else pids[0], signal.SIGKILL if killed == "dvc" else signal.SIGTERM)
        wait_until(lambda: not any(map(is_running, pids)))
    finally:
        dvc.kill()
        dvc.wait()
    assert [file.name for file in tmp_path.iterdir()] == ["pids.json"]  # the temporary folder was removed

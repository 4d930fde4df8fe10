"""Tests of the deployment scripts, and of the helpers that start and stop servers."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from deploy.servers import running

ROOT = Path(__file__).resolve().parents[1]


@pytest.mark.parametrize(("shell", "script"), [("sh", "deploy/dask.sh"), ("bash", "deploy/slurm/reskin.sbatch")])
def test_scripts_are_valid_shell(shell, script):
    subprocess.run([shell, "-n", script], cwd=ROOT, check=True)


def test_program_and_its_child_processes_end_at_the_end_of_the_with_block(tmp_path):
    child = "import subprocess, sys; subprocess.Popen(['sleep', '60']); print('up', flush=True); sys.stdin.read()"
    command = ["sh", "-c", f'echo $$ > group; "{sys.executable}" -c "{child}"; sleep 60']
    with pytest.raises(ZeroDivisionError), running("it", command, tmp_path / "log") as alive:
        while "up" not in (tmp_path / "log").read_text():
            time.sleep(0.01)
        alive()
        raise ZeroDivisionError
    group = int((tmp_path / "group").read_text())
    with pytest.raises(ProcessLookupError):
        for _ in range(100):  # waits until init has removed the ended processes
            os.killpg(group, 0)
            time.sleep(0.05)

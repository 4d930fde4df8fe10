"""Tests of the check that no `dvc repro` runs in the checkout."""

import json
import os
import subprocess
import sys

import pytest
from zc.lockfile import LockFile

from pipeline.manage.running import DVC_FILES, LOCK, RWLOCK, require_idle
from reskin.errors import ParamsError


@pytest.fixture
def locks(tmp_path):
    (tmp_path / DVC_FILES).mkdir(parents=True)
    return tmp_path / DVC_FILES


def write_rwlock(locks, pid: int) -> None:
    entry = {"pid": pid, "cmd": "dvc repro"}
    (locks / RWLOCK).write_text(json.dumps({"write": {"data/out": entry}, "read": {"params.yaml": [entry]}}))


def test_checkout_in_which_no_dvc_repro_runs_is_idle(tmp_path, locks):
    require_idle(tmp_path / "elsewhere")
    (locks / LOCK).write_text("1")
    (locks / RWLOCK).write_text("{}")
    require_idle(tmp_path)


def test_running_stage_is_an_error(tmp_path, locks):
    write_rwlock(locks, os.getpid())
    with pytest.raises(ParamsError, match=rf"`dvc repro` is running in this checkout \(process {os.getpid()}\)"):
        require_idle(tmp_path)


def test_error_names_the_lock_to_delete_if_its_process_is_not_dvc(tmp_path, locks):
    # This process is not DVC, but the lock names it.
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as other:
        write_rwlock(locks, other.pid)
        with pytest.raises(ParamsError, match=rf"If process {other.pid} is not DVC, delete \.dvc/tmp/rwlock first"):
            require_idle(tmp_path)
        (locks / RWLOCK).unlink()
        require_idle(tmp_path)
        other.communicate()


def test_dvc_repro_between_two_of_its_stages_is_an_error(tmp_path, locks):
    lock = LockFile(str(locks / LOCK))
    with pytest.raises(ParamsError, match="`dvc repro` is running in this checkout, so nothing was changed"):
        require_idle(tmp_path)
    lock.close()
    require_idle(tmp_path)


def test_locks_of_a_killed_run_are_ignored(tmp_path, locks):
    with subprocess.Popen([sys.executable, "-c", ""]) as ended:
        pass
    write_rwlock(locks, ended.pid)
    require_idle(tmp_path)
    (locks / RWLOCK).write_text('{"write": {"da')
    require_idle(tmp_path)

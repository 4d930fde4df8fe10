"""Files that `dvc repro` reads cannot be changed while it runs; the locks of a killed run do no harm."""

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


def note(locks, pid: int) -> None:
    used = {"pid": pid, "cmd": "dvc repro"}
    (locks / RWLOCK).write_text(json.dumps({"write": {"data/out": used}, "read": {"params.yaml": [used]}}))


def test_a_checkout_without_a_run_is_idle(tmp_path, locks):
    require_idle(tmp_path / "elsewhere")
    (locks / LOCK).write_text("1")
    (locks / RWLOCK).write_text("{}")
    require_idle(tmp_path)


def test_a_running_stage_is_refused_with_its_process(tmp_path, locks):
    note(locks, os.getpid())
    with pytest.raises(ParamsError, match=rf"`dvc repro` runs in this checkout \(process {os.getpid()}\)"):
        require_idle(tmp_path)


def test_the_message_says_which_stale_lock_to_delete(tmp_path, locks):
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as other:  # no DVC
        note(locks, other.pid)
        with pytest.raises(ParamsError, match=rf"If process {other.pid} is not DVC, delete \.dvc/tmp/rwlock first"):
            require_idle(tmp_path)
        (locks / RWLOCK).unlink()
        require_idle(tmp_path)
        other.communicate()


def test_a_run_between_two_stages_is_refused(tmp_path, locks):
    held = LockFile(str(locks / LOCK))
    with pytest.raises(ParamsError, match="`dvc repro` runs in this checkout. Nothing was changed"):
        require_idle(tmp_path)
    held.close()
    require_idle(tmp_path)


def test_locks_of_a_killed_run_are_ignored(tmp_path, locks):
    with subprocess.Popen([sys.executable, "-c", ""]) as ended:
        pass
    note(locks, ended.pid)
    require_idle(tmp_path)
    (locks / RWLOCK).write_text('{"write": {"da')
    require_idle(tmp_path)

"""Nobody changes what a running `dvc repro` has read; what a killed one left behind disturbs nobody."""

import json
import os
import subprocess
import sys

import pytest
from zc.lockfile import LockFile

from pipeline.manage.running import BUSY, HELD, LOCKS, need_rest
from reskin.errors import ParamsError


@pytest.fixture
def locks(tmp_path):
    (tmp_path / LOCKS).mkdir(parents=True)
    return tmp_path / LOCKS


def note(locks, pid: int) -> None:
    used = {"pid": pid, "cmd": "dvc repro"}
    (locks / BUSY).write_text(json.dumps({"write": {"data/out": used}, "read": {"params.yaml": [used]}}))


def test_a_checkout_where_nothing_ever_ran_or_all_has_ended_is_at_rest(tmp_path, locks):
    need_rest(tmp_path / "elsewhere")
    (locks / HELD).write_text("1")
    (locks / BUSY).write_text("{}")
    need_rest(tmp_path)


def test_a_stage_that_runs_is_named_by_its_process(tmp_path, locks):
    note(locks, os.getpid())
    with pytest.raises(ParamsError, match=rf"free of a running `dvc repro`; got .*process {os.getpid()}"):
        need_rest(tmp_path)


def test_a_number_that_another_program_has_by_now_is_told_how_to_be_rid_of(tmp_path, locks):
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as other:  # no DVC
        note(locks, other.pid)
        with pytest.raises(
            ParamsError, match=rf"or, if process {other.pid} is no DVC, delete \.dvc/tmp/rwlock; not"
        ) as error:
            need_rest(tmp_path)
        (tmp_path / str(error.value).partition("delete ")[2].partition(";")[0]).unlink()
        need_rest(tmp_path)
        other.communicate()


def test_between_two_stages_it_runs_too(tmp_path, locks):
    held = LockFile(str(locks / HELD))
    with pytest.raises(ParamsError, match="free of a running .* try again; nothing"):
        need_rest(tmp_path)
    held.close()
    need_rest(tmp_path)


def test_what_was_killed_is_no_run(tmp_path, locks):
    with subprocess.Popen([sys.executable, "-c", ""]) as ended:
        pass
    note(locks, ended.pid)
    need_rest(tmp_path)
    (locks / BUSY).write_text('{"write": {"da')
    need_rest(tmp_path)

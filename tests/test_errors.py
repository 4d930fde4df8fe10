"""Tests of error messages: operating-system errors become one line; programming errors are not caught."""

import errno
import os
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from pipeline import stage
from reskin import io
from reskin.errors import RETRY, MachineError, explaining


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (OSError(errno.ENOSPC, "No space left on device", "models"), "split: models: No space left on device. Free"),
        (OSError(errno.EROFS, "Read-only file system", "reports"), "split: reports: Read-only file system. Check the"),
        (OSError(errno.ENOSPC, "No space left on device"), "split: the disk: No space left on device"),
        (
            BrokenProcessPool("gone"),
            "split: a worker process died, perhaps because it ran out of memory. Set the env",
        ),
        (MemoryError("Unable to allocate 8 GiB"), "split: out of memory: Unable to allocate 8 GiB. Set the env"),
        (OSError(errno.ENOMEM, "Cannot allocate memory"), "split: out of memory: .*Cannot allocate memory"),
    ],
)
def test_os_errors_are_explained(error, message):
    with pytest.raises(MachineError, match=f"^{message}") as error_info, explaining("split"):
        raise error
    assert str(error_info.value).endswith(RETRY)


@pytest.mark.parametrize(
    "error", [FileNotFoundError(errno.ENOENT, "No such file", "x"), ValueError("ours"), KeyError(1)]
)
def test_errors_that_the_machine_has_not_caused_are_not_caught(error):
    with pytest.raises(type(error)), explaining("split"):
        raise error


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs /dev/full, which only Linux has")
@pytest.mark.parametrize("write", [io.write_json, io.write_table, io.write_tensors])
def test_error_for_a_full_disk_names_the_target(tmp_path, write):
    target, (temporary,) = tmp_path / "out", [tmp_path / f".out.{os.getpid()}.tmp"]
    content = {io.write_table: pa.table({"a": np.zeros(9)}), io.write_tensors: {"a": np.zeros(9)}}.get(write, [1])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(io, "remove", lambda path: path.unlink(missing_ok=True) or path.symlink_to("/dev/full"))
        with (
            pytest.raises(MachineError, match=rf"^split: {target}: .*No space"),
            explaining("split"),
        ):
            write(target, content, *([{}] if write is io.write_tensors else []))
    assert temporary.is_symlink()
    assert not target.exists()


def test_stage_prints_the_error_and_exits(tmp_path, monkeypatch, capsys):
    def split(folds: Path) -> None:
        raise OSError(errno.EROFS, "Read-only file system", str(folds))

    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit, match="2"):
        stage.run(split, ["--scene", "lab", "--folds", "reports/lab"])
    assert capsys.readouterr().err.startswith("error: split: reports/lab: Read-only")

"""Refuse to change a checkout while DVC runs in it, because stages read the plan, the captures and dvc.lock."""

import os
from pathlib import Path

from reskin import io
from reskin.errors import ParamsError, SchemaError

DVC_FILES = Path(".dvc/tmp")
LOCK, RWLOCK = "lock", "rwlock"  # DVC locks file `lock` between stages, and lists running processes in `rwlock`


def require_idle(root: Path) -> None:
    """Raise `ParamsError` if DVC runs in this checkout."""
    users = dvc_processes(root)
    if users:
        pid = min(users)
        raise ParamsError(
            f"`dvc repro` is running in this checkout (process {pid}), so nothing was changed. Run the command again "
            f"when `dvc repro` has ended. If process {pid} is not DVC, delete {DVC_FILES / RWLOCK} first."
        )
    if _is_locked(root / DVC_FILES / LOCK):
        raise ParamsError(
            "`dvc repro` is running in this checkout, so nothing was changed. Run the command again when `dvc repro` "
            "has ended."
        )


def dvc_processes(root: Path) -> dict[int, str]:
    """Return the command of each DVC process that runs a stage in this checkout, by the id of the process."""
    try:
        content = io.read_json(root / DVC_FILES / RWLOCK)
    except SchemaError:  # the file is missing, or broken; with a broken file, DVC does not run
        return {}
    entries = [
        *content.get("write", {}).values(),
        *(user for users in content.get("read", {}).values() for user in users),
    ]
    # The file may also list processes that were killed.
    return {entry["pid"]: entry["cmd"] for entry in entries if _is_alive(entry["pid"])}


def _is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True  # the process exists, but belongs to another user
    return True


def _is_locked(file: Path) -> bool:
    if not file.exists():
        return False
    from zc.lockfile import LockError, LockFile  # a dependency of DVC; imported here, because it is rarely needed

    try:
        LockFile(str(file)).close()
    except LockError:
        return True
    return False

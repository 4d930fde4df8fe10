"""Refuse to change a checkout while DVC runs in it: its stages read the plan, the captures and dvc.lock."""

import os
from pathlib import Path

from reskin import io
from reskin.errors import ParamsError, SchemaError

DVC_FILES = Path(".dvc/tmp")
LOCK, RWLOCK = "lock", "rwlock"  # DVC locks the first between stages; during one it notes in the second who uses what


def require_idle(root: Path) -> None:
    """Raise `ParamsError` if DVC runs in this checkout."""
    users = _users(root / DVC_FILES / RWLOCK)
    if users:
        pid = min(users)
        raise ParamsError(
            f"`dvc repro` runs in this checkout (process {pid}). Nothing was changed: try again when it has ended. "
            f"If process {pid} is not DVC, delete {DVC_FILES / RWLOCK} first."
        )
    if _is_locked(root / DVC_FILES / LOCK):
        raise ParamsError("`dvc repro` runs in this checkout. Nothing was changed: try again when it has ended.")


def _users(rwlock: Path) -> set[int]:
    """List the processes noted there that are alive; DVC leaves notes of a process that was killed."""
    try:
        noted = io.read_json(rwlock)
    except SchemaError:  # none yet, or broken: DVC refuses it itself
        return set()
    entries = [*noted.get("write", {}).values(), *(one for users in noted.get("read", {}).values() for one in users)]
    return {entry["pid"] for entry in entries if _is_alive(entry["pid"])}


def _is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True  # another user's
    return True


def _is_locked(file: Path) -> bool:
    if not file.exists():
        return False
    from zc.lockfile import LockError, LockFile  # late: a part of DVC

    try:
        LockFile(str(file)).close()
    except LockError:
        return True
    return False

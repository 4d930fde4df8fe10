"""Whether DVC runs stages in a checkout right now. In: DVC's own locks. Out: a refusal, or nothing.

What a run has read of the plan, the captures and dvc.lock must stay as it is until it ends. Refuses to know stages.
"""

import os
from pathlib import Path

from reskin import io
from reskin.errors import ParamsError, SchemaError

LOCKS = Path(".dvc/tmp")
HELD, BUSY = "lock", "rwlock"  # DVC holds the one between stages; during a stage it lists in the other who uses what


def need_rest(root: Path) -> None:
    """Raise if DVC runs in this checkout."""
    users = _users(root / LOCKS / BUSY)
    if users or _is_held(root / LOCKS / HELD):
        got = f"one that runs (process {min(users)})" if users else "one that runs"
        stale = f", or, if process {min(users)} is no DVC, delete {LOCKS / BUSY}" if users else ""
        remedy = f"Wait for its end, then try again{stale}; nothing was changed."
        raise ParamsError("reskin", "this checkout", "free of a running `dvc repro`", got, remedy)


def _users(file: Path) -> set[int]:
    """List the processes that live, of those that DVC noted; one that was killed is still noted."""
    try:
        noted = io.read_json(file)
    except SchemaError:  # none yet, or one that DVC itself will refuse
        return set()
    each = [*noted.get("write", {}).values(), *(user for users in noted.get("read", {}).values() for user in users)]
    return {user["pid"] for user in each if _lives(user["pid"])}


def _lives(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True  # somebody else's
    return True


def _is_held(file: Path) -> bool:
    if not file.exists():
        return False
    from zc.lockfile import LockError, LockFile  # late: a part of DVC

    try:
        LockFile(str(file)).close()
    except LockError:
        return True
    return False

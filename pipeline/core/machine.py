"""What the machine refuses -> one sentence: a disk without room or rights, too little memory, a worker that died.

In: errors of Python and its libraries. Out: `MachineError`. Refuses to know what was being done.
"""

import errno
from collections.abc import Iterator
from concurrent.futures import BrokenExecutor
from contextlib import contextmanager

from pipeline.core.errors import ReskinError

ROOM = dict.fromkeys(("ENOSPC", "EDQUOT", "EFBIG"), ("have room", "Make room."))
RIGHTS = dict.fromkeys(("EROFS", "EACCES", "EPERM"), ("be readable and writable", "Mend its rights or its mount."))
BROKEN = {"EIO": ("be readable", "Check the disk.")}
DISK = {getattr(errno, name): words for name, words in (ROOM | RIGHTS | BROKEN).items() if hasattr(errno, name)}


class MachineError(ReskinError):
    """What the machine could not do; what was finished before is kept."""


@contextmanager
def explaining(where: str) -> Iterator[None]:
    """Raise `MachineError` for what the machine refuses; other errors pass as they are.

    >>> with explaining("split"):
    ...     raise OSError(errno.ENOSPC, "No space left on device", "data/folds/lab.json")
    Traceback (most recent call last):
    pipeline.core.machine.MachineError: split: data/folds/lab.json must have room; got No space left on device. Make \
room. Run it again: what was finished is kept.
    """
    try:
        yield
    except BrokenExecutor:
        rule, got = "be alive to its end", "one that died"
        raise _error(where, "a worker process", rule, got, "Out of memory? Try RESKIN_EXECUTOR=processes:1.") from None
    except (MemoryError, OSError) as error:
        if isinstance(error, MemoryError) or error.errno == errno.ENOMEM:
            rule, got = "be enough for its work", " ".join(str(error).split()) or "none left"
            raise _error(where, "memory", rule, got, "Try RESKIN_EXECUTOR=processes:1.") from None
        if error.errno not in DISK:
            raise
        rule, remedy = DISK[error.errno]
        raise _error(where, str(error.filename or "the disk"), rule, error.strerror, remedy) from None


def _error(where: str, what: str, rule: str, got: object, remedy: str) -> MachineError:
    return MachineError(f"{where}: {what} must {rule}; got {got}. {remedy} Run it again: what was finished is kept.")

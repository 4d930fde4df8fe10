"""Errors that a user can cause, one class for each boundary, and explanations of what the machine refuses."""

import errno
from collections.abc import Iterator
from concurrent.futures import BrokenExecutor
from contextlib import contextmanager


class ReskinError(ValueError):
    """Bad input from outside: a recording, a parameter or a file that breaks a contract.

    >>> print(ReskinError("b3_s2/stream.bin @8192", "frame", "whole", "40 bytes", "Wrong baud rate?"))
    b3_s2/stream.bin @8192: frame must be whole; got 40 bytes. Wrong baud rate?
    """

    exit_code = 2

    def __init__(self, where: object, what: str = "", rule: str = "", got: object = "", remedy: str = "") -> None:
        super().__init__(f"{where}: {what} must be {rule}; got {got}. {remedy}" if what else str(where))


class CaptureError(ReskinError):
    """Bytes, headers or recordings that cannot be read."""


class SchemaError(ReskinError):
    """A table whose columns, types or units are not those of `reskin.schema`."""


class ParamsError(ReskinError):
    """A YAML file, a scene or a command line that asks for what cannot be."""


class TrainingError(ReskinError):
    """A training that cannot go on: no rows, or a loss that is no longer finite."""


class LeakError(ReskinError):
    """A result that would rest on rows it is tested on."""


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
    reskin.errors.MachineError: split: data/folds/lab.json must have room; got No space left on device. Make \
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

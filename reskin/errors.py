"""Exceptions for errors that a user can fix, and messages for machine failures and missing packages."""

import errno
from collections.abc import Iterable, Iterator
from concurrent.futures import BrokenExecutor
from contextlib import contextmanager
from difflib import get_close_matches
from importlib.util import find_spec


class ReskinError(ValueError):
    """Base class of the errors below. Commands print the message without a traceback and exit with `exit_code`.

    Parameters
    ----------
    where : object
        The complete message, if it is the only argument. Otherwise, the location of the error: a file with the line or
        byte, an option, or a setting.
    what, rule, got, remedy
        The other parts of the message: the name of the wrong value, what the value must be, what it is, and what the
        user can try.

    Examples
    --------
    >>> print(ReskinError("b3_s2/stream.bin @8192", "frame", "whole", "40 bytes", "Wrong baud rate?"))
    b3_s2/stream.bin @8192: frame must be whole; got 40 bytes. Wrong baud rate?
    >>> print(ReskinError("model.safetensors: file not found. Train it first: dvc repro."))
    model.safetensors: file not found. Train it first: dvc repro.
    """

    exit_code = 2

    def __init__(self, where: object, what: str = "", rule: str = "", got: object = "", remedy: str = "") -> None:
        super().__init__(f"{where}: {what} must be {rule}; got {got}. {remedy}" if what else str(where))


class CaptureError(ReskinError):
    """A stream, a header or a recording cannot be read, or a board sends no data."""


class SchemaError(ReskinError):
    """A table, file or array cannot be read, or its columns, types, units or shapes are wrong."""


class ParamsError(ReskinError):
    """A setting, a scene, a command-line option or an argument is invalid."""


class TrainingError(ReskinError):
    """Training cannot continue, for example because there are too few training rows."""


class LeakError(ReskinError):
    """Rows that were used for training are also test rows, so the scores would be invalid."""


class MachineError(ReskinError):
    """The machine failed, for example for lack of disk space or memory. Work that was finished before is kept."""


EXTRAS = {  # package -> extra of pyproject.toml that installs the package; `pipeline` installs all packages not listed
    "torch": "train",
    "onnx": "onnx",
    "onnxruntime": "onnx",
    "dask": "dask",
    "distributed": "dask",
    "psycopg2": "team",
}
DISK_REMEDIES = {  # errno of a disk error -> what the user can do
    getattr(errno, name): remedy
    for names, remedy in (
        ("ENOSPC EDQUOT EFBIG", "Free some disk space."),
        ("EROFS EACCES EPERM", "Check its permissions and its mount."),
        ("EIO", "Check the disk."),
    )
    for name in names.split()
    if hasattr(errno, name)
}
RETRY = "Run it again: finished work is kept."


@contextmanager
def explaining(where: str) -> Iterator[None]:
    """Convert machine failures to `MachineError`, and a missing package to `ParamsError`.

    The message of the new error begins with `where`.

    Other exceptions pass through unchanged.

    >>> with explaining("split"):
    ...     raise OSError(errno.ENOSPC, "No space left on device", "data/folds/lab.json")
    Traceback (most recent call last):
    reskin.errors.MachineError: split: data/folds/lab.json: No space left on device. Free some disk space. \
Run it again: finished work is kept.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package in ("", "pipeline", "reskin"):
            raise
        raise missing_package(package, where) from None
    except BrokenExecutor:
        remedy = f"Try RESKIN_EXECUTOR=processes:1. {RETRY}"
        raise MachineError(f"{where}: a worker process died, perhaps out of memory. {remedy}") from None
    except (MemoryError, OSError) as error:
        if isinstance(error, MemoryError) or error.errno == errno.ENOMEM:
            detail = " ".join(str(error).split()) or "nothing is left"
            raise MachineError(f"{where}: out of memory: {detail}. Try RESKIN_EXECUTOR=processes:1. {RETRY}") from None
        if error.errno not in DISK_REMEDIES:
            raise
        file, remedy = error.filename or "the disk", DISK_REMEDIES[error.errno]
        raise MachineError(f"{where}: {file}: {error.strerror}. {remedy} {RETRY}") from None


def did_you_mean(name: object, known: Iterable[str]) -> str:
    """Return " Did you mean ...?" with the known name that is most similar to `name`, or "" if none is similar.

    >>> did_you_mean("stuk", ["zeros", "stuck"])
    ' Did you mean stuck?'
    """
    similar = get_close_matches(str(name), known, n=1)
    return f" Did you mean {similar[0]}?" if similar else ""


def require(package: str, where: object) -> None:
    """Raise `ParamsError` if an optional package is not installed. Call it before a long computation."""
    if find_spec(package) is None:
        raise missing_package(package, where)


def missing_package(package: str, where: object, *, extra: str | None = None) -> ParamsError:
    """Create the error for a missing package, with the command that installs the package.

    extra: the smallest extra that installs all packages that `where` needs; by default, the package's extra in
    `EXTRAS`.
    """
    extra = extra or EXTRAS.get(package, "pipeline")
    return ParamsError(
        f"{where}: the Python package `{package}` is not installed. In the checkout: pip install '.[{extra}]'"
    )

"""Exceptions for errors that a user can fix, and messages for machine failures and missing packages."""

import errno
from collections.abc import Iterable, Iterator
from concurrent.futures import BrokenExecutor
from contextlib import contextmanager
from difflib import get_close_matches
from importlib.util import find_spec


class ReskinError(ValueError):
    """Base class of the errors that a user can fix, such as a wrong setting or a damaged file.

    If such an error is raised, commands print its message without a traceback, and exit with status `exit_code`.

    Parameters
    ----------
    where : object
        If this is the only argument, it is the complete message. Otherwise, it is the location of the error: a file
        with the line or byte, an option, or a setting.
    what, rule, got, remedy
        The other parts of the message: the name of the wrong value, what the value must be, what the value is, and what
        the user can try.

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


# For each optional package, the extra in pyproject.toml with which pip installs it. Packages that are not listed here
# are installed by the extra `pipeline`.
EXTRAS = {
    "torch": "train",
    "sklearn": "train",
    "onnx": "onnx",
    "onnxruntime": "onnx",
    "dask": "dask",
    "distributed": "dask",
    "psycopg2": "team",
}
DISK_REMEDIES = {  # what the user can do about an error of the disk, by the error's errno
    getattr(errno, name): remedy
    for names, remedy in (
        ("ENOSPC EDQUOT EFBIG", "Free some disk space."),
        ("EROFS EACCES EPERM", "Check the permissions of this file, and whether its disk is mounted read-only."),
        ("EIO", "Check the disk for errors."),
    )
    for name in names.split()
    if hasattr(errno, name)
}
RETRY = "Then run the same command again. Work that was finished before is kept, and is not repeated."

LESS_MEMORY = (
    "Set the environment variable RESKIN_EXECUTOR=processes:1, so that a single worker process runs at a time."
)


@contextmanager
def explaining(where: str) -> Iterator[None]:
    """Convert exceptions that are raised in a `with` block to errors whose messages tell the user what to do.

    Failures of the machine (no memory, no disk space, a worker process that died) become a `MachineError`. A missing
    package becomes a `ParamsError`. The message of the new error begins with `where`. Other exceptions are not changed.

    >>> with explaining("split"):
    ...     raise OSError(errno.ENOSPC, "No space left on device", "data/folds/lab.json")
    Traceback (most recent call last):
    reskin.errors.MachineError: split: data/folds/lab.json: No space left on device. Free some disk space. \
Then run the same command again. Work that was finished before is kept, and is not repeated.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package in ("", "pipeline", "reskin"):
            raise
        raise missing_package(package, where) from None
    except BrokenExecutor:
        raise MachineError(
            f"{where}: a worker process died, perhaps because it ran out of memory. {LESS_MEMORY} {RETRY}"
        ) from None
    except (MemoryError, OSError) as error:
        if isinstance(error, MemoryError) or error.errno == errno.ENOMEM:
            detail = " ".join(str(error).split()) or "no memory is left"
            raise MachineError(f"{where}: out of memory: {detail}. {LESS_MEMORY} {RETRY}") from None
        if error.errno not in DISK_REMEDIES:
            raise
        file, remedy = error.filename or "the disk", DISK_REMEDIES[error.errno]
        raise MachineError(f"{where}: {file}: {error.strerror}. {remedy} {RETRY}") from None


def did_you_mean(name: object, known: Iterable[str]) -> str:
    """Return the text " Did you mean NAME?" with the known name that is most similar to a wrong name.

    If no known name is similar, the result is an empty text.

    >>> did_you_mean("stuk", ["zeros", "stuck"])
    ' Did you mean stuck?'
    """
    similar = get_close_matches(str(name), known, n=1)
    return f" Did you mean {similar[0]}?" if similar else ""


def require(package: str, where: object) -> None:
    """Raise `ParamsError` if an optional package is not installed.

    Call this function before a long computation that needs the package at its end.
    """
    if find_spec(package) is None:
        raise missing_package(package, where)


def missing_package(package: str, where: object, *, extra: str | None = None) -> ParamsError:
    """Create the error that reports a missing package, with the command that installs the package.

    extra: the smallest extra of pyproject.toml that installs all packages which `where` needs. By default, it is the
        extra of the package in `EXTRAS`.
    """
    extra = extra or EXTRAS.get(package, "pipeline")
    return ParamsError(
        f"{where}: the Python package `{package}` is not installed. To install it, run in the checkout: pip install -e "
        f"'.[{extra}]'"
    )

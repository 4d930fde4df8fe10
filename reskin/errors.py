"""Errors that a user can cause or fix, and messages for machine failures and missing packages."""

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
        If it is the only argument, the whole message: where, what is wrong, and what to try. Otherwise only the place:
        a file with its line or byte, an option, a setting.
    what, rule, got, remedy
        The parts of a message: what is wrong, what it must be, what it is, and what to try.

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
    """Bytes, headers or recordings cannot be read, or a board sends nothing."""


class SchemaError(ReskinError):
    """A table, file or array cannot be read, or its columns, types, units or shapes are wrong."""


class ParamsError(ReskinError):
    """A setting, a scene, an option of a command or an argument is invalid."""


class TrainingError(ReskinError):
    """Training cannot continue: there are no rows, or the loss is no longer finite."""


class LeakError(ReskinError):
    """Test rows of a result were also used for training."""


class MachineError(ReskinError):
    """The machine failed: no disk space, no memory, no permission, or a dead worker process. Finished work is kept."""


EXTRAS = {  # package -> extra that installs it; the extra `pipeline` installs all others
    "torch": "train",
    "onnx": "onnx",
    "onnxruntime": "onnx",
    "dask": "dask",
    "distributed": "dask",
    "psycopg2": "team",
}
DISK_REMEDIES = {  # by errno
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
    """Turn machine failures into `MachineError`, and a missing package into `ParamsError`; pass on all other errors.

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
    """Return a space and a question with the most similar known name; empty if no name is similar.

    >>> did_you_mean("stuk", ["zeros", "stuck"])
    ' Did you mean stuck?'
    """
    similar = get_close_matches(str(name), known, n=1)
    return f" Did you mean {similar[0]}?" if similar else ""


def require(package: str, where: object) -> None:
    """Raise `ParamsError` if an optional package is not installed; call this before long computations."""
    if find_spec(package) is None:
        raise missing_package(package, where)


def missing_package(package: str, where: object) -> ParamsError:
    """Return the error for a missing package; it names the extra that installs the package."""
    extra = EXTRAS.get(package, "pipeline")
    return ParamsError(f"{where}: package {package} is not installed. In the checkout: pip install '.[{extra}]'")

"""Arrays that take seconds to compute, kept beside compiled code. In: a package, a name. Out: an array, or none.

They lie where numba keeps what it compiled, and are good for one state of the package's sources, of the libraries and
of the settings of `numerics`; any other state computes anew. Where nothing may be written, nothing is kept. Refuses to
know what an array means.
"""

import hashlib
from functools import cache
from importlib.metadata import version
from pathlib import Path

import numpy as np

from pipeline.core import io
from pipeline.core.numerics import signature

LIBRARIES = ("numpy", "scipy", "numba")


def load(package: Path, name: str) -> np.ndarray | None:
    """Read the array of this name; None where none is kept, or what is there cannot be read as an array."""
    try:
        return np.load(_file(package, name), allow_pickle=False)
    except (OSError, ValueError, EOFError):
        return None


def save(package: Path, name: str, array: np.ndarray) -> None:
    """Keep an array under this name, in place of an older one."""
    try:
        with io.replacing(_file(package, name)) as temporary, temporary.open("wb") as stream:
            np.save(stream, array, allow_pickle=False)
        for other in set(_folder(package).glob("kept-*.npy")) - set(_folder(package).glob(f"kept-{_state(package)}-*")):
            io.remove(other)  # of a state that has passed
    except OSError:
        return  # a read-only or full disk costs seconds, no result


def _file(package: Path, name: str) -> Path:
    return _folder(package) / f"kept-{_state(package)}-{hashlib.sha256(name.encode()).hexdigest()[:16]}.npy"


def _folder(package: Path) -> Path:
    return package / "__pycache__"


@cache
def _state(package: Path) -> str:
    found = hashlib.sha256(repr([(name, version(name)) for name in LIBRARIES]).encode())
    found.update(repr(signature()).encode())
    for source in sorted(package.glob("*.py")):
        found.update(source.read_bytes())
    return found.hexdigest()[:16]

"""Optional dependencies: which are installed, and the error that names the extra to install."""

import sys
from importlib.metadata import version
from importlib.util import find_spec

from reskin.errors import ParamsError

OWN = ("pipeline", "reskin")
EXTRAS = {"torch": "train", "onnx": "onnx", "onnxruntime": "onnx"}  # by package; all others are of `pipeline`


def need(package: str, where: object) -> None:
    """Raise if a package is not installed, before it is needed in another thread or after a long computation."""
    if find_spec(package) is None:
        raise lacking(package, where)


def lacking(package: str, where: object) -> ParamsError:
    """Say which extra brings a package."""
    remedy = f"In the checkout: pip install '.[{EXTRAS.get(package, 'pipeline')}]'"
    return ParamsError(where, f"package {package}", "installed", "an environment without it", remedy)


def explain(error: ModuleNotFoundError) -> ParamsError:
    """Turn a failed import into a sentence; raise it again if it is of a module of ours, which nothing brings."""
    package = (error.name or "").partition(".")[0]
    if package in ("", *OWN):
        raise error
    return lacking(package, "reskin")


def show_version(wanted: bool) -> None:
    """Print the version of what is installed, and end."""
    if wanted:
        print(version("reskin"))
        sys.exit()

"""Packages that an environment may lack: the core is installed alone, further ones by the name of an extra.

In: a package, or an import that failed. Out: one sentence that says what to install. Refuses to know what they do.
"""

from importlib.util import find_spec

from pipeline.core.errors import ParamsError

OWN = ("pipeline", "reskin")
EXTRAS = {"torch": "networks", "onnx": "onnx", "onnxruntime": "onnx"}  # by package; all others are of `pipeline`


def need(package: str, where: object) -> None:
    """Raise if a package is not installed, before it is needed in another thread or after a long computation."""
    if find_spec(package) is None:
        raise lacking(package, where)


def lacking(package: str, where: object) -> ParamsError:
    """Say which extra brings a package."""
    remedy = f"In the checkout: pip install '.[{EXTRAS.get(package, 'pipeline')}]'"
    return ParamsError(where, f"package {package}", "installed", "an environment without it", remedy)


def explain(error: ModuleNotFoundError) -> ParamsError | None:
    """Turn a failed import into a sentence; of the project's own modules there is nothing to install."""
    package = (error.name or "").partition(".")[0]
    return None if package in ("", *OWN) else lacking(package, "reskin")

"""Shared fixtures and settings of the tests; array annotations are checked at run time."""

import pipeline  # isort: skip  # noqa: F401  (must be first: sets variables that NumPy reads when imported)

import gc
import inspect
from collections import Counter
from dataclasses import is_dataclass
from functools import partial, wraps
from pathlib import Path
from typing import Any, get_args

import jaxtyping
import pytest
from hypothesis import HealthCheck, settings
from jaxtyping import AbstractArray, jaxtyped

from tests.benchmarks import FULL

# How long an example takes depends on how busy the machine is.
settings.register_profile("busy", deadline=None, suppress_health_check=[HealthCheck.too_slow], max_examples=50)
settings.register_profile("thorough", settings.get_profile("busy"), max_examples=1000)  # --hypothesis-profile=thorough
settings.load_profile("busy")

SHARED_DATA = Path(__file__).resolve().parents[1] / ".." / "shared" / "data"
LONG = (  # files that run stages and commands
    "stages/test_story", "test_lab_story", "test_fetching", "test_adding", "test_adding_an_experiment", "test_numerics",
)  # fmt: skip
CHECKED_N = 50  # calls checked per function and test
calls_n: Counter[Any] = Counter()


def check_arrays(of: Any = None, *, typechecker: Any) -> Any:
    """Check shapes and dtypes of arrays in the first calls of each function in each test.

    Checking every call would take longer than the calls; mypy checks the other types.
    """
    if of is None:
        return partial(check_arrays, typechecker=typechecker)
    if inspect.isclass(of):
        if is_dataclass(of):
            of.__init__ = check_arrays(of.__init__, typechecker=typechecker)
        return of
    if not any(map(_names_an_array, inspect.get_annotations(of).values())):
        return of
    checked = None

    @wraps(of)
    def checked_at_first(*args: Any, **kwargs: Any) -> Any:
        nonlocal checked
        calls_n[of] += 1
        if calls_n[of] > CHECKED_N:
            return of(*args, **kwargs)
        checked = checked or jaxtyped(of, typechecker=typechecker)  # late, because it is slower than the import
        return checked(*args, **kwargs)

    return checked_at_first


def _names_an_array(hint: Any) -> bool:
    if isinstance(hint, str):
        return "[" in hint  # a plain name is a class, not an array annotation
    return (inspect.isclass(hint) and issubclass(hint, AbstractArray)) or any(map(_names_an_array, get_args(hint)))


def pytest_runtest_setup() -> None:
    calls_n.clear()


gc.disable()  # while everything is imported
jaxtyping.jaxtyped = check_arrays  # the import hook decorates all functions of the project with it
if not FULL:  # benchmarks at full size run the code as it is
    # jaxtyping's pytest plugin would import NumPy too early
    jaxtyping.install_import_hook(["pipeline", "reskin"], "beartype.beartype")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Start with the longest files, so that workers end together (--dist loadfile)."""
    items.sort(key=lambda item: next((i for i, name in enumerate(LONG) if f"/{name}.py" in item.nodeid), len(LONG)))


def pytest_collection_finish() -> None:
    """Exclude all imported objects from garbage collection: they live to the end."""
    gc.freeze()
    gc.enable()


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real recordings beside the checkout; tests that need it are skipped without it."""
    if not SHARED_DATA.is_dir():
        pytest.skip("needs the real recordings in ../shared/data, which are not part of the repository")
    return SHARED_DATA.resolve()

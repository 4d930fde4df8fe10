"""Fixtures and settings of all tests. Array annotations are checked at run time (`check_arrays`)."""

import pipeline  # isort: skip  # noqa: F401  (must be first: `pipeline` sets variables that NumPy reads when imported)

import gc
import inspect
import os
from collections import Counter
from dataclasses import is_dataclass
from functools import partial, wraps
from pathlib import Path
from typing import Any, get_args

import jaxtyping
import pytest
from filelock import FileLock
from hypothesis import HealthCheck, settings
from jaxtyping import AbstractArray, jaxtyped

from tests.sizes import FULL

# No deadlines: the time of an example depends on the load of the machine. Each run has the same examples, so that tests
# of unchanged code do not begin to fail. With `--hypothesis-profile=thorough`, many other examples are drawn.
always = {"deadline": None, "suppress_health_check": [HealthCheck.too_slow]}
settings.register_profile("same", max_examples=25, derandomize=True, **always)
settings.register_profile("thorough", max_examples=1000, **always)
settings.load_profile("same")

SHARED_DATA = Path(__file__).resolve().parents[1] / ".." / "shared" / "data"
LONG = (  # The slowest test files, which run stages and commands.
    "stages/test_story", "test_lab_story",
    "manage/test_fetch", "manage/test_add", "stages/test_reruns", "test_numerics",
)  # fmt: skip
CHECKED_N = 5  # The number of calls of a function whose arrays are checked in each test.
calls_n: Counter[Any] = Counter()


def check_arrays(decorated: Any = None, *, typechecker: Any) -> Any:
    """Decorate a function or dataclass: in its first calls in each test, check the shapes and dtypes of arrays.

    Checking every call would take longer than the calls themselves. Other types are left to mypy.
    """
    if decorated is None:
        return partial(check_arrays, typechecker=typechecker)
    if inspect.isclass(decorated):
        if is_dataclass(decorated):
            decorated.__init__ = check_arrays(decorated.__init__, typechecker=typechecker)
        return decorated
    if not any(map(_names_an_array, inspect.get_annotations(decorated).values())):
        return decorated
    checked = None

    @wraps(decorated)
    def checked_at_first(*args: Any, **kwargs: Any) -> Any:
        nonlocal checked
        calls_n[decorated] += 1
        if calls_n[decorated] > CHECKED_N:
            return decorated(*args, **kwargs)
        # The function is decorated at its first call, because decorating all functions would slow down the import.
        checked = checked or jaxtyped(decorated, typechecker=typechecker)
        return checked(*args, **kwargs)

    return checked_at_first


def _names_an_array(hint: Any) -> bool:
    if isinstance(hint, str):
        return "[" in hint  # Only annotations of arrays have brackets.
    return (inspect.isclass(hint) and issubclass(hint, AbstractArray)) or any(map(_names_an_array, get_args(hint)))


def pytest_runtest_setup() -> None:
    calls_n.clear()


gc.disable()  # Imports are faster without garbage collection.
jaxtyping.jaxtyped = check_arrays  # The import hook of jaxtyping applies `jaxtyped` to all functions of the project.
if not FULL:  # Arrays are not checked in benchmarks at full size, because checks take time.
    # The pytest plugin of jaxtyping is not used, because it would import NumPy before `pipeline`.
    jaxtyping.install_import_hook(["pipeline", "reskin"], "beartype.beartype")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Run the slowest files first, so that all workers (--dist loadfile) end at about the same time."""
    items.sort(key=lambda item: next((i for i, name in enumerate(LONG) if f"/{name}.py" in item.nodeid), len(LONG)))


def pytest_collection_finish() -> None:
    """Exclude all imported objects from garbage collection, because they are needed until the end."""
    gc.freeze()
    gc.enable()


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Return the folder of real recordings beside the checkout; skip the test if the folder is missing."""
    if not SHARED_DATA.is_dir():
        pytest.skip("needs the real recordings in ../shared/data, which are not part of the repository")
    return SHARED_DATA.resolve()


@pytest.fixture(scope="session")
def empty_store(tmp_path_factory) -> Path:
    """Return an MLflow store without runs; tests copy this store, because creating a store takes seconds.

    The first worker that needs the store creates it for all workers.
    """
    folder = tmp_path_factory.getbasetemp()
    store = (folder.parent if "PYTEST_XDIST_WORKER" in os.environ else folder) / "empty-mlflow.db"
    with FileLock(f"{store}.lock"):
        if not store.exists():
            import mlflow

            mlflow.MlflowClient(f"sqlite:///{store}").search_experiments()
    return store

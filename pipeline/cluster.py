"""A `concurrent.futures` executor that runs calls on the workers of a Dask scheduler.

Calls read and write files in the checkout. Workers must therefore have the checkout at the same path, on the same
machine or on a shared file system. Workers with different code, libraries or environment variables, or with more than
one thread, are rejected, so that results are bit-identical to those of a local run. Workers are checked when the
executor is created; a worker that joins later is checked at its first call.
"""

import os
import sys
from collections.abc import Callable, Mapping
from concurrent.futures import BrokenExecutor, Executor, Future
from contextlib import suppress
from functools import partial
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import pipeline
import reskin
from reskin.code import package_digest
from reskin.errors import ParamsError
from reskin.numerics import signature

CONNECT_TIMEOUT_s, WORKERS_TIMEOUT_s = (
    20.0,
    60.0,
)  # these are long, because a worker imports modules for several seconds
HELP = "docs/cluster.md describes how to start workers."
LIBRARIES = ("numpy", "scipy", "numba", "torch", "dask", "distributed")
# Suffixes of the files that must be equal on all machines. Files of settings may differ, because settings are sent with
# each call.
CODE = (".py", ".json", ".safetensors")
PACKAGES = (Path(pipeline.__file__).parent, Path(reskin.__file__).parent)


def _version(library: str) -> str:
    try:
        return version(library)
    except PackageNotFoundError:
        return "none"


# This is computed when the module is imported, because a worker continues to use the code that it has imported, even if
# the files are edited later.
IMPORTED = {"sources as imported": package_digest(*PACKAGES, suffixes=CODE)} | {
    name: _version(name) for name in LIBRARIES
}


class Cluster(Executor):
    """Executor that submits calls to a Dask scheduler; workers run them in this process's working directory."""

    def __init__(self, address: str, imports: str) -> None:
        self._expected, self._address = describe_process(), address
        self._client = _connect(address)
        try:
            with suppress(TimeoutError):
                self._client.wait_for_workers(1, timeout=WORKERS_TIMEOUT_s)
            _check_workers(self._client, address)
            self._client.run(import_on_worker, imports)
        except BaseException:
            self._client.close()
            raise
        # With pure=True, Dask would not repeat equal calls. Every call must run, because calls write files.
        self._executor = self._client.get_executor(pure=False)

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Run a call on one of the workers."""
        future: Future[Any] = Future()
        future.set_running_or_notify_cancel()
        submitted = self._executor.submit(run_on_worker, os.getcwd(), self._expected, partial(fn, *args, **kwargs))
        submitted.add_done_callback(partial(_copy_outcome, future, self._address))
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Wait for submitted calls, or cancel them, and disconnect; the cluster keeps running."""
        self._executor.shutdown(wait=wait and not cancel_futures)
        self._client.close()


def run_on_worker(folder: str, expected: Mapping[str, str], call: Callable[[], Any]) -> Any:
    """Run a call on a worker in `folder`, the checkout, because stages use paths relative to the checkout.

    The worker is compared with `expected` again, because it may have joined after `_check_workers`.
    """
    _compare(expected, describe_process(), f"process {os.getpid()}")
    os.chdir(folder)  # this affects no other call, because a worker has one thread
    return call()


def import_on_worker(name: str) -> None:
    """Import a module on a worker."""
    import_module(name)


def describe_process() -> dict[str, str]:
    """Return the properties of this process that determine every bit of a result: versions, sources, variables."""
    from reskin.numerics import DEVICE_VARIABLE, device

    return {
        "Python": sys.version.split()[0],
        **IMPORTED,
        "the project's code": str(Path(pipeline.__file__).resolve()),
        DEVICE_VARIABLE: device(),
        "OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS", "unset"),
        "environment variables of numerics": ", ".join(signature()),
    }


def _connect(address: str) -> Any:
    try:
        from distributed import Client
    except ImportError:
        remedy = "Try: pip install -c constraints.txt -e '.[dask]'"
        raise ParamsError(f"RESKIN_EXECUTOR: the Python package `distributed` is not installed. {remedy}") from None
    try:
        return Client(address, timeout=CONNECT_TIMEOUT_s, set_as_default=False)
    except (OSError, ValueError) as error:
        what = f"the scheduler at {address} did not answer within {CONNECT_TIMEOUT_s:g} s ({str(error)[:80]})"
        raise ParamsError(f"RESKIN_EXECUTOR: {what}. {HELP}") from None


def _check_workers(client: Any, address: str) -> None:
    """Raise an error if there is no worker, or if results of a worker could differ from results of this process."""
    workers: Mapping[str, Any] = client.scheduler_info(n_workers=-1)["workers"]
    if not workers:
        raise ParamsError(f"RESKIN_EXECUTOR: the scheduler at {address} has no workers. {HELP}")
    for name, worker in workers.items():
        if worker["nthreads"] != 1:
            raise ParamsError("RESKIN_EXECUTOR", f"threads of worker {name}", "1", worker["nthreads"], HELP)
    expected = describe_process()
    for name, properties in client.run(describe_process).items():
        _compare(expected, properties, name)


def _compare(expected: Mapping[str, str], properties: Mapping[str, str], worker: str) -> None:
    """Raise `ParamsError` if a worker's properties differ from the expected ones."""
    for name, value in expected.items():
        got = properties.get(name, "nothing")  # missing if the worker imported an older version of this module
        if got != value:
            raise ParamsError(
                "RESKIN_EXECUTOR", f"{name} of worker {worker}", value, got, f"Restart the worker. {HELP}"
            )


def _copy_outcome(future: Future[Any], address: str, submitted: Future[Any]) -> None:
    """Copy the result or error of a Dask future to `future`.

    If the worker died, the error is `BrokenExecutor`, as for a worker process on this machine.
    """
    from distributed import KilledWorker

    # Dask cancels calls if it loses the scheduler. Calls that `shutdown` cancelled get the same error, because nobody
    # waits for their results.
    if submitted.cancelled():
        remedy = "Finished training runs are cached. Start the scheduler again, then repeat the command."
        future.set_exception(ParamsError(f"Lost the Dask scheduler at {address}. {remedy}"))
        return
    error = submitted.exception()
    if isinstance(error, KilledWorker):
        error = BrokenExecutor(str(error))
    if error is None:
        future.set_result(submitted.result())
    else:
        future.set_exception(error)

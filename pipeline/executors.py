"""Executors that run calls in worker processes, in this process or on a Dask cluster; RESKIN_EXECUTOR selects one.

RESKIN_EXECUTOR is an environment variable rather than a setting, because the hash of a training run must not depend on
where the training runs.
"""

import multiprocessing
import os
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future, ProcessPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from functools import cache
from importlib.metadata import version
from multiprocessing import forkserver
from multiprocessing.context import ForkServerContext
from pathlib import Path
from typing import Any

import pipeline
import reskin
from reskin.code import package_digest
from reskin.errors import ParamsError, require
from reskin.numerics import DEVICE_VARIABLE, device, signature

VARIABLE = "RESKIN_EXECUTOR"
DEFAULT, HERE = "processes:2", "here"
CLUSTER = "dask:"  # prefix of the address of a running scheduler
HELP = "docs/teams.md describes how to start workers."
CONNECT_MAX_s, WORKERS_MAX_s = 20.0, 60.0
PACKAGES = (Path(pipeline.__file__).parent, Path(reskin.__file__).parent)
CODE = (".py", ".json", ".safetensors")  # settings may differ, because they are sent with each call


def make_executor(tasks_n: int = 2, *, imports: str) -> AbstractContextManager[Executor]:
    """Make the executor that RESKIN_EXECUTOR names: `processes:N` (default N = 2), `here`, or `dask:ADDRESS`.

    Each worker process has one thread. If the variable is not set, a single task runs in this process. Local worker
    processes are forked from a server that has imported module `imports`.
    """
    if address := _scheduler_address():
        return _cluster_executor(address)
    workers_n = _workers_n(DEFAULT if tasks_n > 1 else HERE)
    return ProcessPoolExecutor(workers_n, _context(imports), _end_with_parent) if workers_n else InProcessExecutor()


def prepare_workers(imports: str) -> None:
    """Start the fork server early, so that it imports module `imports` while this process reads data."""
    if not _scheduler_address() and _workers_n(DEFAULT):
        _context(imports)
        forkserver.ensure_running()


def _workers_n(default: str) -> int:
    """Return the number of worker processes that RESKIN_EXECUTOR sets; 0 means `here`."""
    name = os.environ.get(VARIABLE, default)
    if name == HERE:
        return 0
    kind, _, count = name.partition(":")
    if kind != "processes" or not count.isdecimal() or int(count) < 1:
        rule = "processes:N with N >= 1, here, or dask:ADDRESS"
        raise ParamsError(VARIABLE, "the executor", rule, repr(name), f"Unset {VARIABLE} to use two processes.")
    return int(count)


def _scheduler_address() -> str:
    """Return the address of the Dask scheduler in RESKIN_EXECUTOR; empty if calls run on this machine."""
    name = os.environ.get(VARIABLE, "")
    return name.removeprefix(CLUSTER) if name.startswith(CLUSTER) else ""


def _context(imports: str) -> ForkServerContext:
    """Return the multiprocessing context whose fork server imports module `imports`."""
    # Start method "forkserver": a process forked from a multi-threaded process can hang in BLAS. A process forked from
    # the fork server, which has only imported modules, does not hang.
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([imports])
    return context


def end_workers() -> None:
    """Stop the fork server, which is the parent process of the workers.

    The operating system adds the CPU time of a process to that of its parent when the process has ended. The CPU time
    of the workers is therefore included in the CPU time of this process's children only after the server has ended.
    """
    forkserver._forkserver._stop()  # type: ignore[attr-defined]  # otherwise, the server would outlive this process


class InProcessExecutor(Executor):
    """Run each call immediately in this process, for debugging and for work that is shorter than a worker's imports."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Call a function, and return a finished future with its result or error."""
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


def _end_with_parent() -> None:
    """Make this worker exit when its parent process ends; otherwise the worker would outlive a killed stage."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def exit_with_parent() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=exit_with_parent, daemon=True).start()


@contextmanager
def _cluster_executor(address: str) -> Iterator[Executor]:
    """Connect to a Dask scheduler, check its workers, and make Dask's own executor."""
    require("distributed", VARIABLE)
    from distributed import Client, KilledWorker  # imported here, because Dask is optional

    try:
        client = Client(address, timeout=CONNECT_MAX_s, set_as_default=False)
    except (OSError, ValueError) as error:
        what = f"the scheduler at {address} did not answer within {CONNECT_MAX_s:g} s ({str(error)[:80]})"
        raise ParamsError(f"{VARIABLE}: {what}. {HELP}") from None
    with client:
        try:
            client.wait_for_workers(1, timeout=WORKERS_MAX_s)
        except TimeoutError:
            raise ParamsError(f"{VARIABLE}: the scheduler at {address} has no workers. {HELP}") from None
        check_workers(client)
        executor = client.get_executor(pure=False)  # calls write files, so equal calls must run again
        try:
            yield executor
        except CancelledError:  # Dask cancels calls if it loses the scheduler
            remedy = "Finished training runs are cached. Start the scheduler again, then repeat the command."
            raise ParamsError(f"{VARIABLE}: lost the Dask scheduler at {address}. {remedy}") from None
        except KilledWorker as error:
            raise BrokenExecutor(str(error)) from None
        finally:
            executor.shutdown(wait=False)  # cancels the calls that a failed or terminated stage has left


def check_workers(client: Any) -> None:
    """Raise `ParamsError` if results of a worker of a `distributed.Client` could differ from those of this process."""
    expected = {"number of threads": "1", **describe_process()}
    threads_n: Mapping[str, int] = client.nthreads()
    for worker, properties in client.run(describe_process).items():
        found = {"number of threads": str(threads_n[worker]), **properties}
        for name, value in expected.items():
            if (got := found.get(name, "nothing")) != value:
                raise ParamsError(VARIABLE, f"{name} of worker {worker}", value, got, f"Restart the worker. {HELP}")


def describe_process() -> dict[str, str]:
    """Return the properties of this process on which every bit of a result depends, and its working directory."""
    return {
        "working directory": os.getcwd(),  # calls read and write files by paths relative to the checkout
        "code": _code_digest(),
        "Python": sys.version.split()[0],
        **{name: version(name) for name in ("numpy", "scipy", "numba", "torch")},
        DEVICE_VARIABLE: device(),
        "OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS", "unset"),
        "environment variables of numerics": ", ".join(signature()),
    }


@cache  # a worker continues to use the code that it has imported, even if the files are edited later
def _code_digest() -> str:
    return package_digest(*PACKAGES, suffixes=CODE)

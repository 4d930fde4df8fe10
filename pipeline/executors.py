"""Executors that run calls in worker processes, in this process or on a cluster; RESKIN_EXECUTOR selects one.

RESKIN_EXECUTOR is an environment variable rather than a setting, because the hash of a training run must not depend on
where the training runs.
"""

import multiprocessing
import os
import threading
from collections.abc import Callable
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from multiprocessing import forkserver
from multiprocessing.context import ForkServerContext
from typing import Any

from reskin.errors import ParamsError

VARIABLE = "RESKIN_EXECUTOR"
DEFAULT, HERE = "processes:2", "here"
CLUSTER = "dask:"  # prefix of the address of a running scheduler


def make_executor(tasks_n: int = 2, *, imports: str) -> Executor:
    """Make the executor that RESKIN_EXECUTOR names: `processes:N` (default N = 2), `here`, or `dask:ADDRESS`.

    Each worker process has one thread. If the variable is not set, a single task runs in this process. The worker
    processes are forked from a server that has imported module `imports`.
    """
    if address := _scheduler_address():
        from pipeline.cluster import Cluster  # imported only if needed, because Dask is optional

        return Cluster(address, imports)
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

"""Executors: where calls run, as RESKIN_EXECUTOR names it.

An environment variable and no parameter, because where a training ran must not change its hash.
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
CLUSTER = "dask:"  # before the address of a scheduler that runs already


def make_executor(tasks_n: int = 2, *, imports: str) -> Executor:
    """Make the executor that RESKIN_EXECUTOR names: `processes:N` (default N = 2), `here`, or `dask:ADDRESS`.

    All have one thread a process. One task by itself runs here, unless a place is named. Module `imports` is what the
    tasks need: it is imported once, for all processes.
    """
    if address := _address():
        from pipeline.cluster import Cluster  # late: Dask is an extra

        return Cluster(address, imports)
    workers_n = _workers_n(DEFAULT if tasks_n > 1 else HERE)
    return ProcessPoolExecutor(workers_n, _context(imports), _end_with_parent) if workers_n else Here()


def prepare_workers(imports: str) -> None:
    """Import what tasks will need where workers are forked from, while this process reads what they work on."""
    if not _address() and _workers_n(DEFAULT):
        _context(imports)
        forkserver.ensure_running()


def _workers_n(otherwise: str) -> int:
    """Read RESKIN_EXECUTOR: how many processes; 0 is `here`."""
    name = os.environ.get(VARIABLE, otherwise)
    if name == HERE:
        return 0
    kind, _, count = name.partition(":")
    if kind != "processes" or not count.isdecimal() or int(count) < 1:
        rule = "processes:N with N >= 1, here, or dask:ADDRESS"
        raise ParamsError(VARIABLE, "the executor", rule, repr(name), "Unset it for two processes.")
    return int(count)


def _address() -> str:
    """Read RESKIN_EXECUTOR: the address of a cluster's scheduler; empty where work stays on this machine."""
    name = os.environ.get(VARIABLE, "")
    return name.removeprefix(CLUSTER) if name.startswith(CLUSTER) else ""


def _context(imports: str) -> ForkServerContext:
    # forkserver: a forked child of a threaded parent can hang in BLAS; one of a process that only imported does not.
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([imports])
    return context


def end_workers() -> None:
    """Wait for the process that forks workers, so that what they took counts as taken by children of this one."""
    forkserver._forkserver._stop()  # type: ignore[attr-defined]  # else it ends unseen after its parent


class Here(Executor):
    """Runs each call at once in this process: for a debugger, and for trainings shorter than a worker's imports."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Call it, and give what came of it as a finished future."""
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


def _end_with_parent() -> None:
    """Let no worker outlive a killed stage: an orphan would train on, unseen, beside the next attempt."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def wait() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()

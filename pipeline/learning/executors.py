"""Where trainings run. In: the environment variable RESKIN_EXECUTOR. Out: a `concurrent.futures` executor.

An environment variable and no parameter, because where a training ran must not change its hash. Refuses to know
what is run.
"""

import multiprocessing
import os
import threading
from collections.abc import Callable
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from typing import Any

from pipeline.core.errors import ParamsError

VARIABLE = "RESKIN_EXECUTOR"
DEFAULT = "processes:2"
DEVICE_VARIABLE = "RESKIN_DEVICE"
DEVICES = ("cpu", "cuda")


def make_executor() -> Executor:
    """Make the executor that RESKIN_EXECUTOR names: `processes:N` (default N = 2, one thread each), or `here`."""
    word = os.environ.get(VARIABLE, DEFAULT)
    if word == "here":
        return Here()
    kind, _, count = word.partition(":")
    if kind != "processes" or not count.isdecimal() or int(count) < 1:
        raise ParamsError(VARIABLE, "the executor", "processes:N with N >= 1, or here", repr(word), "Unset it for two.")
    # spawn: a forked child of a threaded parent can hang in BLAS.
    return ProcessPoolExecutor(int(count), multiprocessing.get_context("spawn"), _end_with_parent)


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


def device() -> str:
    """Where networks are trained: RESKIN_DEVICE, `cpu` if it is not set; one code path for all."""
    word = os.environ.get(DEVICE_VARIABLE, DEVICES[0])
    if word not in DEVICES:
        raise ParamsError(DEVICE_VARIABLE, "the device", f"one of {DEVICES}", repr(word), "Unset it for cpu.")
    return word


def _end_with_parent() -> None:
    """Let no worker outlive a killed stage: an orphan would train on, unseen, beside the next attempt."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def wait() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()

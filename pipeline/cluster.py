"""Calls on a cluster that runs already: the address of a Dask scheduler -> a `concurrent.futures` executor.

Workers see the checkout under its own path (one machine, or a shared file system), as results are files in it; rows are
read there once a process. They give a local run's bytes because they must have its code, its variables and one thread
each: what differs is refused before work begins, and at a call to a worker that came later. Refuses to know what is
run, and to start or end any worker.
"""

import hashlib
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
from reskin.errors import ParamsError
from reskin.numerics import signature

CONNECT_MAX_s, WORKERS_MAX_s = 20.0, 60.0  # a worker that is started beside us imports for seconds
HOW = "docs/cluster.md says how workers are started."
LIBRARIES = ("numpy", "scipy", "numba", "torch", "dask", "distributed")
CODE = (".py", ".json", ".safetensors")  # sources, and the tables that come with them; settings come with a call


PACKAGES = (Path(pipeline.__file__).parent, Path(reskin.__file__).parent)


def _sources(*packages: Path) -> str:
    """Digest the code of packages."""
    found = hashlib.sha256()
    for package in packages:
        for file in sorted(file for file in package.rglob("*") if file.suffix in CODE):
            found.update(f"{file.relative_to(package)} {hashlib.sha256(file.read_bytes()).hexdigest()}\n".encode())
    return found.hexdigest()[:32]


def _version(library: str) -> str:
    try:
        return version(library)
    except PackageNotFoundError:
        return "none"


# Of when this module was imported: a worker may outlive an edit, and computes on with what it has in memory.
IMPORTED = {"sources as imported": _sources(*PACKAGES)} | {name: _version(name) for name in LIBRARIES}


class Cluster(Executor):
    """Submits calls to a Dask scheduler; each runs in this process's working directory, in one thread of a worker."""

    def __init__(self, address: str, imports: str) -> None:
        self._own, self._address = describe_process(), address
        self._client = _connect(address)
        try:
            with suppress(TimeoutError):
                self._client.wait_for_workers(1, timeout=WORKERS_MAX_s)
            _check_workers(self._client, address)
            self._client.run(import_module_there, imports)
        except BaseException:
            self._client.close()
            raise
        self._executor = self._client.get_executor(pure=False)  # a call writes files: it is run as often as asked

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Run a call on one of the workers."""
        future: Future[Any] = Future()
        future.set_running_or_notify_cancel()
        submitted = self._executor.submit(run_there, os.getcwd(), self._own, partial(fn, *args, **kwargs))
        submitted.add_done_callback(partial(_pass_on, future, self._address))
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Wait for what was submitted, or cancel it, and leave the cluster as it was."""
        self._executor.shutdown(wait=wait and not cancel_futures)
        self._client.close()


def run_there(folder: str, own: Mapping[str, str], call: Callable[[], Any]) -> Any:
    """Run a call on a worker as if it ran in a folder: paths of stages are relative to the checkout.

    The worker may have come, or come back, after the others were compared with the process that calls.
    """
    _compare(own, describe_process(), f"process {os.getpid()}")
    os.chdir(folder)  # a worker has one thread
    return call()


def import_module_there(name: str) -> None:
    """Import on a worker what its calls will need."""
    import_module(name)


def describe_process() -> dict[str, str]:
    """Say what decides the bits of a result: versions and sources that this process imported, its variables."""
    from reskin.numerics import DEVICE_VARIABLE, device

    return {
        "Python": sys.version.split()[0],
        **IMPORTED,
        "the project's code": str(Path(pipeline.__file__).resolve()),
        DEVICE_VARIABLE: device(),
        "OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS", "unset"),
        "variables of numerics": ", ".join(signature()),
    }


def _connect(address: str) -> Any:
    try:
        from distributed import Client
    except ImportError:
        remedy = "Try: pip install -c constraints.txt -e '.[dask]'"
        raise ParamsError("RESKIN_EXECUTOR", "package distributed", "installed", "none", remedy) from None
    try:
        return Client(address, timeout=CONNECT_MAX_s, set_as_default=False)
    except (OSError, ValueError) as error:
        rule, got = f"one that answers within {CONNECT_MAX_s:g} s", f"{address} ({str(error)[:80]})"
        raise ParamsError("RESKIN_EXECUTOR", "the scheduler", rule, got, HOW) from None


def _check_workers(client: Any, address: str) -> None:
    """Raise if there is no worker, or one that would give other bits than this process."""
    workers: Mapping[str, Any] = client.scheduler_info(n_workers=-1)["workers"]
    if not workers:
        raise ParamsError("RESKIN_EXECUTOR", f"workers of {address}", "one or more", "none", HOW)
    for name, worker in workers.items():
        if worker["nthreads"] != 1:
            raise ParamsError("RESKIN_EXECUTOR", f"threads of worker {name}", "1", worker["nthreads"], HOW)
    own = describe_process()
    for name, theirs in client.run(describe_process).items():
        _compare(own, theirs, name)


def _compare(own: Mapping[str, str], theirs: Mapping[str, str], name: str) -> None:
    for what, value in own.items():
        got = theirs.get(what, "nothing")  # of a worker that imported an older version of this module
        if got != value:
            raise ParamsError("RESKIN_EXECUTOR", f"{what} of worker {name}", value, got, f"Start it anew. {HOW}")


def _pass_on(future: Future[Any], address: str, submitted: Future[Any]) -> None:
    """Give a call's result or error on; a worker that died is told as a local one is."""
    from distributed import KilledWorker

    if submitted.cancelled():  # by Dask, when it loses the scheduler; nobody waits for what we cancel ourselves
        what, got = f"the scheduler at {address}", "one that went away"
        remedy = "Start it and its workers again, then run again: what was finished is kept."
        future.set_exception(ParamsError("RESKIN_EXECUTOR", what, "there until the work is done", got, remedy))
        return
    error = submitted.exception()
    if isinstance(error, KilledWorker):
        error = BrokenExecutor(str(error))
    if error is None:
        future.set_result(submitted.result())
    else:
        future.set_exception(error)

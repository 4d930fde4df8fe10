"""Tests of training on a Dask cluster: a scheduler and two workers on this machine, started as docs/teams.md says."""

import importlib
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from pipeline.executors import check_workers, describe_process, make_executor
from reskin.errors import ParamsError
from reskin.models.runner import run_jobs
from tests.models.example_jobs import example_data
from tests.models.test_runner import equal_results, jobs

ROOT = Path(__file__).resolve().parents[1]
START_MAX_s = 120.0


@contextmanager
def dask(*words: str) -> Iterator[subprocess.Popen]:
    """Run deploy/dask.sh in a process group of its own, because a worker is restarted by its parent process."""
    environment = {**os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    process = subprocess.Popen(
        ["sh", str(ROOT / "deploy/dask.sh"), *words], env=environment, start_new_session=True,
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    try:
        yield process
    finally:
        kill(process)


def kill(process: subprocess.Popen) -> None:
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()


@pytest.fixture(scope="module")
def cluster() -> Iterator[SimpleNamespace]:
    """Start a scheduler and two workers with one thread each."""
    reason = "Dask is not installed: pip install -c constraints.txt -e '.[dask]'"
    distributed = pytest.importorskip("distributed", reason=reason)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    address, pem = f"tls://127.0.0.1:{port}", str(ROOT / f".reskin/dask/{port}.pem")
    of_client = {f"distributed.comm.tls.{name}": pem for name in ("ca-file", "client.cert", "client.key")}
    with ExitStack() as processes:
        processes.enter_context(importlib.import_module("dask").config.set(of_client))
        scheduler = processes.enter_context(dask("scheduler", str(port)))
        while not Path(pem).exists():
            assert scheduler.poll() is None
            time.sleep(0.1)
        workers = [processes.enter_context(dask("worker", address)) for _ in range(2)]
        with distributed.Client(address, timeout=START_MAX_s, set_as_default=False) as client:
            client.wait_for_workers(2, timeout=START_MAX_s)
        yield SimpleNamespace(address=address, scheduler=scheduler, workers=workers, certificate=Path(pem))
    Path(pem).unlink()


@pytest.fixture(autouse=True)
def environment(monkeypatch) -> None:
    monkeypatch.chdir(ROOT)
    monkeypatch.setenv("OMP_NUM_THREADS", "1")


@pytest.mark.parametrize("protocol", ["tcp", "tls"])
def test_stranger_cannot_connect(cluster, protocol):
    distributed = importlib.import_module("distributed")
    own = distributed.Security.temporary() if protocol == "tls" else distributed.Security()
    assert cluster.certificate.stat().st_mode & 0o077 == 0
    with pytest.raises(OSError, match=protocol):
        distributed.Client(cluster.address.replace("tls", protocol), timeout=3, security=own, set_as_default=False)


@pytest.mark.parametrize(("variable", "value"), [("OMP_NUM_THREADS", "2"), ("RESKIN_DEVICE", "cuda")])
def test_worker_with_another_environment_is_an_error(cluster, monkeypatch, variable, value):
    monkeypatch.setenv("RESKIN_EXECUTOR", f"dask:{cluster.address}")
    monkeypatch.setenv(variable, value)
    with pytest.raises(ParamsError, match=f"{variable} of worker .* must be {value}"), make_executor(imports="json"):
        pass


@pytest.mark.parametrize("changed", ["code", "number of threads", "working directory", "scipy"])
def test_worker_that_may_compute_other_results_is_an_error(changed):
    found = {"number of threads": "1"} | describe_process()
    check_workers(fake_client(found))
    with pytest.raises(ParamsError, match=f"{changed} of worker w must be .*; got 7. Restart the worker"):
        check_workers(fake_client(found | {changed: "7"}))


def fake_client(properties: dict[str, str]) -> SimpleNamespace:
    threads_n = {"w": int(properties.pop("number of threads", "1"))}
    return SimpleNamespace(nthreads=lambda: threads_n, run=lambda call: {"w": properties})


@pytest.mark.timeout(300)
def test_sweep_with_a_killed_worker_gives_the_bytes_of_a_local_sweep(cluster, tmp_path, monkeypatch):
    selected = [replace(job, seed_i=seed_i) for job in jobs(2, steps_n=20) for seed_i in range(6)]
    cache = tmp_path / "cluster"

    def kill_worker() -> None:
        while not list(cache.glob("*.safetensors")):
            time.sleep(0.02)
        kill(cluster.workers[0])

    thread = threading.Thread(target=kill_worker, daemon=True)
    results = []
    for folder, name in ((tmp_path / "here", "here"), (cache, f"dask:{cluster.address}")):
        monkeypatch.setenv("RESKIN_EXECUTOR", name)
        if name != "here":
            thread.start()
        with make_executor(imports="reskin.models.train") as executor:
            results.append(run_jobs(selected, example_data(), executor=executor, cache=folder, log=lambda _: None))
    thread.join()
    for a, b in zip(*results, strict=True):
        assert (a.key, a.predicted.tobytes()) == (b.key, b.predicted.tobytes())
        assert equal_results(a, b)


def test_loss_of_the_scheduler_is_an_error(cluster, monkeypatch):
    monkeypatch.setenv("RESKIN_EXECUTOR", f"dask:{cluster.address}")
    with (
        pytest.raises(ParamsError, match="lost the Dask scheduler .* Finished training runs are cached"),
        make_executor(imports="json") as executor,
    ):
        running = executor.submit(time.sleep, 60)
        kill(cluster.scheduler)
        running.result()

"""Tests of training on a Dask cluster (a scheduler and two workers on this machine)."""

import importlib.util
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest

from pipeline import cluster
from pipeline.cluster import _check_workers, describe_process
from pipeline.executors import make_executor, prepare_workers
from reskin.errors import ParamsError
from reskin.models.runner import run_jobs
from tests.models.example_jobs import example_data
from tests.models.test_runner import equal_results, jobs

ROOT = Path(__file__).resolve().parents[1]
# The options with which deploy/dask.sh starts workers.
CLI = "import pipeline.cluster; from distributed.cli.dask_{0} import main; main()"
START_MAX_s = 120.0
HERE_ONLY = ["--host", "127.0.0.1", "--no-dashboard"]


@contextmanager
def dask_process(kind: str, *options: str) -> Iterator[None]:
    paths = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    environment = {"OMP_NUM_THREADS": "1", **os.environ, "PYTHONPATH": paths}
    command = [sys.executable, "-W", "ignore", "-c", CLI.format(kind), *HERE_ONLY, *options]
    process = subprocess.Popen(command, env=environment, cwd="/", stderr=subprocess.DEVNULL)
    try:
        yield
    finally:
        process.terminate()
        process.wait()


@pytest.fixture(scope="module")
def address(tmp_path_factory) -> Iterator[str]:
    """Start a scheduler and two workers with one thread each. Yield the address of the scheduler."""
    reason = "Dask is not installed: pip install -c constraints.txt -e '.[dask]'"
    distributed = pytest.importorskip("distributed", reason=reason)
    file = tmp_path_factory.mktemp("scheduler") / "scheduler.json"
    with ExitStack() as processes:
        options = ["--scheduler-file", str(file)]
        processes.enter_context(dask_process("scheduler", "--port", "0", "--no-jupyter", *options))
        for _ in range(2):
            processes.enter_context(
                dask_process("worker", "--scheduler-file", str(file), "--nthreads", "1", "--no-nanny")
            )
        end_s = time.monotonic() + START_MAX_s
        while not file.exists() and time.monotonic() < end_s:
            time.sleep(0.05)
        scheduler_address = json.loads(file.read_text())["address"]
        with distributed.Client(scheduler_address, set_as_default=False) as client:
            client.wait_for_workers(2, timeout=START_MAX_s)
        yield scheduler_address


def describe_call(i: int) -> tuple[int, str, int]:
    time.sleep(0.1)
    return os.getpid(), os.getcwd(), i


def test_sweep_on_two_workers_gives_the_results_of_a_local_sweep(address, tmp_path, monkeypatch):
    small_jobs = [replace(job, seed_i=seed_i) for job in jobs(2, steps_n=10) for seed_i in (0, 1)]
    results = []
    for name, executor_name in (("here", "here"), ("there", f"dask:{address}")):
        monkeypatch.setenv("RESKIN_EXECUTOR", executor_name)
        monkeypatch.setenv("OMP_NUM_THREADS", os.environ.get("OMP_NUM_THREADS", "1"))
        prepare_workers("reskin.models.train")
        with make_executor(imports="reskin.models.train") as executor:
            cache = tmp_path / name
            results.append(run_jobs(small_jobs, example_data(), executor=executor, cache=cache, log=lambda _: None))
            ran = [future.result() for future in [executor.submit(describe_call, i) for i in range(6)]]
    for a, b in zip(*results, strict=True):
        assert (a.key, a.predicted.tobytes()) == (b.key, b.predicted.tobytes())
        assert equal_results(a, b)
    assert [i for _, _, i in ran] == list(range(6))
    assert len({process for process, _, _ in ran} - {os.getpid()}) == 2
    # Workers run in the working directory of this process, because stages use relative paths.
    assert {folder for _, folder, _ in ran} == {os.getcwd()}


def test_error_on_a_worker_is_raised_in_the_client(address, monkeypatch):
    monkeypatch.setenv("RESKIN_EXECUTOR", f"dask:{address}")
    monkeypatch.setenv("OMP_NUM_THREADS", os.environ.get("OMP_NUM_THREADS", "1"))
    with make_executor(1, imports="json") as executor, pytest.raises(ValueError, match="invalid literal"):
        executor.submit(int, "x").result()


@pytest.mark.parametrize(
    ("workers", "expected"),
    [
        ({}, "the scheduler at tcp://there has no workers"),
        ({"w": {"threads": 2}}, "threads of worker w must be 1; got 2"),
        (
            {"v": {}, "w": {"environment variables of numerics": "COMPATIBLE"}},
            "environment variables of numerics of worker w must be .* got COMP",
        ),
        ({"w": {"the project's code": "/elsewhere"}}, "the project's code of worker w must be .* got /elsewhere"),
        ({"w": {"RESKIN_DEVICE": "cuda"}}, "RESKIN_DEVICE of worker w must be cpu; got cuda"),
        ({"w": {"scipy": "0.1"}}, "scipy of worker w must be .* got 0.1"),
    ],
)
def test_workers_that_may_compute_other_results_are_an_error(workers, expected):
    threads = {name: {"nthreads": changed.get("threads", 1)} for name, changed in workers.items()}
    client = SimpleNamespace(
        scheduler_info=lambda n_workers: {"workers": threads},
        run=lambda call: {name: call() | changed for name, changed in workers.items()},
    )
    with pytest.raises(ParamsError, match=expected):
        _check_workers(client, "tcp://there")


def test_loss_of_the_scheduler_is_an_error():
    pytest.importorskip("distributed", reason="Dask is not installed")
    submitted, future = Future(), Future()
    submitted.cancel()  # When Dask loses the scheduler, it cancels all calls.
    cluster._copy_outcome(future, "tcp://there", submitted)
    with pytest.raises(ParamsError, match="Lost the Dask scheduler at tcp://there. Finished training runs are cached"):
        future.result(0)


def import_fresh(file: Path) -> ModuleType:
    """Import a module again from its file, as a new process would."""
    spec = importlib.util.spec_from_file_location("cluster_of_a_copy", file)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_worker_with_code_from_before_an_edit_is_refused(tmp_path, monkeypatch):
    for package in ("pipeline", "reskin"):
        (tmp_path / package).mkdir()
        shutil.copy(ROOT / package / "__init__.py", tmp_path / package)
        monkeypatch.setattr(sys.modules[package], "__file__", str(tmp_path / package / "__init__.py"))
    source = ROOT / "pipeline/cluster.py"
    before = import_fresh(source)
    with (tmp_path / "reskin/seeds.py").open("w") as module:
        module.write("# edited\n")
    now = import_fresh(source)
    cluster._compare(now.describe_process(), import_fresh(source).describe_process(), "w")
    with pytest.raises(ParamsError, match="sources as imported of worker w must be .* Restart the worker"):
        cluster._compare(now.describe_process(), before.describe_process(), "w")
    with pytest.raises(ParamsError, match="sources as imported of worker process"):
        cluster.run_on_worker(str(tmp_path), before.describe_process(), os.getcwd)


def test_workers_equal_to_this_process_are_accepted():
    client = SimpleNamespace(
        scheduler_info=lambda n_workers: {"workers": {"w": {"nthreads": 1}}}, run=lambda call: {"w": describe_process()}
    )
    _check_workers(client, "tcp://there")

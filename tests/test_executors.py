import os
import resource
import sys
import time

import pytest

from pipeline.executors import end_workers, make_executor
from reskin.errors import ParamsError
from reskin.models import job
from reskin.numerics import device


def test_executor_processes_runs_calls_in_another_process(monkeypatch):
    monkeypatch.setenv("RESKIN_EXECUTOR", "processes:1")
    with make_executor(imports="json") as executor:
        assert executor.submit(os.getpid).result() != os.getpid()


def test_cpu_time_includes_ended_workers(monkeypatch):
    monkeypatch.setenv("RESKIN_EXECUTOR", "processes:1")
    with make_executor(imports="json") as executor:
        executor.submit(burn, 0.3).result()
    before_s = children_s()
    end_workers()
    assert children_s() - before_s >= 0.3
    end_workers()  # A second call has no effect.


def children_s() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def test_workers_import_modules_before_their_first_task(monkeypatch):
    monkeypatch.setenv("RESKIN_EXECUTOR", "processes:1")
    end_workers()
    with make_executor(imports="colorsys") as executor:
        assert executor.submit(is_imported, "colorsys").result()
        assert not executor.submit(is_imported, "this").result()


def is_imported(name: str) -> bool:
    return name in sys.modules


def burn(seconds: float) -> None:
    while time.process_time() < seconds:
        pass


@pytest.mark.parametrize("value", ["", "threads:2", "dask:", "processes", "processes:0", "processes:-1", "processes:x"])
def test_unknown_executor_is_an_error(monkeypatch, value):
    monkeypatch.setenv("RESKIN_EXECUTOR", value)
    with pytest.raises(ParamsError, match="RESKIN_EXECUTOR: the executor must be processes:N"):
        make_executor(imports="json")


def test_calls_run_in_this_process_with_executor_here(monkeypatch):
    monkeypatch.setenv("RESKIN_EXECUTOR", "here")
    with make_executor(imports="json") as executor:
        assert executor.submit(os.getpid).result() == os.getpid()
        with pytest.raises(ZeroDivisionError):
            executor.submit(lambda: 1 // 0).result()


def test_default_device_is_the_cpu(monkeypatch):
    monkeypatch.delenv("RESKIN_DEVICE", raising=False)
    assert device() == "cpu"
    for value in ("cpu", "cuda"):
        monkeypatch.setenv("RESKIN_DEVICE", value)
        assert device() == value


@pytest.mark.parametrize("value", ["", "gpu", "CUDA", "cuda:0", "cpu "])
def test_unknown_device_is_an_error(monkeypatch, value):
    monkeypatch.setenv("RESKIN_DEVICE", value)
    with pytest.raises(ParamsError) as error:
        device()
    assert str(error.value) == (
        f"RESKIN_DEVICE: the device must be one of ('cpu', 'cuda'); got {value!r}. Unset this variable to use the CPU."
    )


def test_median_call_time_does_not_include_the_first_call(monkeypatch):
    now_s, calls = [0.0], []

    def call() -> None:
        calls.append(len(calls))
        # According to the clock of this test, the first call takes 1000 s, and the next ones 2 s, 3 s, and so on.
        now_s[0] += 1000.0 if len(calls) == 1 else float(len(calls))

    monkeypatch.setattr(job, "perf_counter", lambda: now_s[0])
    median_s = job.median_call_s(call)
    assert len(calls) == job.REPEATS_N + 1
    assert median_s == (2 + job.REPEATS_N + 1) / 2  # This is the median of 2 s to 26 s.

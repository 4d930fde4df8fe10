import os
import resource
import sys
import time

import pytest

from pipeline.executors import end_workers, make_executor
from reskin.errors import ParamsError
from reskin.models import job
from reskin.numerics import device


def test_trainings_run_in_processes_of_their_own(monkeypatch):
    monkeypatch.setenv("RESKIN_EXECUTOR", "processes:1")
    with make_executor(imports="json") as executor:
        assert executor.submit(os.getpid).result() != os.getpid()


def test_what_workers_took_counts_when_they_are_ended(monkeypatch):
    monkeypatch.setenv("RESKIN_EXECUTOR", "processes:1")
    with make_executor(imports="json") as executor:
        executor.submit(burn, 0.3).result()
    before_s = children_s()
    end_workers()
    assert children_s() - before_s >= 0.3
    end_workers()  # of which there are none any more


def children_s() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def test_what_tasks_need_is_imported_before_they_begin(monkeypatch):
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


@pytest.mark.parametrize("word", ["", "threads:2", "dask:", "processes", "processes:0", "processes:-1", "processes:x"])
def test_an_unknown_executor_is_one_sentence(monkeypatch, word):
    monkeypatch.setenv("RESKIN_EXECUTOR", word)
    with pytest.raises(ParamsError, match="RESKIN_EXECUTOR: the executor must be processes:N"):
        make_executor(imports="json")


def test_trainings_can_run_here_and_fail_as_they_would_elsewhere(monkeypatch):
    monkeypatch.setenv("RESKIN_EXECUTOR", "here")
    with make_executor(imports="json") as executor:
        assert executor.submit(os.getpid).result() == os.getpid()
        with pytest.raises(ZeroDivisionError):
            executor.submit(lambda: 1 // 0).result()


def test_networks_are_trained_on_the_cpu_unless_told_otherwise(monkeypatch):
    monkeypatch.delenv("RESKIN_DEVICE", raising=False)
    assert device() == "cpu"
    for word in ("cpu", "cuda"):
        monkeypatch.setenv("RESKIN_DEVICE", word)
        assert device() == word


@pytest.mark.parametrize("word", ["", "gpu", "CUDA", "cuda:0", "cpu "])
def test_an_unknown_device_is_one_sentence(monkeypatch, word):
    monkeypatch.setenv("RESKIN_DEVICE", word)
    with pytest.raises(ParamsError) as refused:
        device()
    assert str(refused.value) == (
        f"RESKIN_DEVICE: the device must be one of ('cpu', 'cuda'); got {word!r}. Unset it for cpu."
    )


def test_a_call_is_timed_after_one_that_warms_and_the_middle_time_counts(monkeypatch):
    now_s, calls = [0.0], []

    def call() -> None:
        calls.append(len(calls))
        now_s[0] += 1000.0 if len(calls) == 1 else float(len(calls))  # cold once, then 2 s, 3 s, ...

    monkeypatch.setattr(job, "perf_counter", lambda: now_s[0])
    median_s = job.median_call_s(call)
    assert len(calls) == job.REPEATS_N + 1
    assert median_s == (2 + job.REPEATS_N + 1) / 2  # of 2 .. 26 s


def test_one_slow_call_changes_little(monkeypatch):
    now_s, took_s = [0.0], iter([1.0] * 10 + [500.0] + [1.0] * job.REPEATS_N)

    def call() -> None:
        now_s[0] += next(took_s)

    monkeypatch.setattr(job, "perf_counter", lambda: now_s[0])
    assert job.median_call_s(call) == 1.0

import os

import pytest

from pipeline.core.errors import ParamsError
from pipeline.learning.executors import device, make_executor


def test_trainings_run_in_processes_of_their_own(monkeypatch):
    monkeypatch.setenv("RESKIN_EXECUTOR", "processes:1")
    with make_executor() as executor:
        assert executor.submit(os.getpid).result() != os.getpid()


@pytest.mark.parametrize("word", ["", "threads:2", "processes", "processes:0", "processes:-1", "processes:x"])
def test_an_unknown_executor_is_one_sentence(monkeypatch, word):
    monkeypatch.setenv("RESKIN_EXECUTOR", word)
    with pytest.raises(ParamsError, match="RESKIN_EXECUTOR: the executor must be processes:N"):
        make_executor()


def test_trainings_can_run_here_and_fail_as_they_would_elsewhere(monkeypatch):
    monkeypatch.setenv("RESKIN_EXECUTOR", "here")
    with make_executor() as executor:
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

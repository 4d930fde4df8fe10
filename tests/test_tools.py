"""Tests that the scripts in tools/ run, at a tiny size."""

from functools import partial

import pytest

from tools.benchmarks import decode, live, model, physics, training


@pytest.mark.parametrize(
    ("benchmark", "ratio"),
    [
        (partial(decode.main, 200), "reader_loop"),
        (partial(physics.main, 1, (0.2,), forget=False), "magpylib.core"),
        (partial(training.main, 3_600, 2, 1), "DataLoader loop / grid"),
        (partial(model.main, 3), "in PyTorch"),
        (partial(live.main, ["--boards", "5@400", "--seconds", "0.5"]), "byte to estimate"),
    ],
    ids=["decode", "physics", "training", "model", "live"],
)
def test_benchmarks_print_their_ratios(benchmark, ratio, capsys, monkeypatch):
    monkeypatch.delenv("RESKIN_EXECUTOR", raising=False)
    monkeypatch.delenv("RESKIN_BROWSER", raising=False)
    benchmark()
    assert ratio in capsys.readouterr().out

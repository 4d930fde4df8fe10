"""Test of the line that stage simulate prints."""

from itertools import chain, repeat
from types import SimpleNamespace

import pytest

from pipeline.executors import HERE, VARIABLE
from pipeline.settings import read_settings
from pipeline.stages import simulate as stage
from tests.stages.checkout import ROOT

CLIPPED, DEEP = "field values clipped", "stops too deep"


@pytest.fixture
def printed(tmp_path, monkeypatch, capsys):
    """Return a function that runs the stage for six skins, given the values out of range of the first of them."""

    def run(*overruns: dict[str, int]) -> list[str]:
        counts = chain(overruns, repeat({CLIPPED: 0, DEEP: 0}))
        monkeypatch.setattr(
            stage, "simulate_capture", lambda *_, skin, **__: SimpleNamespace(name=skin, overruns=next(counts)),
        )  # fmt: skip
        monkeypatch.setattr(stage, "to_files", lambda *_: ())
        monkeypatch.setattr(stage, "write_capture", lambda *_: None)
        monkeypatch.setenv(VARIABLE, HERE)
        stage.simulate(read_settings("ci", ROOT), "grid", tmp_path / "raw")
        return capsys.readouterr().err.splitlines()

    return run


def test_stage_prints_the_sum_of_the_values_out_of_range(printed):
    lines = printed({CLIPPED: 0, DEEP: 3}, {CLIPPED: 0, DEEP: 4})
    assert lines[-1] == "ci: in all simulated captures of protocol grid: stops too deep: 7"
    assert not any(line.startswith("ci:") for line in printed())

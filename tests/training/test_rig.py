"""Tests of models that know the other boards of a rig."""

import numpy as np
import pytest

from pipeline.settings import Settings
from pipeline.training import rig
from pipeline.training.recorded import Compare
from reskin.errors import ParamsError
from reskin.schema import Readings
from reskin.universal.episodes import TrainingSettings
from reskin.universal.model import load_universal
from tests.universal.skins import draw

SECTION = {"compare": {"layout": "reskin", "labels_mirrored": False}}
COMPARE = Settings("mine", "mine.yaml", SECTION, {}).section(Compare, "compare")


def capture(board: str, skin: str, i: int) -> Readings:
    """Return a capture of a simulated skin: 130 presses of one reading each."""
    drawn, n = draw(12)[i], 130
    press, zeros = np.arange(n, dtype=np.int32), np.zeros(n, np.float32)
    columns = [part.astype(np.float32) for part in (*drawn.place_mm.T, zeros, zeros, zeros, drawn.force_N, drawn.b_uT)]
    noload_uT = np.tile(drawn.rest_uT.astype(np.float32), (n, 1))
    temperature = np.zeros((n, 5), np.float32)
    return Readings(
        f"{board}_{skin}", board, skin, "recorded", press, press, press, *columns, noload_uT, temperature,
        np.arange(float(n)), press,
    )  # fmt: skip


def test_each_model_is_made_from_all_other_boards_only(monkeypatch):
    captures = [capture(f"b{i}", f"s{i}", i) for i in range(3)]
    boards = rig.recorded_boards(captures, COMPARE, "scene mine")
    assert list(boards) == ["b0", "b1", "b2"]
    np.testing.assert_allclose(boards["b1"].place_mm, draw(12)[1].place_mm - 8, atol=1e-5)
    used = {}

    class Executor:
        def __enter__(self):
            return self

        def __exit__(self, *_):
            return None

        def submit(self, function, base, others, *_):
            held_out = next(board for board in boards if board not in {other.name for other in others})
            used[held_out] = [other.name for other in others]
            result = load_universal()
            return type("Task", (), {"result": lambda self: result})()

    monkeypatch.setattr(rig, "make_executor", lambda **_: Executor())
    made = rig.make_models(load_universal(), boards, TrainingSettings(skins_n=1, steps_n=2), 0)
    assert used == {"b0": ["b1", "b2"], "b1": ["b0", "b2"], "b2": ["b0", "b1"]}
    assert list(made) == list(boards)


def test_boards_with_several_skins_and_single_boards_are_refused():
    for captures in (
        [capture("b0", "s0", 0)],
        [capture("b0", "s0", 0), capture("b0", "s1", 1), capture("b1", "s2", 2)],
    ):
        with pytest.raises(ParamsError, match="boards with one skin each must be two or more"):
            rig.recorded_boards(captures, COMPARE, "scene mine")

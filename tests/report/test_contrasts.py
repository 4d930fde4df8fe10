"""Contrasts of the sweeps of figure 6, from points small enough to be subtracted by hand."""

import pytest

from pipeline.report import numbers
from pipeline.statistics import tidy
from tests.report.test_learning_numbers import HELD_OUT, point


def points(key: str, by_count: dict[int, tuple[float, float]], **words: str) -> list[dict]:
    """Points of two boards, by count the accuracy of each."""
    return [
        point(dict.fromkeys(skins, float(pct)), board, **{key: count}, **words)
        for count, both in by_count.items()
        for (board, skins), pct in zip(HELD_OUT.items(), both, strict=True)
    ]


def contrasts_of_pokes(points: list[dict]) -> dict:
    return numbers.contrasts_of_pokes(tidy([], {"pokes": points}))


def contrasts_of_sensors(points: list[dict]) -> dict:
    return numbers.contrasts_of_sensors(tidy([], {"sensors": points}))


def gains(contrast: dict) -> dict[str, float]:
    return {board: own["accuracy_pct"] for board, own in contrast["by_board"].items()}


def test_pokes_are_compared_with_none_and_beyond_the_papers_plateau():
    found = contrasts_of_pokes(points("pokes_n", {0: (70, 80), 65: (72, 81), 780: (80, 84), 3900: (81, 83)}))
    assert {name: (one["from_pokes_n"], one["to_pokes_n"]) for name, one in found.items()} == {
        "pokes_first": (0, 65), "pokes_gain": (0, 780), "pokes_plateau": (780, 3900),
    }  # fmt: skip
    assert gains(found["pokes_gain"]) == {"b0": 10.0, "b1": 4.0}
    assert gains(found["pokes_plateau"]) == {"b0": 1.0, "b1": -1.0}
    assert found["pokes_gain"]["accuracy_pct"]["values"] == pytest.approx([10.0, 4.0])


def test_what_a_sweep_does_not_reach_is_absent():
    found = contrasts_of_pokes(points("pokes_n", {0: (70, 80), 65: (72, 81), 390: (75, 83)}))
    assert found.keys() == {"pokes_first", "pokes_gain"}
    assert found["pokes_gain"]["to_pokes_n"] == 390
    assert contrasts_of_pokes(points("pokes_n", {0: (70, 80)})) == {}
    only = points("trained_on_skins_n", {1: (50, 60)}, method="multi")
    others = [point | {"method": method} for method in ("triplet", "adapted") for point in only]
    assert contrasts_of_sensors([*only, *others]).keys() == {
        "sensors_adapted_over_multi", "sensors_adapted_over_triplet",
    }  # fmt: skip


def test_methods_are_compared_at_every_number_of_skins_and_gains_with_few_and_many():
    scores = {
        "multi": {1: (50, 60), 15: (80, 84)}, "triplet": {1: (48, 58), 15: (78, 82)},
        "adapted": {1: (58, 64), 15: (80, 83)},
    }  # fmt: skip
    found = contrasts_of_sensors(
        [point for name, own in scores.items() for point in points("trained_on_skins_n", own, method=name)]
    )
    assert gains(found["sensors_more_multi"]) == {"b0": 30.0, "b1": 24.0}
    over = found["sensors_adapted_over_triplet"]
    assert [(one["skins_n"], gains(one)) for one in over] == [
        (1, {"b0": 10.0, "b1": 6.0}), (15, {"b0": 2.0, "b1": 1.0}),
    ]  # fmt: skip
    assert gains(found["sensors_gain_fewer"]) == {"b0": 8.0, "b1": 5.0}
    assert found["sensors_gain_fewer"]["accuracy_pct"]["mean"] == 6.5

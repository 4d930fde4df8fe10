"""Tests of the numbers of experiments on many skins.

They are compared with values calculated by hand. Some of the numbers are contrasts, which are differences between
points of a sweep.
"""

import pandas as pd
import pytest

from pipeline.report.numbers import (
    PAIRS,
    contrasts_of_pokes,
    contrasts_of_sensors,
    learning_numbers,
)
from pipeline.scores import join, rows_of_cards, rows_of_networks
from pipeline.statistics import as_json
from tests.report import synthetic

HELD_OUT = {"b0": ("s0", "s1"), "b1": ("s2", "s3")}
# On each skin, adaptation increases the accuracy by this number of percentage points.
BETTER = {"s0": 2.0, "s1": 4.0, "s2": 6.0, "s3": 8.0}


BOARD_OF = {skin: board for board, skins in HELD_OUT.items() for skin in skins}


def scores(by_skin: dict[str, float]) -> dict:
    skin_scores = {skin: {"accuracy_pct": pct, "mse_xy_mm2": 1.0, "mse_f_N2": 0.5} for skin, pct in by_skin.items()}
    mean = {"accuracy_pct": sum(by_skin.values()) / len(by_skin), "mse_xy_mm2": 1.0, "mse_f_N2": 0.5}
    return {"all": mean, "registered": mean, "by_skin": skin_scores, "rows_n": 10 * len(skin_scores)} | {
        "board_of": {skin: BOARD_OF[skin] for skin in skin_scores}
    }


def card(experiment: str, fold: str, by_skin: dict[str, float], recipe: str = "paper", seed_i: int = 0) -> dict:
    return synthetic.card(experiment, fold, scores(by_skin), recipe, seed_i)


def point(by_skin: dict[str, float], fold: str = "b1", seed_i: int = 0, **keys: object) -> dict:
    return {"fold": fold, "seed_i": seed_i, "scores": scores(by_skin)} | keys


def board_cards(experiment: str, pct: float, recipe: str = "paper") -> list[dict]:
    return [card(experiment, fold, dict.fromkeys(skins, pct), recipe) for fold, skins in HELD_OUT.items()]


def adapted_cards(recipe: str, base_pct: float, times: float) -> list[dict]:
    return [
        card("adapt", fold, {skin: base_pct + times * BETTER[skin]}, recipe)
        for fold, skins in HELD_OUT.items()
        for skin in skins
    ]


CARDS = [
    *board_cards("lobo", 80.0), *board_cards("triplet", 78.0),
    *adapted_cards("paper", 78.0, 1.0), *adapted_cards("control", 78.0, 0.5),
    *board_cards("lobo", 1.0, "released"), *board_cards("triplet", 2.0, "other"), *adapted_cards("other", 3.0, 1.0),
]  # fmt: skip


def rows(experiment: str, points: list[dict]) -> pd.DataFrame:
    """Return the rows of a sweep's points in the table of scores."""
    keys = {"seed_i": "seed"}
    named = [
        {keys.get(key, key): value for key, value in point.items()} | {"experiment": experiment} for point in points
    ]
    return rows_of_networks(({key: row[key] for key in row if key != "scores"}, row["scores"]) for row in named)


def numbers(cards: list[dict] = CARDS, **points: list[dict]) -> dict:
    table = join([rows_of_cards(cards), *(rows(name, of_sweep) for name, of_sweep in points.items())])
    return as_json(learning_numbers(table, headline="paper"))


def paired(of: str, over: str) -> dict:
    (one,) = [one for one in numbers()["paired"] if (one["of"], one["over"]) == (of, over)]
    return one


def test_scores_of_table_2_are_averaged_over_skins_and_then_over_boards():
    table2 = numbers()["table2"]
    assert table2.keys() == {"multi", "triplet", "adapted"}
    assert table2["triplet"]["accuracy_pct"] == {"mean": 78.0, "n": 2, "sd": 0.0, "values": [78.0, 78.0]}
    # The accuracies on the skins of b0 are 80 and 82. On the skins of b1, they are 84 and 86.
    assert table2["adapted"]["accuracy_pct"] == over(81.0, 85.0)


def over(*boards: float) -> dict:
    sd = (boards[1] - boards[0]) / 2**0.5
    return {"mean": sum(boards) / 2, "n": 2, "sd": pytest.approx(sd), "values": pytest.approx(list(boards))}


def test_paired_differences_are_averaged_over_the_skins_of_each_board():
    assert [(one["of"], one["over"]) for one in numbers()["paired"]] == [one for one in PAIRS if "single" not in one]
    # The gains are 2 and 4 percentage points on the skins of b0, and 6 and 8 on the skins of b1.
    assert paired("adapted", "triplet")["accuracy_pct"] == over(3.0, 7.0)
    by_board = paired("adapted", "triplet")["by_board"]
    assert {board: metrics["accuracy_pct"] for board, metrics in by_board.items()} == {"b0": 3.0, "b1": 7.0}
    assert paired("adapted", "control")["accuracy_pct"] == over(1.5, 3.5)
    assert paired("triplet", "multi")["accuracy_pct"] == {"mean": -2.0, "n": 2, "sd": 0.0, "values": [-2.0, -2.0]}
    assert paired("adapted", "multi")["accuracy_pct"]["mean"] == 3.0
    assert paired("control", "triplet")["accuracy_pct"]["mean"] == 2.5


def test_sweep_over_the_number_of_pokes_is_sorted():
    points = [
        *(point({skin: pct}, pokes_n=n) for n, skin, pct in ((390, "s2", 90.0), (390, "s3", 94.0))),
        *(point({skin: pct}, pokes_n=n) for n, skin, pct in ((65, "s2", 80.0), (65, "s3", 86.0))),
        point({"s2": 70.0, "s3": 72.0}, pokes_n=0), point({"s2": 74.0, "s3": 76.0}, seed_i=1, pokes_n=0),
    ]  # fmt: skip
    sweep = numbers([], pokes=points)["sweep_pokes"]
    assert [(one["pokes_n"], one["accuracy_pct"]["mean"]) for one in sweep] == [(0, 73.0), (65, 83.0), (390, 92.0)]
    assert sweep[0]["accuracy_pct"] == {"mean": 73.0, "n": 1, "sd_seeds": pytest.approx(8**0.5)}


def test_sweep_over_the_number_of_sensors_has_a_point_per_method_and_count():
    points = [
        point(by_skin, f"b1-{skins_n:02d}skins-draw{draw_i}", method=method, trained_on_skins_n=skins_n)
        for method, step_pct in (("multi", 0.0), ("triplet", 1.0), ("adapted", 2.0))
        for skins_n in (3, 1)
        for draw_i in range(2)
        for by_skin in (
            [{"s2": 50.0 + skins_n + step_pct + draw_i}, {"s3": 60.0 + skins_n + step_pct + draw_i}]
            if method == "adapted"
            else [{"s2": 50.0 + skins_n + step_pct + draw_i, "s3": 60.0 + skins_n + step_pct + draw_i}]
        )
    ]
    sweep = numbers([], sensors=points)["sweep_sensors"]
    assert [(one["method"], one["skins_n"], one["accuracy_pct"]["mean"]) for one in sweep] == [
        ("multi", 1, 56.5), ("multi", 3, 58.5), ("triplet", 1, 57.5), ("triplet", 3, 59.5), ("adapted", 1, 58.5),
        ("adapted", 3, 60.5),
    ]  # fmt: skip
    # The number n is that of boards. There is one board, with two draws of skins.
    assert all(one["accuracy_pct"]["n"] == 1 for one in sweep)
    assert all(one["accuracy_pct"]["sd_seeds"] == pytest.approx(0.5**0.5) for one in sweep)


def points(key: str, by_count: dict[int, tuple[float, float]], **keys: str) -> list[dict]:
    """Return the points of a sweep on two boards. `by_count` has the accuracies of both boards at each count."""
    return [
        point(dict.fromkeys(skins, float(pct)), board, **{key: count}, **keys)
        for count, both in by_count.items()
        for (board, skins), pct in zip(HELD_OUT.items(), both, strict=True)
    ]


def gains(contrast: dict) -> dict[str, float]:
    return {board: metrics["accuracy_pct"] for board, metrics in contrast["by_board"].items()}


def test_contrasts_of_pokes_are_the_gains_of_few_many_and_additional_pokes():
    found = contrasts_of_pokes(
        rows("pokes", points("pokes_n", {0: (70, 80), 65: (72, 81), 780: (80, 84), 3900: (81, 83)}))
    )
    assert {name: (one["from_pokes_n"], one["to_pokes_n"]) for name, one in found.items()} == {
        "pokes_first": (0, 65), "pokes_gain": (0, 780), "pokes_plateau": (780, 3900),
    }  # fmt: skip
    assert gains(found["pokes_gain"]) == {"b0": 10.0, "b1": 4.0}
    assert gains(found["pokes_plateau"]) == {"b0": 1.0, "b1": -1.0}
    assert found["pokes_gain"]["accuracy_pct"].values == pytest.approx([10.0, 4.0])


def test_contrasts_of_sensors_are_differences_between_methods_and_numbers_of_skins():
    scores = {
        "multi": {1: (50, 60), 15: (80, 84)}, "triplet": {1: (48, 58), 15: (78, 82)},
        "adapted": {1: (58, 64), 15: (80, 83)},
    }  # fmt: skip
    swept = [row for name, by_count in scores.items() for row in points("trained_on_skins_n", by_count, method=name)]
    found = contrasts_of_sensors(rows("sensors", swept))
    assert gains(found["sensors_more_multi"]) == {"b0": 30.0, "b1": 24.0}
    over = found["sensors_adapted_over_triplet"]
    assert [(one["skins_n"], gains(one)) for one in over] == [
        (1, {"b0": 10.0, "b1": 6.0}), (15, {"b0": 2.0, "b1": 1.0}),
    ]  # fmt: skip
    assert gains(found["sensors_gain_fewer"]) == {"b0": 8.0, "b1": 5.0}
    assert found["sensors_gain_fewer"]["accuracy_pct"].mean == 6.5

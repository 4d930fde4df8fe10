"""Tests of the figures in the report: marks, units, source, the paper's numbers, and reproducible files."""

import xml.etree.ElementTree as ET

import numpy as np
import pytest

from pipeline.paper import TABLE_2
from pipeline.report.figures import (
    HEADLINE,
    IN_CONTEXT,
    bar,
    error_grid,
    score_figures,
    sweep_pokes,
    sweep_sensors,
    unseen_rows,
)
from tests.report.synthetic import all_experiments, new_board, texts_of

PLACES_MM = np.array([[0.0, 0.0], [0.0, 2.0], [2.0, 0.0], [2.0, 2.0]] * 3)


def draw_grid(error_mm: float = 0.5) -> str:
    return error_grid(PLACES_MM, PLACES_MM + error_mm, title="lab (recorded), lobo")


def test_skin_and_chips_are_drawn_only_on_the_grid_of_the_paper():
    elsewhere = error_grid(PLACES_MM - 20, PLACES_MM - 20, title="eflesh")
    # The figure on the paper's grid has more elements: five chips, the skin and two entries of the legend. Its axes
    # have two spines fewer.
    assert draw_grid().count("-patch_") - elsewhere.count("-patch_") == 5 + 1 + 2 - 2
    assert "chip" in draw_grid()
    assert "chip" not in elsewhere


def test_title_of_the_figure_states_the_place_with_the_largest_error():
    errors_mm = np.zeros_like(PLACES_MM)
    errors_mm[PLACES_MM[:, 0] + PLACES_MM[:, 1] == 4, 0] = 3.0
    assert "worst 3.00 mm at (2, 2) mm" in error_grid(PLACES_MM, PLACES_MM + errors_mm, title="t")


def row(accuracy_pct: float, mse_xy_mm2: float = 0.5, **spread) -> dict:
    spread = spread or {"sd": 0.1, "n": 6}
    return {
        "accuracy_pct": {"mean": accuracy_pct, **spread},
        "mse_xy_mm2": {"mean": mse_xy_mm2, **spread},
    }


POKES = [{"pokes_n": n, **row(80.0 + i, 0.7 - 0.05 * i)} for i, n in enumerate((0, 65, 130, 195, 390, 780, 1560, 3900))]
SENSORS = [
    {"method": method, "skins_n": n, **row(50.0 + 2 * n + i)}
    for i, method in enumerate(("multi", "triplet", "adapted"))
    for n in (1, 3, 6, 9, 12, 15)
]


def test_error_bars_do_not_exceed_the_range_of_the_metric():
    found = [bar({"mean": mean, "sd": 10.0, "n": 6}, "accuracy_pct") for mean in (95.0, 50.0, 5.0)]
    assert found == [(85.0, 95.0, 100.0), (40.0, 50.0, 60.0), (0.0, 5.0, 15.0)]
    assert bar({"mean": 0.5, "sd": 0.7, "n": 6}, "mse_xy_mm2") == (0.0, 0.5, 1.2)


@pytest.mark.parametrize(
    ("spread", "low", "high"),
    [
        ({"sd": 1.0, "n": 6, "ci95": [48.0, 53.0]}, 48, 53), ({"sd": 1.0, "n": 2, "values": [49.0, 54.0]}, 49, 54),
        ({"sd_seeds": 1.5, "n": 1}, 48.5, 51.5), ({"n": 1}, 50, 50),
    ],
)  # fmt: skip
def test_bars_show_the_interval_the_range_or_the_standard_deviation(spread, low, high):
    assert bar({"mean": 50.0, **spread}, "accuracy_pct") == (low, 50.0, high)


def test_only_sweeps_that_were_run_are_drawn():
    assert list(score_figures({"sweep_pokes": POKES}, "simulated")) == ["sweep_pokes.svg"]
    both = score_figures({"sweep_pokes": POKES, "sweep_sensors": SENSORS}, "simulated")
    assert list(both) == ["sweep_pokes.svg", "sweep_sensors.svg"]


@pytest.mark.parametrize("draw", [sweep_pokes, sweep_sensors])
def test_equal_sweeps_give_equal_figures(draw):
    rows = POKES if draw is sweep_pokes else SENSORS
    figure, again, other = (draw(sweep, "simulated") for sweep in (rows, rows, [*rows[:-1], rows[-1] | row(70.0)]))
    assert figure == again != other
    ET.fromstring(figure)


LAB = all_experiments("recorded") | {"new_board": new_board()}


def test_headline_of_recorded_boards_has_the_mean_of_each_method_and_number_of_labels():
    labels = texts_of(score_figures(LAB, "recorded")[HEADLINE])
    for row in unseen_rows(LAB):
        assert f"{row['labels_n']} labels" in labels
        assert IN_CONTEXT[row["method"]] in labels
        assert f" {row['accuracy_pct']['mean']:.0f} " in labels
    rms_N = TABLE_2["adapted"]["mse_f_N2"][0] ** 0.5
    for label in ("recorded", "rms error / N", "constant force", "paper, adapted", f"{rms_N:.2f}"):
        assert label in labels

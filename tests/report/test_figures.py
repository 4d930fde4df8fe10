"""Figures: marks, units, source, the paper's numbers, and the same bytes for the same numbers."""

import io
import json
import re
import xml.etree.ElementTree as ET

import numpy as np
import pytest

from pipeline.report.drawing import drawing, svg
from pipeline.report.figures import (
    HEADLINE,
    bars,
    error_grid,
    headline_figures,
    learning_figures,
    sweep_pokes,
    sweep_sensors,
)
from pipeline.report.formatting import models
from tests.report.synthetic import all_experiments, texts_of
from tests.stages.checkout import ROOT

PLACES_MM = np.array([[0.0, 0.0], [0.0, 2.0], [2.0, 0.0], [2.0, 2.0]] * 3)


def draw_grid(error_mm: float = 0.5) -> str:
    return error_grid(PLACES_MM, PLACES_MM + error_mm, title="lab (recorded), lobo")


def test_a_figure_is_svg_with_units_on_its_axes_and_its_source_in_the_title():
    text = draw_grid()
    ET.fromstring(text)
    for word in ("x / mm", "y / mm", "mean place error / mm", "recorded"):
        assert word in text


def test_every_place_is_drawn_once_however_often_it_was_poked():
    assert draw_grid().count("<title>x / mm") == 4


def test_a_skin_and_its_chips_are_drawn_where_places_lie_on_the_papers_grid_and_nowhere_else():
    elsewhere = error_grid(PLACES_MM - 20, PLACES_MM - 20, title="eflesh")
    # Five chips and a skin, and these two in the legend; axes without a spine on two sides.
    assert draw_grid().count('id="patch_') - elsewhere.count('id="patch_') == 5 + 1 + 2 - 2
    assert "chip" in draw_grid()
    assert "chip" not in elsewhere


def test_the_worst_place_is_named():
    errors_mm = np.zeros_like(PLACES_MM)
    errors_mm[PLACES_MM[:, 0] + PLACES_MM[:, 1] == 4, 0] = 3.0
    assert "worst 3.00 mm at x = 2, y = 2" in error_grid(PLACES_MM, PLACES_MM + errors_mm, title="t")


def test_what_nobody_sees_is_left_out_and_words_keep_their_digits():
    with drawing(3.0, 2.0) as figure:
        axes = figure.subplots()
        axes.plot([0, 1], [0.123456, 2], "o")
        axes.set_title("bias 0.00899")
        text = svg(figure)
    assert "bias 0.00899" in text
    assert "= 0.1235" in text
    assert "<metadata>" not in text
    assert re.search(r' (?:d|x|y|transform)="[^"]*\.\d{3}', text) is None
    assert re.search(r"^ ", text, re.MULTILINE) is None


def test_letters_of_formulas_have_another_family_to_fall_back_on():
    with drawing(3.0, 2.0) as figure:
        figure.subplots().set_yscale("log")
        families = re.findall(r"font-family: ([^\";]*)", svg(figure))
    assert families
    assert all(family.endswith("sans-serif") for family in families)


def test_same_data_same_bytes_other_data_other_bytes():
    assert draw_grid() == draw_grid()
    assert draw_grid() != error_grid(PLACES_MM, PLACES_MM + np.arange(12)[:, None], title="lab (recorded), lobo")


def test_axes_lie_where_matplotlib_lays_them_out_when_it_saves():
    def places(save) -> list[tuple[float, ...]]:
        with drawing(5.0, 3.0) as figure:
            for axes, scale in zip(figure.subplots(1, 2), ("linear", "log"), strict=True):
                axes.plot([1, 10, 1000])
                axes.set(ylabel="force / N", title="a long title of a panel", yscale=scale)
            save(figure)
            return [axes.get_position().bounds for axes in figure.axes]

    assert places(svg) == places(lambda figure: figure.savefig(io.BytesIO(), format="svg"))


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


def test_the_sweep_over_pokes_shows_none_at_all_units_source_and_the_two_points_of_the_paper():
    words = texts_of(sweep_pokes(POKES, "simulated"))
    for word in ("0", "65", "3900", "simulated", "%", "mm²", "paper (table 2)", "pokes"):
        assert word in words


def test_the_sweep_over_sensors_has_a_line_for_each_method_that_was_asked():
    words = texts_of(sweep_sensors(SENSORS, "recorded"))
    for word in ("multi-sensor + triplet", "adapted", "training skins", "recorded"):
        assert word in words
    assert "adapted" not in texts_of(sweep_sensors([one for one in SENSORS if one["method"] == "multi"], "recorded"))


def test_bars_are_one_sd_cut_where_no_score_can_be():
    accuracy = [row(95.0, sd=10.0, n=6), row(50.0, sd=10.0, n=6), row(5.0, sd=10.0, n=6)]
    means, lengths = bars(accuracy, "accuracy_pct")
    np.testing.assert_array_equal(means, [95.0, 50.0, 5.0])
    np.testing.assert_array_equal(lengths, [[10.0, 10.0, 5.0], [5.0, 10.0, 10.0]])
    _, lengths = bars([row(1.0, 0.5, sd=0.7, n=6)], "mse_xy_mm2")
    np.testing.assert_array_equal(lengths, [[0.5], [0.7]])


@pytest.mark.parametrize(
    ("spread", "down", "up"),
    [
        ({"sd": 1.0, "n": 6, "ci95": [48.0, 53.0]}, 2.0, 3.0), ({"sd": 1.0, "n": 2, "values": [49.0, 54.0]}, 1.0, 4.0),
        ({"sd_seeds": 1.5, "n": 1}, 1.5, 1.5), ({"n": 1}, 0.0, 0.0),
    ],
)  # fmt: skip
def test_bars_are_the_interval_over_boards_else_the_range_of_boards_else_the_sd_over_seeds(spread, down, up):
    _, lengths = bars([row(50.0, **spread)], "accuracy_pct")
    np.testing.assert_array_equal(lengths, [[down], [up]])


def test_only_sweeps_with_numbers_are_drawn():
    assert [name for name, _ in learning_figures({"sweep_pokes": POKES}, "simulated")] == ["sweep_pokes.svg"]
    both = dict(learning_figures({"sweep_pokes": POKES, "sweep_sensors": SENSORS}, "simulated"))
    assert list(both) == ["sweep_pokes.svg", "sweep_sensors.svg"]
    assert dict(learning_figures({}, "simulated")) == {}


@pytest.mark.parametrize("draw", [sweep_pokes, sweep_sensors])
def test_same_numbers_same_bytes_other_numbers_other_bytes(draw):
    rows = POKES if draw is sweep_pokes else SENSORS
    figure, again, other = (draw(some, "simulated") for some in (rows, rows, [*rows[:-1], rows[-1] | row(70.0)]))
    assert figure == again != other
    ET.fromstring(figure)


def test_each_row_of_table_2_is_drawn_and_named_with_source_and_boards():
    numbers = all_experiments()
    said = texts_of(headline_figures(numbers, "simulated")[HEADLINE])
    for name in numbers["table2"]:
        assert models(numbers)[name].title.split(",")[0] in said
    for word in ("simulated", "paper", "accuracy", "MSE_xy", "boards held out"):
        assert word in said


def test_same_numbers_same_bytes_and_no_experiment_about_boards_no_figure():
    numbers = all_experiments()
    assert headline_figures(numbers, "simulated") == headline_figures(numbers, "simulated")
    assert headline_figures({name: numbers[name] for name in ("provenance",)}, "recorded") == {}


@pytest.mark.parametrize("scene", ["lab"])
def test_labels_of_a_new_board_are_drawn_for_each_method(scene):
    numbers = json.loads((ROOT / "reports" / scene / "numbers.json").read_text())
    said = texts_of(headline_figures(numbers, "recorded")[HEADLINE])
    assert all(f"{row['method']} ({row['inputs']})" in said for row in numbers["labels"])
    assert "recorded" in said
    assert "as labelled" in said

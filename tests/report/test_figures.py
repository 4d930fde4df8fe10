"""Tests of the figures in the report: marks, units, source, the paper's numbers, and reproducible files."""

import re
import xml.etree.ElementTree as ET
from html import unescape

import numpy as np
import pytest

from pipeline.paper import TABLE_2
from pipeline.plot import drawing, svg
from pipeline.report.figures import (
    CONSTANT_NAME,
    CONSTANT_ROW,
    FORCE,
    FORCE_LABEL,
    HEADLINE,
    IN_CONTEXT,
    PLACE_LABEL,
    Outline,
    bars,
    error_grid,
    headline_figures,
    learning_figures,
    spread_of,
    sweep_pokes,
    sweep_sensors,
    unseen_boards,
    unseen_rows,
)
from pipeline.report.table_2 import models
from tests.report.synthetic import all_experiments, new_board, texts_of

PLACES_MM = np.array([[0.0, 0.0], [0.0, 2.0], [2.0, 0.0], [2.0, 2.0]] * 3)


def draw_grid(error_mm: float = 0.5) -> str:
    return error_grid(PLACES_MM, PLACES_MM + error_mm, title="lab (recorded), lobo")


def test_figure_of_place_errors_has_units_and_source():
    text = draw_grid()
    ET.fromstring(text)
    for label in ("x / mm", "y / mm", "mean position error / mm", "recorded"):
        assert label in text


def test_each_place_is_drawn_once():
    assert draw_grid().count("<title>x / mm") == 4


def test_skin_and_chips_are_drawn_only_on_the_grid_of_the_paper():
    elsewhere = error_grid(PLACES_MM - 20, PLACES_MM - 20, title="eflesh")
    # The figure on the paper's grid has more elements: five chips, the skin and two entries of the legend. Its axes
    # have two spines fewer.
    assert draw_grid().count('id="patch_') - elsewhere.count('id="patch_') == 5 + 1 + 2 - 2
    assert "chip" in draw_grid()
    assert "chip" not in elsewhere


def test_outline_of_another_board_replaces_that_of_the_papers_board():
    outline = Outline((10.0, 4.0), (30.0, 20.0), ((20.0, 10.0), (25.0, 15.0)))
    text = error_grid(PLACES_MM + 12, PLACES_MM + 12, title="mine", outline=outline)
    # The paper's board has five chips, the other board two.
    assert draw_grid().count('id="patch_') - text.count('id="patch_') == 5 - 2


def test_title_of_the_figure_states_the_place_with_the_largest_error():
    errors_mm = np.zeros_like(PLACES_MM)
    errors_mm[PLACES_MM[:, 0] + PLACES_MM[:, 1] == 4, 0] = 3.0
    assert "worst 3.00 mm at (2, 2) mm" in error_grid(PLACES_MM, PLACES_MM + errors_mm, title="t")


def test_svg_is_made_smaller_without_changing_digits_in_texts():
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


def test_fonts_of_formulas_have_sans_serif_as_alternative():
    with drawing(3.0, 2.0) as figure:
        figure.subplots().set_yscale("log")
        families = re.findall(r"font-family: ([^\";]*)", svg(figure))
    assert families
    assert all(family.endswith("sans-serif") for family in families)


def test_equal_errors_give_an_equal_figure():
    assert draw_grid() == draw_grid()
    assert draw_grid() != error_grid(PLACES_MM, PLACES_MM + np.arange(12)[:, None], title="lab (recorded), lobo")


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


def test_figure_of_the_number_of_pokes_has_labels():
    labels = texts_of(sweep_pokes(POKES, "simulated"))
    for label in ("0", "65", "3900", "simulated", "%", "mm²", "paper's table 2: mean ± standard deviation", "pokes"):
        assert label in labels


def test_figure_of_the_number_of_sensors_has_a_line_for_each_method():
    labels = texts_of(sweep_sensors(SENSORS, "recorded"))
    for label in ("multi-sensor + triplet", "adapted", "training skins", "recorded"):
        assert label in labels
    assert "adapted" not in texts_of(sweep_sensors([one for one in SENSORS if one["method"] == "multi"], "recorded"))


def test_error_bars_do_not_exceed_the_range_of_the_metric():
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
def test_bars_show_the_interval_the_range_or_the_standard_deviation(spread, down, up):
    _, lengths = bars([row(50.0, **spread)], "accuracy_pct")
    np.testing.assert_array_equal(lengths, [[down], [up]])


def test_only_sweeps_that_were_run_are_drawn():
    assert [name for name, _ in learning_figures({"sweep_pokes": POKES}, "simulated")] == ["sweep_pokes.svg"]
    both = dict(learning_figures({"sweep_pokes": POKES, "sweep_sensors": SENSORS}, "simulated"))
    assert list(both) == ["sweep_pokes.svg", "sweep_sensors.svg"]
    assert dict(learning_figures({}, "simulated")) == {}


@pytest.mark.parametrize("draw", [sweep_pokes, sweep_sensors])
def test_equal_sweeps_give_equal_figures(draw):
    rows = POKES if draw is sweep_pokes else SENSORS
    figure, again, other = (draw(sweep, "simulated") for sweep in (rows, rows, [*rows[:-1], rows[-1] | row(70.0)]))
    assert figure == again != other
    ET.fromstring(figure)


def test_figure_of_table_2_has_all_its_rows():
    numbers = all_experiments()
    labels = texts_of(headline_figures(numbers, "simulated")[HEADLINE])
    for name in numbers["table2"]:
        assert models(numbers)[name].title.split(",")[0] in labels
    for label in ("simulated", "paper", "accuracy", "MSE_xy", "held-out boards"):
        assert label in labels


def test_one_figure_of_table_2_shows_place_errors_and_another_force_errors():
    figures = headline_figures(all_experiments(), "simulated")
    assert "MSE_F / N²" in texts_of(figures[FORCE])
    assert "R² of F" in texts_of(figures[FORCE])
    assert "MSE_xy / mm²" in texts_of(figures[HEADLINE])


def test_equal_numbers_give_an_equal_figure_of_table_2():
    numbers = all_experiments()
    assert headline_figures(numbers, "simulated") == headline_figures(numbers, "simulated")
    assert headline_figures({name: numbers[name] for name in ("provenance",)}, "recorded") == {}


LAB = all_experiments("recorded") | {"new_board": new_board()}


def titles(svg: str) -> list[str]:
    return [unescape(title) for title in re.findall(r"<title>(.*?)</title>", svg, re.DOTALL)]


@pytest.mark.parametrize("large", [True, False])
def test_figure_of_unseen_boards_has_a_mark_for_each_board_and_for_the_paper(large):
    shown = titles(unseen_boards(LAB, "recorded", large=large))
    for row in unseen_rows(LAB):
        for axis, metric in ((PLACE_LABEL, "accuracy_pct"), (FORCE_LABEL, "rms_f_N")):
            for value in row[metric]["by_board"].values():
                assert f"{IN_CONTEXT[row['method']]}\n{axis} = {value:.4g}\n{row['labels_n']} labels" in shown
    (mean, sd), (mse, sd_mse) = (TABLE_2["adapted"][metric] for metric in ("accuracy_pct", "mse_f_N2"))
    for axis, middle, low, high in (
        (PLACE_LABEL, mean, mean - sd, min(mean + sd, 100)),
        (FORCE_LABEL, mse**0.5, (mse - sd_mse) ** 0.5, (mse + sd_mse) ** 0.5),
    ):
        ends = f"bar from {low:.4g} to {high:.4g}"
        assert any(f"{axis} = {middle:.4g}" in title and ends in title for title in shown)


def test_figure_of_unseen_boards_shows_the_force_error_of_a_constant_estimate():
    shown = titles(headline_figures(LAB, "recorded")[FORCE])
    for error_N in (1, 3):
        assert f"{CONSTANT_NAME}\n{FORCE_LABEL} = {error_N}\n{CONSTANT_ROW}" in shown


def test_places_and_forces_of_unseen_boards_are_in_separate_figures():
    figures = headline_figures(LAB, "recorded")
    assert PLACE_LABEL in texts_of(figures[HEADLINE])
    assert FORCE_LABEL in texts_of(figures[FORCE])
    assert FORCE_LABEL not in texts_of(figures[HEADLINE])
    without_forces = [{name: row[name] for name in row if name != "rms_f_N"} for row in LAB["new_board"]]
    assert list(headline_figures(LAB | {"new_board": without_forces}, "recorded")) == [HEADLINE]


def test_caption_names_the_rows_whose_bars_have_another_meaning():
    scores = {"single": row(40.0), "multi": row(80.0, ci95=[70, 90]), "adapted": row(85.0, ci95=[80, 90])}
    assert spread_of(scores) == "95 % interval over boards; single: standard deviation"
    del scores["single"]
    assert spread_of(scores) == "95 % interval over boards"

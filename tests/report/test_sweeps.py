"""Figures of sweeps: both panels, units, source, the paper's two points, and the same bytes for the same numbers."""

import re
import xml.etree.ElementTree as ET

import numpy as np
import pytest

from pipeline.report.figures import bars, learning_figures, learning_pages, sweep_pokes, sweep_sensors
from tests.report.test_work_precision import said


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
LEARNING = [
    {"method": method, "inputs": inputs, "train_s": train_s, "inference_us": 5.0 / train_s, **row(40.0, error)}
    for method, inputs, train_s, error in (
        ("ridge", "raw", 0.01, 3.0),
        ("ridge", "shape", 0.02, 2.0),
        ("kNN", "raw", 0.1, 2.5),
        ("network", "raw", 10.0, 0.3),
    )
]
ADAPTATION = [{"pokes_n": n, "seconds": 1.0 + n / 1000, **row(85.0, 0.5 - n / 10000)} for n in (65, 390, 3900)]


@pytest.fixture(scope="module")
def costs() -> dict[str, str]:
    return learning_pages({"learning": LEARNING, "adaptation": ADAPTATION}, "simulated")


def drawn(svg: str) -> int:
    """Count marks: each is one use of a path."""
    return len(re.findall("<use ", svg))


def test_the_sweep_over_pokes_shows_none_at_all_units_source_and_the_two_points_of_the_paper():
    words = said(sweep_pokes(POKES, "simulated"))
    for word in ("0", "65", "3900", "simulated", "%", "mm²", "paper (table 2)", "pokes"):
        assert word in words


def test_the_sweep_over_sensors_has_a_line_for_each_method_that_was_asked():
    words = said(sweep_sensors(SENSORS, "recorded"))
    for word in ("multi-sensor + triplet", "adapted", "training skins", "recorded"):
        assert word in words
    assert "adapted" not in said(sweep_sensors([one for one in SENSORS if one["method"] == "multi"], "recorded"))


def test_bars_are_one_sd_cut_where_no_score_can_be():
    accuracy = [row(95.0, sd=10.0, n=6), row(50.0, sd=10.0, n=6), row(5.0, sd=10.0, n=6)]
    means, lengths = bars(accuracy, "accuracy_pct")
    np.testing.assert_array_equal(means, [95.0, 50.0, 5.0])
    np.testing.assert_array_equal(lengths, [[10.0, 10.0, 5.0], [5.0, 10.0, 10.0]])
    _, lengths = bars([row(1.0, 0.5, sd=0.7, n=6)], "mse_xy_mm2")
    np.testing.assert_array_equal(lengths, [[0.5], [0.7]])


@pytest.mark.parametrize(
    ("spread", "words"),
    [
        ({"sd": 1.0, "n": 6, "ci95": [48.0, 52.0]}, "95 % interval over 6 boards"),
        ({"sd_seeds": 1.0, "n": 1}, "sd over seeds"),
        ({"n": 1}, "No bars"),
    ],
)
def test_a_sweep_says_what_its_bars_are(spread, words):
    rows = [{"method": "multi", "skins_n": n, **row(50.0, **spread)} for n in (1, 3)]
    assert words in said(sweep_sensors(rows, "simulated"))


def test_only_sweeps_that_were_asked_for_are_drawn():
    assert [name for name, _ in learning_figures({"sweep_pokes": POKES}, "simulated")] == ["sweep_pokes.svg"]
    both = dict(learning_figures({"sweep_pokes": POKES, "sweep_sensors": SENSORS}, "simulated"))
    assert list(both) == ["sweep_pokes.svg", "sweep_sensors.svg"]
    assert dict(learning_figures({}, "simulated")) == {}


def test_pages_of_costs_hold_what_was_asked_for_and_no_figure_of_what_was_not_timed(costs):
    assert set(costs) == {"training.svg", "inference.svg", "adaptation.svg", "learning.md", "adaptation.md"}
    untimed = [{key: value for key, value in one.items() if key != "train_s"} for one in LEARNING]
    assert set(learning_pages({"learning": untimed}, "simulated")) == {"inference.svg", "learning.md"}
    never = [{key: value for key, value in one.items() if key != "seconds"} for one in ADAPTATION]
    assert set(learning_pages({"adaptation": never}, "simulated")) == {"adaptation.md"}
    assert learning_pages({"choice": {}}, "simulated") == {}


def test_what_was_not_timed_is_left_out_of_the_figure_and_stays_in_the_table():
    untimed = {key: value for key, value in LEARNING[2].items() if key != "train_s"}
    pages = learning_pages({"learning": [*LEARNING[:2], untimed, *LEARNING[3:]]}, "simulated")
    assert "kNN" not in said(pages["training.svg"])
    assert "kNN" in said(pages["inference.svg"])
    (line,) = [line for line in pages["learning.md"].splitlines() if "kNN" in line]
    assert [cell.strip() for cell in line.split("|")][3] == "–"


def test_costs_name_units_and_source_and_label_every_number_of_pokes():
    pages = learning_pages({"learning": LEARNING, "adaptation": ADAPTATION}, "recorded")
    for name, unit in (("training", " / s"), ("inference", " / µs"), ("adaptation", " / s")):
        words = said(pages[f"{name}.svg"])
        assert unit in words
        assert "MSE_xy / mm²" in words
        assert "recorded" in words
    assert {"65", "390", "3900"} <= set(said(pages["adaptation.svg"]).split())


def test_one_point_more_is_one_mark_more(costs):
    few, all_ = learning_pages({"learning": LEARNING[:3]}, "simulated")["training.svg"], costs["training.svg"]
    ticks = {name: len(re.findall('id="[xy]tick_', text)) for name, text in (("few", few), ("all", all_))}
    # A mark stands in the panel and in the legend; a tick is one mark; every label is text and no mark.
    assert drawn(all_) - ticks["all"] - (drawn(few) - ticks["few"]) == 2


@pytest.mark.parametrize("draw", [sweep_pokes, sweep_sensors])
def test_same_numbers_same_bytes_other_numbers_other_bytes(draw):
    rows = POKES if draw is sweep_pokes else SENSORS
    figure, again, other = (draw(some, "simulated") for some in (rows, rows, [*rows[:-1], rows[-1] | row(70.0)]))
    assert figure == again != other
    ET.fromstring(figure)


def test_pages_of_costs_are_the_same_bytes_for_the_same_numbers(costs):
    assert learning_pages({"learning": LEARNING, "adaptation": ADAPTATION}, "simulated") == costs

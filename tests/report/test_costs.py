"""Tests of figures and tables that compare errors with run times."""

import re
from dataclasses import asdict
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.experiments.runtime import REFERENCE, Precision, choose
from pipeline.plot import COLOURS, MARKERS
from pipeline.report.costs import (
    cost_pages,
    cost_tables,
    failures,
    front,
    integrators,
    look_of,
    quadratures,
    stage_costs,
    trade_off,
    trade_off_points,
)
from reskin.physics.magnet import DEFAULT_QUADRATURE
from tests.report.synthetic import cost, texts_of

RULES = [("Gauss in z", "0.5 mm x 6", 10584, 0.004), ("Gauss in z", "0.7 mm x 5", 5120, 0.015)]
RULES += [("Gauss in z", "1 mm x 4", 1936, 0.08), ("midpoint", "0.5 mm x 4", 6400, 0.4)]
QUADRATURES = [
    Precision("dB", REFERENCE, "0.5 mm x 8", 127008, 3e-4),
    *(Precision("dB", method, setting, nodes_n, error) for method, setting, nodes_n, error in RULES),
]
INTEGRATORS = [
    Precision(study, method, setting, 100, error, failure)
    for study in ("relaxation, stiffness 1e+03", "relaxation, stiffness 1e+08")
    for method, setting, error, failure in (
        ("exact update", "", 0.0, None),
        ("Radau", "1e-03", 1e-5, None),
        ("Radau", "1e-07", 1e-9, None),
        ("explicit Euler", "1e-02 s", None, "diverged: error 4e+115 of the force"),
        ("explicit Euler", "1e-03 s", None, "diverged: error nan of the force"),
        ("explicit Euler", "1e-04 s", None, "stopped after 20000 right-hand sides"),
    )
]


def with_times(rows: list[Precision]) -> list[dict]:
    """Return the rows of a study with run times.

    Rows of failed methods and the row of the reference have no run time.
    """
    done = [row for row in rows if row.error is not None and row.method != REFERENCE]
    times = {row.key: {"median_s": 1e-4 * (i + 1), "repeats_n": 5} for i, row in enumerate(done)}
    return [asdict(row) | times.get(row.key, {}) for row in rows]


def draw_quadratures(rows=QUADRATURES, **limits) -> str:
    return quadratures(with_times(rows), asdict(choose(rows, used=DEFAULT_QUADRATURE, **limits)), "simulated")


def draw_integrators(rows=INTEGRATORS) -> str:
    return integrators(with_times(rows))


def test_figure_of_quadratures_has_labels():
    text = texts_of(draw_quadratures())
    for label in (
        "median time per indentation / ms",
        "rms error / rms dB",
        "2 %",
        "simulated",
        "Gauss in z",
        "midpoint",
    ):
        assert label in text
    assert "cheapest below the limit: 0.7 mm x 5" in text
    assert "in use: 0.5 mm x 6" in text
    assert "upper bound of the reference's own error" in text


def test_rule_in_use_is_marked_even_if_no_rule_meets_the_limit():
    text = texts_of(draw_quadratures(error_max=1e-6))
    assert "cheapest" not in text
    assert "in use: 0.5 mm x 6" in text


def test_figure_of_integrators_has_labels():
    text = texts_of(draw_integrators())
    for label in ("stiffness 1e+03", "stiffness 1e+08", "exact update", "Radau", "rms error / rms force"):
        assert label in text
    for line in failures(with_times(INTEGRATORS)):
        for label in line.split():
            assert label in text


def test_failures_are_listed_by_method_and_kind():
    diverged, stopped = failures(with_times(INTEGRATORS))
    assert diverged == (
        "Failed: explicit Euler, diverged: relaxation, stiffness 1e+03 (1e-02 s, 1e-03 s);"
        " relaxation, stiffness 1e+08 (1e-02 s, 1e-03 s)"
    )
    assert stopped.startswith("Failed: explicit Euler, stopped after 20000 right-hand sides: ")
    assert failures(with_times(QUADRATURES)) == []


def test_rows_without_an_error_or_a_time_are_not_drawn():
    # Each point is a <use> element that refers to a marker.
    done = [row for row in INTEGRATORS if row.failure is None]
    assert count_marks(draw_integrators()) == count_marks(draw_integrators(done))
    last = {key: value for key, value in with_times(QUADRATURES)[-1].items() if key != "median_s"}
    choice = asdict(choose(QUADRATURES, used=DEFAULT_QUADRATURE))
    untimed, without = (
        quadratures([*with_times(QUADRATURES)[:-1], *more], choice, "simulated") for more in ([last], [])
    )
    assert count_marks(untimed) == count_marks(without)


def test_cost_pages_contain_only_the_studies_that_were_run():
    stages = {"stages": {"simulate": cost()}}
    assert set(cost_pages(stages, "simulated")) == {"stages.md"}
    assert set(cost_pages(stages | {"integrators": with_times(INTEGRATORS)}, "simulated")) == {
        "integrators.svg", "integrators.md", "stages.md",
    }  # fmt: skip


def test_table_of_stage_costs_has_its_columns():
    (line,) = stage_costs({"train_multi": cost(seconds=0.25)}).to_dict("records")
    assert line == {
        "stage": "train_multi", "computed, s": "3.0", "last run, s": "0.2", "last run, CPU s": "–",
        "training runs": "2", "reused training runs": "1", "peak memory per process, MB": "2",
    }  # fmt: skip


def test_equal_rows_give_equal_figures():
    assert draw_quadratures() == draw_quadratures()
    stiff = draw_integrators()
    assert draw_integrators() == stiff
    slower = [
        row | ({"median_s": row["median_s"] ** 2} if "median_s" in row else {}) for row in with_times(INTEGRATORS)
    ]
    assert integrators(slower) != stiff


@given(st.lists(st.tuples(st.floats(1e-6, 1), st.floats(1e-16, 1)), max_size=12))
def test_front_contains_all_points_that_no_other_point_beats_in_time_and_error(points):
    kept = front(points)
    assert set(kept) <= set(points)
    times, errors = np.array(kept).reshape(-1, 2).T
    assert (np.diff(times) > 0).all()
    assert (np.diff(errors) < 0).all()
    for time, error in points:
        assert any(t <= time and e <= error for t, e in kept)


def test_seven_methods_have_different_colours_and_markers():
    assert len(set(COLOURS)) == len(set(MARKERS)) == 7


def rows_of(places) -> list[dict]:
    return [
        {"method": f"m{i}", "inputs": "raw", "train_s": float(cost), "mse_xy_mm2": {"mean": float(error), "n": 1}}
        for i, (cost, error) in enumerate(places)
    ]


def dominates(one, other) -> bool:
    return one != other and all(a <= b for a, b in zip(one, other, strict=True))


PLACES = st.lists(st.tuples(st.integers(1, 9), st.integers(1, 9)), min_size=1, max_size=20)


@given(PLACES)
def test_only_points_on_the_front_have_labels(places):
    """A point is on the front if no other point is both faster and more accurate."""
    points = trade_off_points(rows_of(places), "train_s")
    naive = set()
    for place in places:
        beaten = False
        for other in places:
            beaten |= dominates(other, place)
        if not beaten:
            naive.add(place)
    assert {point.position for point in points if point.label} == naive
    assert sorted(point.position for point in points) == sorted(places)


@given(PLACES)
def test_labels_of_points_are_in_the_order_of_the_front(places):
    members = [point for point in trade_off_points(rows_of(places), "train_s") if point.label]
    numbered = {int(point.label): point.position for point in members}
    assert sorted(numbered) == list(range(1, len(numbered) + 1))
    ordered = [numbered[i] for i in sorted(numbered)]
    for (cheap, error), (dear, next_error) in pairwise(ordered):
        assert cheap < dear
        assert error > next_error


def test_figure_of_errors_and_times_lists_every_method():
    text = texts_of(trade_off(rows_of([(1, 3), (2, 2), (3, 2.5)]), "train_s", title="t", cost="c"))
    for label in ("1  m0 (raw)", "2  m1 (raw)", "m2 (raw)", "Pareto front"):
        assert label in text


def test_front_is_drawn_as_steps():
    # The line is horizontal up to the time of the next method, then vertical down to its error.
    svg = trade_off(rows_of([(1, 3), (2, 2)]), "train_s", title="t", cost="c")
    (step,) = re.findall(r'<path d="([^"]+)"[^>]*stroke: #666666', svg.split('id="legend_1"')[0])
    first, corner, last = re.findall(r"[ML] (\S+) (\S+)", step)
    assert first[1] == corner[1]
    assert corner[0] == last[0]


def test_markers_of_methods_with_input_raw_are_filled_differently():
    raw_row, other_row = rows_of([(1, 3), (2, 2)])
    rows = [raw_row | {"method": "ridge"}, other_row | {"method": "ridge", "inputs": "shape"}]
    raw, shape = (point.look for point in trade_off_points(rows, "train_s"))
    assert {key: shape[key] for key in raw} == raw
    assert shape["markerfacecolor"] == "white"


def test_styles_of_49_methods_are_different():
    assert len({(look_of(i)["color"], look_of(i)["marker"]) for i in range(49)}) == 49


def row(accuracy_pct: float, mse_xy_mm2: float = 0.5, **spread) -> dict:
    spread = spread or {"sd": 0.1, "n": 6}
    return {
        "accuracy_pct": {"mean": accuracy_pct, **spread},
        "mse_xy_mm2": {"mean": mse_xy_mm2, **spread},
    }


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
    return cost_pages({"learning": LEARNING, "adaptation": ADAPTATION}, "simulated")


def test_methods_that_were_not_timed_have_no_figure(costs):
    assert set(costs) == {"training.svg", "inference.svg", "learning.md", "adaptation.md"}
    untimed = [{key: value for key, value in one.items() if key != "train_s"} for one in LEARNING]
    assert set(cost_pages({"learning": untimed}, "simulated")) == {"inference.svg", "learning.md"}
    never = [{key: value for key, value in one.items() if key != "seconds"} for one in ADAPTATION]
    assert set(cost_pages({"adaptation": never}, "simulated")) == {"adaptation.md"}
    assert cost_pages({"choice": {}}, "simulated") == {}


def test_method_that_was_not_timed_is_only_in_the_table():
    untimed = {key: value for key, value in LEARNING[2].items() if key != "train_s"}
    pages = cost_pages({"learning": [*LEARNING[:2], untimed, *LEARNING[3:]]}, "simulated")
    assert "kNN" not in texts_of(pages["training.svg"])
    assert "kNN" in texts_of(pages["inference.svg"])
    (line,) = [line for line in pages["learning.md"].splitlines() if "kNN" in line]
    assert [cell.strip() for cell in line.split("|")][3] == "–"


def test_figures_of_costs_have_units_and_name_their_source():
    pages = cost_pages({"learning": LEARNING}, "recorded")
    for name, unit in (("training", " / s"), ("inference", " / µs")):
        text = texts_of(pages[f"{name}.svg"])
        assert unit in text
        assert "MSE_xy / mm²" in text
        assert "recorded" in text


def test_figure_of_training_times_has_one_mark_for_each_method(costs):
    few, all_ = cost_pages({"learning": LEARNING[:3]}, "simulated")["training.svg"], costs["training.svg"]
    ticks = {name: len(re.findall('id="[xy]tick_', text)) for name, text in (("few", few), ("all", all_))}
    # Each method has one mark in the panel and one in the legend. Ticks are marks, too, and are subtracted.
    assert count_marks(all_) - ticks["all"] - (count_marks(few) - ticks["few"]) == 2


def test_equal_results_give_equal_cost_pages(costs):
    assert cost_pages({"learning": LEARNING, "adaptation": ADAPTATION}, "simulated") == costs


def count_marks(svg: str) -> int:
    """Return the number of marks in a figure (SVG), which are <use> elements that refer to a path."""
    return len(re.findall("<use ", svg))


def test_cost_tables_have_dashes_for_methods_that_were_not_timed():
    timed = {"method": "ridge", "inputs": "raw", "train_s": 0.0123, "inference_us": 4.56, **row(30.0)}
    untimed = {name: value for name, value in timed.items() if name not in ("train_s", "inference_us")}
    rows = [{"pokes_n": 390, **row(87.0)}, {"pokes_n": 65, "seconds": 1.5, **row(85.0)}]
    tables = cost_tables({"learning": [timed, untimed], "adaptation": rows}, "simulated")
    assert tables["learning"]["training, s"].tolist() == ["0.0123", "–"]
    assert tables["learning"]["per reading, µs"].tolist() == ["4.56", "–"]
    assert tables["adaptation"]["adaptation, s"].tolist() == ["1.5", "–"]

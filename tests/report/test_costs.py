"""Tests of figures and tables that compare errors with run times."""

import re
from dataclasses import asdict

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from pipeline.experiments.runtime import REFERENCE, Precision, choose
from pipeline.report.costs import (
    cost_pages,
    cost_tables,
    failures,
    front,
    integrators,
    quadratures,
    stage_costs,
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


def row(accuracy_pct: float, mse_xy_mm2: float = 0.5, **spread) -> dict:
    spread = spread or {"sd": 0.1, "n": 6}
    return {
        "accuracy_pct": {"mean": accuracy_pct, **spread},
        "mse_xy_mm2": {"mean": mse_xy_mm2, **spread},
    }


def test_table_of_adaptations_has_dashes_for_those_that_were_not_timed():
    rows = [{"pokes_n": 390, **row(87.0)}, {"pokes_n": 65, "seconds": 1.5, **row(85.0)}]
    pages = cost_pages({"adaptation": rows}, "simulated")
    assert set(pages) == {"adaptation.md"}
    assert cost_tables({"adaptation": rows}, "simulated")["adaptation"]["adaptation, s"].tolist() == ["1.5", "–"]
    assert cost_pages({"choice": {}}, "simulated") == {}


def count_marks(svg: str) -> int:
    """Return the number of marks in a figure (SVG), which are <use> elements that refer to a path."""
    return len(re.findall("<use ", svg))

"""Figures of error against run time: what they must say, and that the same rows give the same bytes."""

import re
import xml.etree.ElementTree as ET
from dataclasses import asdict

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.experiments.runtime import REFERENCE, Precision, Seconds, choose
from pipeline.report.drawing import COLOURS, MARKERS
from pipeline.report.figures import costs, failures, front, integrators, pages, quadratures
from reskin.physics.magnet import DEFAULT_QUADRATURE
from tests.report.synthetic import cost

RULES = [("Gauss in z", "0.5 mm x 6", 10584, 0.004), ("Gauss in z", "0.7 mm x 5", 5120, 0.015)]
RULES += [("Gauss in z", "1 mm x 4", 1936, 0.08), ("midpoint", "0.5 mm x 4", 6400, 0.4)]
SUMS = [
    Precision("dB", REFERENCE, "0.5 mm x 8", 127008, 3e-4),
    *(Precision("dB", method, setting, nodes_n, error) for method, setting, nodes_n, error in RULES),
]
STIFF = [
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


def timed(rows) -> list[Seconds]:
    done = [row for row in rows if row.error is not None and row.method != REFERENCE]
    return [Seconds(*row.key, median_s=1e-4 * (i + 1), repeats_n=5) for i, row in enumerate(done)]


def draw_sums(rows=SUMS, **limits) -> str:
    return quadratures(rows, timed(rows), choose(rows, used=DEFAULT_QUADRATURE, **limits), source="simulated")


def draw_stiff(rows=STIFF) -> str:
    return integrators(rows, timed(rows))


def said(svg) -> str:
    return " ".join("".join(one.itertext()) for one in ET.fromstring(svg).iter() if one.tag.endswith("text"))


def test_the_figure_of_quadratures_says_units_limit_choice_source_and_how_good_its_reference_is():
    words = said(draw_sums())
    for word in ("median time an indentation / ms", "rms error / rms dB", "2 %", "simulated", "Gauss in z", "midpoint"):
        assert word in words
    assert "cheapest below it: 0.7 mm x 5" in words
    assert "in use: 0.5 mm x 6" in words
    assert "reference's own error, at most" in words


def test_where_no_rule_is_good_enough_only_the_one_in_use_is_ringed():
    words = said(draw_sums(error_max=1e-6))
    assert "cheapest" not in words
    assert "in use: 0.5 mm x 6" in words


def test_the_figure_of_integrators_has_a_panel_a_stiffness_and_lists_every_failure():
    words = said(draw_stiff())
    for word in ("stiffness 1e+03", "stiffness 1e+08", "exact update", "Radau", "rms error / rms force"):
        assert word in words
    for line in failures(STIFF):
        for word in line.split():
            assert word in words


def test_failures_are_gathered_by_method_and_kind_and_none_is_dropped():
    diverged, stopped = failures(STIFF)
    assert diverged == (
        "Failed: explicit Euler, diverged: relaxation, stiffness 1e+03 (1e-02 s, 1e-03 s);"
        " relaxation, stiffness 1e+08 (1e-02 s, 1e-03 s)"
    )
    assert stopped.startswith("Failed: explicit Euler, stopped after 20000 right-hand sides: ")
    assert failures(SUMS) == []


def test_what_failed_is_no_point_of_the_figure():
    # Each point is one use of a marker; without the failed rows there are as many.
    alone = [row for row in STIFF if row.failure is None]
    points = [len(re.findall("<use ", integrators(rows, timed(rows)))) for rows in (STIFF, alone)]
    assert points[0] == points[1]


def test_a_row_that_was_not_timed_is_an_error_and_not_left_out():
    with pytest.raises(KeyError):
        quadratures(SUMS, timed(SUMS)[1:], choose(SUMS, used=DEFAULT_QUADRATURE), source="simulated")


def test_pages_cope_with_a_scene_that_asked_for_one_study_or_none():
    stages = {"stages": {"simulate": cost()}}
    assert set(pages(stages, source="simulated")) == {"stages.md"}
    times = {one.key: one for one in timed(STIFF)}
    rows = [asdict(row) | (asdict(times[row.key]) if row.key in times else {}) for row in STIFF]
    assert set(pages(stages | {"integrators": rows}, source="simulated")) == {
        "integrators.svg", "integrators.md", "stages.md",
    }  # fmt: skip


def test_what_a_stage_cost_stands_beside_its_last_run_and_what_that_reused():
    (row,) = costs({"train_multi": cost(seconds=0.25)}).to_dict("records")
    assert row == {
        "stage": "train_multi", "computed, s": "3.0", "last run, s": "0.2", "CPU of it, s": "–",
        "trainings": "2", "of them reused": "1", "peak memory of a process, MB": "2",
    }  # fmt: skip


def test_same_rows_same_bytes_other_seconds_other_bytes():
    assert draw_sums() == draw_sums()
    stiff = draw_stiff()
    assert draw_stiff() == stiff
    slower = [Seconds(*one.key, median_s=one.median_s**2, repeats_n=5) for one in timed(STIFF)]
    assert integrators(STIFF, slower) != stiff


@given(st.lists(st.tuples(st.floats(1e-6, 1), st.floats(1e-16, 1)), max_size=12))
def test_on_the_front_who_takes_longer_is_more_exact_and_beats_all_that_are_left_out(points):
    kept = front(points)
    assert set(kept) <= set(points)
    times, errors = np.array(kept).reshape(-1, 2).T
    assert (np.diff(times) > 0).all()
    assert (np.diff(errors) < 0).all()
    for time, error in points:
        assert any(t <= time and e <= error for t, e in kept)


def test_seven_methods_differ_in_colour_and_in_marker():
    assert len(set(COLOURS)) == len(set(MARKERS)) == 7

"""Tests of the titles of marks in figures (SVG). Browsers show a title as a tooltip with the values of its mark."""

import re
import xml.etree.ElementTree as ET
from html import unescape

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.plot import MARKS_MAX_N, drawing, svg

SVG = "{http://www.w3.org/2000/svg}"


def titles(text: str) -> list[list[str]]:
    """Return the lines of each title in a figure (SVG), in the order of the file."""
    return [unescape(title).split("\n") for title in re.findall(r"<title>(.*?)</title>", text, re.DOTALL)]


def draw(plot, **labels) -> str:
    with drawing(4.0, 3.0) as figure:
        axes = figure.subplots()
        plot(axes)
        axes.set(**labels)
        return svg(figure)


def test_title_of_a_mark_has_its_label_and_values():
    text = draw(lambda axes: axes.plot([1, 2], [30, 45.5], "o-", label="ours"), xlabel="pokes", ylabel="accuracy / %")
    assert titles(text) == [
        ["ours", "pokes = 1", "accuracy / % = 30"],
        ["ours", "pokes = 2", "accuracy / % = 45.5"],
    ]


@settings(max_examples=20, deadline=None)
@given(st.lists(st.tuples(st.floats(-50, 50), st.floats(-50, 50)), min_size=1, max_size=12))
def test_values_in_titles_increase_with_the_position_of_marks(points):
    x, y = np.array(points).round(1).T
    text = draw(lambda axes: axes.plot(x, y, "s"), xlabel="x", ylabel="y")
    marks = [use for use in ET.fromstring(text).iter(f"{SVG}use") if use.find(f"{SVG}title") is not None]
    shown = [float(mark.find(f"{SVG}title").text.split("\n")[0].removeprefix("x = ")) for mark in marks]
    x_positions = [float(mark.get("x")) for mark in marks]
    assert shown == pytest.approx(x)
    # Tolerance: positions in the SVG are written with two decimals.
    assert np.all(np.diff(np.array(x_positions)[np.argsort(shown, kind="stable")]) >= -0.02)


def test_title_of_a_bar_has_both_ends():
    text = draw(lambda axes: axes.errorbar([1, 2], [5, 6], [[1, 0], [2, 0]], fmt="o", label="ours"))
    assert [lines[-1] for lines in titles(text)] == ["bar from 4 to 7", "y = 6"]  # The second bar has the length 0.
    text = draw(lambda axes: axes.errorbar([5, 6], [1, 2], xerr=[1, 2], fmt="o", capsize=3))
    assert [lines[-1] for lines in titles(text)] == ["bar from 4 to 6", "bar from 4 to 8"]


def test_points_of_an_errorbar_plot_without_bars_have_titles():
    assert len(titles(draw(lambda axes: axes.errorbar([1, 2], [5, 6], None, fmt="o")))) == 2


def test_titles_of_marks_use_the_texts_of_ticks_if_ticks_have_texts():
    def plot(axes):
        axes.plot([3.1, 3.2], [0.9, 2.1], "o")
        axes.set_yticks([1, 2], ["one\nskin", "two skins"])
        axes.set_xticks([0, 100], ["0", "100"])

    assert titles(draw(plot, xlabel="n")) == [["n = 3.1", "one skin"], ["n = 3.2", "two skins"]]


def test_titles_on_a_shared_axis_use_its_label():
    with drawing(4.0, 3.0) as figure:
        left, right = figure.subplots(1, 2, sharey=True)
        left.set(ylabel="accuracy / %")
        right.plot([1], [2], "o")
        assert titles(svg(figure)) == [["x = 1", "accuracy / % = 2"]]


def test_titles_contain_values_that_are_shown_by_colour():
    def plot(axes):
        points = axes.scatter([1, 2], [3, 4], c=[0.25, 0.5])
        axes.figure.colorbar(points, label="error / mm")

    assert titles(draw(plot)) == [["x = 1", "y = 3", "error / mm = 0.25"], ["x = 2", "y = 4", "error / mm = 0.5"]]


def test_title_of_a_line_without_marks_is_its_label():
    text = draw(lambda axes: (axes.plot([1, 2], [3, 4], label="a & b"), axes.axhline(3)))
    assert titles(text) == [["a & b"]]
    ET.fromstring(text)


@pytest.mark.parametrize(
    "values",
    [np.arange(MARKS_MAX_N + 1.0), np.array([1.0, np.nan, 3.0])],
    ids=["too many marks", "one mark not drawn"],
)
def test_marks_have_no_titles_if_there_are_too_many_or_one_is_not_drawn(values):
    assert titles(draw(lambda axes: axes.plot(values, values, "o"))) == []
    assert titles(draw(lambda axes: axes.scatter(values, values))) == []


def test_invisible_marks_have_no_titles():
    assert titles(draw(lambda axes: axes.plot([1], [2], "o", visible=False))) == []

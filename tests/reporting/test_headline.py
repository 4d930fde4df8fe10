"""The first figure and table of a scene: every row with its numbers, beside the paper's where it says something."""

import json
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

from pipeline.reporting.headline import FILE, headline_figures, short_table
from pipeline.reporting.order import CONTROL, models
from pipeline.reporting.paper import TABLE_2
from tests.reporting.synthetic import all_questions

REPORTS = Path(__file__).resolve().parents[2] / "reports"


def words_of(svg: str) -> str:
    return " ".join(" ".join(ET.fromstring(svg).itertext()).split())


def test_each_row_of_table_2_is_drawn_and_named_with_source_and_boards():
    numbers = all_questions()
    said = words_of(headline_figures(numbers, "simulated")[FILE])
    for name in numbers["table2"]:
        assert models(numbers)[name].title.split(",")[0] in said
    for word in ("simulated", "paper", "accuracy", "MSE_xy", "boards held out"):
        assert word in said


def test_the_short_table_holds_ours_and_the_papers_means_and_the_control():
    numbers = all_questions()
    table = short_table(numbers).set_index("boards never seen")
    assert len(table) == len(numbers["table2"]) + 1
    for name, model in models(numbers).items():
        if name in numbers["table2"]:
            assert float(table.loc[model.title, "accuracy, % (paper)"]) == pytest.approx(
                TABLE_2[name]["accuracy_pct"][0], rel=0.005
            )
    assert table.loc[CONTROL, "accuracy, % (paper)"] == "–"


def test_same_numbers_same_bytes_and_no_question_about_boards_no_figure():
    numbers = all_questions()
    assert headline_figures(numbers, "simulated") == headline_figures(numbers, "simulated")
    assert headline_figures({name: numbers[name] for name in ("provenance",)}, "recorded") == {}


@pytest.mark.parametrize("scene", ["lab"])
def test_labels_of_a_new_board_are_drawn_for_each_method(scene):
    numbers = json.loads((REPORTS / scene / "numbers.json").read_text())
    said = words_of(headline_figures(numbers, "recorded")[FILE])
    assert all(f"{row['method']} ({row['inputs']})" in said for row in numbers["labels"])
    assert "recorded" in said
    assert "as labelled" in said

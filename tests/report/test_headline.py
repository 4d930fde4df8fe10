"""The first figure and table of a scene: every row with its numbers, beside the paper's where it says something."""

import json
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

from pipeline.report.formatting import CONTROL, models, show
from pipeline.report.headline import ANSWERING, FILE, answer, headline_figures, short_table
from pipeline.report.paper import TABLE_2
from pipeline.training.universal import METHODS, WAYS
from tests.report.synthetic import all_experiments, over_boards

REPORTS = Path(__file__).resolve().parents[2] / "reports"


def words_of(svg: str) -> str:
    return " ".join(" ".join(ET.fromstring(svg).itertext()).split())


def test_each_row_of_table_2_is_drawn_and_named_with_source_and_boards():
    numbers = all_experiments()
    said = words_of(headline_figures(numbers, "simulated")[FILE])
    for name in numbers["table2"]:
        assert models(numbers)[name].title.split(",")[0] in said
    for word in ("simulated", "paper", "accuracy", "MSE_xy", "boards held out"):
        assert word in said


def test_the_short_table_holds_ours_and_the_papers_means_and_the_control():
    numbers = all_experiments()
    table = short_table(numbers).set_index("boards never seen")
    assert len(table) == len(numbers["table2"]) + 1
    for name, model in models(numbers).items():
        if name in numbers["table2"]:
            title = model.title.replace("Multi-sensor with triplet loss, adapted", "The same, adapted")
            for metric, column in (("accuracy_pct", "accuracy, %"), ("mse_f_N2", "MSE_F, N²")):
                assert table.loc[title, f"{column} (paper)"].endswith(f"({TABLE_2[name][metric][0]:.3g})")
    assert "(" not in table.loc[CONTROL, "accuracy, % (paper)"]
    assert "R² of F" in table


def test_the_answer_says_ours_with_its_interval_and_the_papers():
    numbers = all_experiments()
    numbers["table2"]["multi"] |= {"accuracy_pct": over_boards(70.0, 90.0)}
    said = answer(numbers)
    assert "multi-sensor 80 [70, 90] % (paper: 84.4 %)" in said
    for name in ANSWERING:
        assert show(numbers["table2"][name]["accuracy_pct"]) in said
        assert f"(paper: {TABLE_2[name]['accuracy_pct'][0]:.3g} %)" in said


def test_experts_that_were_asked_lead_and_stand_first_in_figure_and_table():
    numbers = all_experiments()
    told = [
        {"way": way, "pokes_n": pokes_n, "labels_n": labels_n, "accuracy_pct": over_boards(*accuracy), "n": 2}
        | {metric: numbers["table2"]["multi"][metric] for metric in ("mse_xy_mm2", "mse_f_N2")}
        for way, pokes_n, labels_n, accuracy in (
            ("universal", 16, 0, (70.0, 72.0)), ("universal", 65, 0, (90.0, 92.0)), ("universal", 65, 5, (95.0, 97.0)),
            ("map", 65, 0, (50.0, 52.0)),
        )
    ]  # fmt: skip
    numbers |= {"population": {"told": told}}
    assert "never seen: universal, told 65 unlabelled pokes 91 [90, 92] %; multi-sensor" in answer(numbers)
    first = short_table(numbers).iloc[0]
    assert "65 unlabelled pokes" in first["boards never seen"]
    assert "91" in first["accuracy, % (paper)"]
    assert "65 unlabelled" in words_of(headline_figures(numbers, "simulated")[FILE])


def test_the_answer_with_labels_is_of_the_model_that_is_told_its_skin_and_of_the_usual_one():
    numbers = json.loads((REPORTS / "lab" / "numbers.json").read_text())
    said, usual = answer(numbers), numbers["labels"][0]["method"]
    assert "with 0 and 40 labels of the new board" in said
    for method in (*(f"{METHODS[1]}{way}" for way in WAYS.values()), usual):
        rows = [row for row in numbers["labels"] if (row["method"], row["labels_n"] in (0, 40)) == (method, True)]
        least, most = (
            show(choose(rows, key=lambda row: row["labels_n"])["as_labelled"]["accuracy_pct"]) for choose in (min, max)
        )
        assert f"{method} {least} and {most} %" in said
    plain = {"labels": [row for row in numbers["labels"] if row["method"] == usual]}
    assert answer(plain).count(" and ") == 2
    assert "universal" not in answer(plain)


def test_without_boards_held_out_there_is_no_answer():
    assert answer({name: value for name, value in all_experiments().items() if name != "table2"}) == ""


def test_same_numbers_same_bytes_and_no_experiment_about_boards_no_figure():
    numbers = all_experiments()
    assert headline_figures(numbers, "simulated") == headline_figures(numbers, "simulated")
    assert headline_figures({name: numbers[name] for name in ("provenance",)}, "recorded") == {}


@pytest.mark.parametrize("scene", ["lab"])
def test_labels_of_a_new_board_are_drawn_for_each_method(scene):
    numbers = json.loads((REPORTS / scene / "numbers.json").read_text())
    said = words_of(headline_figures(numbers, "recorded")[FILE])
    assert all(f"{row['method']} ({row['inputs']})" in said for row in numbers["labels"])
    assert "recorded" in said
    assert "as labelled" in said

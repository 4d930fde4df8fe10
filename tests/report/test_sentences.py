"""Tests of the sentences below figures, which state their results."""

import json
from copy import deepcopy

import pytest

from pipeline.report.figures import FORCE, HEADLINE
from pipeline.report.sentences import sentences
from tests.report.synthetic import all_experiments
from tests.stages.checkout import ROOT

SCENES = sorted(file.parent.name for file in (ROOT / "reports").glob("*/numbers.json"))
MADE_FROM_RESULTS = (
    "headline.svg",
    "sweep_pokes.svg",
    "sweep_sensors.svg",
    "shear.svg",
)


def numbers_of(scene: str) -> dict:
    return json.loads((ROOT / f"reports/{scene}/numbers.json").read_text())


@pytest.mark.parametrize("scene", SCENES)
def test_each_committed_figure_has_one_or_two_sentences(scene):
    written = sentences(numbers_of(scene))
    drawn = [*(ROOT / "reports" / scene).glob("figures/*.svg")]
    assert [file.name for file in drawn if file.name not in written] == []
    for sentence in written.values():
        assert sentence.endswith(".")
        assert sentence.count(". ") <= 1
        assert "nan" not in sentence.split()


@pytest.mark.parametrize("figure", MADE_FROM_RESULTS)
def test_sentences_state_the_results_of_the_run(figure):
    numbers = numbers_of("paper")
    changed = deepcopy(numbers)
    changed["table2"]["multi"]["accuracy_pct"]["mean"] = 12.0
    changed["sweep_pokes"][0]["accuracy_pct"]["mean"] = 12.0
    fewest = {row["method"]: row["accuracy_pct"] for row in reversed(changed["sweep_sensors"])}
    fewest["adapted"]["mean"] = fewest["triplet"]["mean"] + 12.0
    changed["shear"]["by_line"]["explained_fz"]["mean"] = 0.12
    before, after = sentences(numbers)[figure], sentences(changed)[figure]
    assert before != after
    assert "12" in after


def test_sentence_about_shear_is_about_held_out_lines():
    numbers = numbers_of("paper")
    # This is the result with random readings held out, which the sentence must not state.
    numbers["shear"]["explained_fz"]["mean"] = 0.5
    numbers["shear"]["by_line"]["explained_fz"]["mean"] = 0.25
    assert "25.00\u00a0% of the variance of the normal forces" in sentences(numbers)["shear.svg"]


def test_sentence_about_pokes_states_that_bars_are_not_intervals_of_the_difference():
    numbers = numbers_of("quick")
    (pair,) = [pair for pair in numbers["paired"] if (pair["of"], pair["over"]) == ("adapted", "triplet")]
    pair["accuracy_pct"] |= {"mean": 2.1, "ci95": [0.01, 4.17]}
    sentence = sentences(numbers)["sweep_pokes.svg"]
    assert sentence.endswith("two scores: this difference is +2.1 points [0.01, 4.17] from 0 to 390 pokes.")
    del numbers["paired"]
    assert sentences(numbers)["sweep_pokes.svg"].endswith("not of the difference between two scores.")


def test_sentence_is_about_unseen_boards_instead_of_table_2_if_they_were_tested():
    numbers = numbers_of("lab")
    for row in numbers["random_presses"]["rows"]:
        row["mse_f_N2"] = {"mean": 4.0, "n": 2, "values": [4.0, 16.0]}
    written = sentences(numbers)
    assert "with 0 labels" in written[HEADLINE]
    assert "3.0\u00a0N with 40" in written[FORCE]


def test_sentences_can_be_written_if_results_lack_optional_parts():
    assert set(sentences({})) <= set(sentences(all_experiments()))

"""The few scores that DVC shows: what they are, and that nothing which differs between identical runs is among them."""

import json
from collections.abc import Iterator
from typing import Any

import pytest

from pipeline.report.numbers import headline_scores
from pipeline.scenes import ANALYSES
from reskin.io import read_json
from tests.report.synthetic import all_experiments, scores, stat
from tests.stages.checkout import ROOT


def leaves(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    if isinstance(value, dict):
        for key, own in value.items():
            yield from leaves(own, f"{name}.{key}" if name else key)
    elif isinstance(value, list):
        for own in value:
            yield from leaves(own, name)
    else:
        yield name, value


def test_the_rows_of_table_2_and_the_control_are_shown_by_their_means():
    numbers = {"provenance": {"source": "simulated"}, "table2": {"multi": scores()}, "adapt": {"control": scores()}}
    numbers["table2"]["multi"]["accuracy_pct"] = stat(82.2)
    assert headline_scores(numbers) == {
        "table2": {
            "multi": {"accuracy_pct": 82.2, "mse_xy_mm2": 1.0, "mse_f_N2": 1.0, "r2_f": 1.0},
            "control": {"accuracy_pct": 1.0, "mse_xy_mm2": 1.0, "mse_f_N2": 1.0, "r2_f": 1.0},
        }
    }


def test_drift_is_shown_at_its_end_for_each_policy():
    windows = [{"contacts_n": n, "accuracy_pct": 100.0 - n, "mse_xy_mm2": 1.0} for n in (10, 20)]
    numbers = {"provenance": {"source": "recorded"}, "drift": {"each": windows, "findings": [{"finding": "x"}]}}
    assert headline_scores(numbers) == {"drift_end": {"each": {"accuracy_pct": 80.0}}}  # no force there: no force shown


def test_recorded_boards_are_shown_registered_too_and_with_the_best_method_for_no_and_most_labels():
    def row(method: str, labels_n: int, accuracy_pct: float) -> dict:
        words = {"method": method, "inputs": "raw", "labels_n": labels_n, "registered": scores()}
        return words | {"as_labelled": {"accuracy_pct": stat(accuracy_pct)}}

    rows = [row("a", 0, 20.0), row("b", 0, 30.0), row("a", 10, 99.0), row("a", 40, 50.0), row("b", 40, 40.0)]
    numbers = {"provenance": {"source": "recorded"}, "lobo": {"registered": scores()}, "labels": rows}
    assert headline_scores(numbers) == {
        "lobo": {"registered": {"accuracy_pct": 1.0, "mse_xy_mm2": 1.0, "mse_f_N2": 1.0, "r2_f": 1.0}},
        "labels": {
            "best_of_0_labels": {"method": "b (raw)", "accuracy_pct": 30.0},
            "best_of_40_labels": {"method": "a (raw)", "accuracy_pct": 50.0},
        },
    }


def test_costs_machine_and_commit_change_no_score():
    numbers = all_experiments()
    before = headline_scores(numbers)
    numbers["provenance"] |= {"git": "other", "trained": "other", "device": "other", "seconds": 9.0}
    numbers["runtime"] = {}
    assert headline_scores(numbers) == before
    assert not any(word in json.dumps(before) for word in ("seconds", '_s"', "git", "device"))


def test_a_scene_that_asks_nothing_of_this_has_no_score():
    assert headline_scores({"provenance": {"source": "simulated"}}) == {}


@pytest.mark.parametrize("without", ANALYSES)
def test_an_experiment_that_was_not_asked_is_absent(without):
    numbers = all_experiments()
    numbers.pop(without, None)  # compare is asked of recordings only
    assert not any(name.startswith(without) for name in headline_scores(numbers))


@pytest.mark.parametrize("file", sorted(ROOT.glob("reports/*/numbers.json")), ids=lambda file: file.parent.name)
def test_every_score_is_a_number_of_numbers_json_with_a_unit_and_there_are_few(file):
    numbers = read_json(file)
    known = {value for _, value in leaves(numbers) if isinstance(value, float)}
    shown = dict(leaves(headline_scores(numbers)))
    assert 0 < len(shown) < 50
    for name, value in shown.items():
        if not name.endswith(".method"):
            assert value in known
            assert name.endswith(("_pct", "_mm2", "_N2", ".r2_f"))  # R² has no unit

"""Tests of the files with the results of a scene: numbers.json, which is equal for equal runs, provenance.json, and the
scores that `dvc metrics` shows.
"""

import copy
import json

import pytest

from pipeline.catalogue import ANALYSES
from pipeline.manage.verify import flatten
from pipeline.report.numbers import headline_scores, join, split, timed_rows
from reskin.io import read_json
from tests.report.synthetic import all_experiments, cost, scores, stat
from tests.stages.checkout import ROOT

ROW = {"study": "field", "method": "Gauss in z", "setting": "1 mm x 5", "error": 0.1, "unit": "1"}


def run(seconds: float) -> dict:
    """Return the numbers of a run with run times; one method was not timed."""
    numbers = all_experiments() | {"accuracy_and_cost": {"rows": [ROW, ROW | {"method": "reference"}]}}
    numbers["provenance"] |= {"git": f"code {seconds}", "device": f"machine {seconds}", "seconds": seconds}
    timed = {name: ROW[name] for name in ("study", "method", "setting")} | {"seconds": seconds}
    numbers["runtime"] = {"stages": {"report": cost(seconds)}, "accuracy_and_cost": [timed]}
    return numbers


def test_equal_runs_differ_only_in_their_provenance():
    (numbers, provenance), (other_numbers, other) = split(run(1.0)), split(run(2.0))
    assert numbers == other_numbers
    assert provenance != other


def test_numbers_do_not_contain_the_commit_the_machine_or_run_times():
    numbers = split(run(1.0))[0]
    assert set(numbers["provenance"]) == {"scene", "source", "seed"}
    assert "runtime" not in numbers
    assert numbers["accuracy_and_cost"]["rows"][0] == ROW


def test_rows_are_joined_with_their_run_times():
    assert timed_rows(run(2.0)) == [ROW | {"seconds": 2.0}, ROW | {"method": "reference"}]
    assert timed_rows(all_experiments()) == []


def test_results_that_are_split_and_joined_are_unchanged():
    numbers = run(1.0)
    before = copy.deepcopy(numbers)
    assert join(*split(numbers)) == before
    assert numbers == before


@pytest.mark.parametrize("folder", sorted(file.parent for file in ROOT.glob("reports/*/numbers.json")), ids=str)
def test_committed_numbers_contain_no_provenance(folder):
    numbers, provenance = (read_json(folder / name) for name in ("numbers.json", "provenance.json"))
    assert split(join(numbers, provenance)) == (numbers, provenance)
    assert {"git", "trained", "device", "seconds", "runtime"} <= set(provenance)


def test_scores_are_the_means_of_table_2():
    numbers = {"provenance": {"source": "simulated"}, "table2": {"multi": scores()}}
    numbers["table2"]["multi"]["accuracy_pct"] = stat(82.2)
    assert headline_scores(numbers)["table2"]["multi"]["accuracy_pct"] == 82.2


def test_scores_do_not_depend_on_run_times_and_provenance():
    numbers = all_experiments()
    before = headline_scores(numbers)
    numbers["provenance"] |= {"git": "other", "trained": "other", "device": "other", "seconds": 9.0}
    numbers["runtime"] = {}
    assert headline_scores(numbers) == before
    assert not any(word in json.dumps(before) for word in ("seconds", '_s"', "git", "device"))


def test_scene_without_results_has_no_scores():
    assert headline_scores({"provenance": {"source": "simulated"}}) == {}


@pytest.mark.parametrize("without", ANALYSES)
def test_missing_experiment_has_no_scores(without):
    numbers = all_experiments()
    numbers.pop(without, None)  # Experiment compare is only in recorded scenes.
    assert not any(name.startswith(without) for name in headline_scores(numbers))


@pytest.mark.parametrize("file", sorted(ROOT.glob("reports/*/numbers.json")), ids=lambda file: file.parent.name)
def test_scores_of_committed_reports_have_units_in_their_names(file):
    numbers = read_json(file)
    known = set(flatten(numbers).values())
    shown = flatten(headline_scores(numbers))
    assert len(shown) < 50
    for name, value in shown.items():
        if not name.endswith(".method"):
            assert value in known
            assert name.endswith(("_pct", "_mm2", "_N2", ".r2_f"))  # Only R² has no unit.

"""Tests of the files with the results of a scene: numbers.json, which is equal for equal runs, provenance.json, and the
scores that `dvc metrics` shows.
"""

import copy

from pipeline.report.numbers import headline_scores, join, split, timed_rows
from tests.report.synthetic import all_experiments, cost, scores, stat

ROW = {"study": "field", "method": "Gauss in z", "setting": "1 mm x 5", "error": 0.1, "unit": "1"}


def run(seconds: float) -> dict:
    """Return the numbers of a run with run times; one method was not timed."""
    numbers = all_experiments() | {"accuracy_and_cost": {"rows": [ROW, ROW | {"method": "reference"}]}}
    numbers["provenance"] |= {"git": f"code {seconds}", "device": f"machine {seconds}"}
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


def test_scores_are_the_means_of_table_2():
    numbers = {"provenance": {"source": "simulated"}, "table2": {"multi": scores()}}
    numbers["table2"]["multi"]["accuracy_pct"] = stat(82.2)
    assert headline_scores(numbers)["table2"]["multi"]["accuracy_pct"] == 82.2

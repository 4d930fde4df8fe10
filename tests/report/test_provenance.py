"""numbers.json is equal between equal runs; what belongs to one run (commit, machine, times) is in provenance.json."""

import copy

import pytest

from pipeline.manage.compare import leaves
from pipeline.report.numbers import TIMES, join, learning_times, split
from reskin.io import read_json
from tests.report.synthetic import all_experiments, cost, scores
from tests.stages.checkout import ROOT

SWEPT = [{"pokes_n": pokes_n, **scores()} for pokes_n in (0, 390)]
METHODS = [{"method": name, "inputs": "raw", "name": name, **scores()} for name in ("ridge", "knn")]
STUDY = {"study": "field", "method": "Gauss in z", "setting": "1 mm x 5", "work_n": 9, "error": 0.1, "failure": None}


def run(seconds: float) -> dict:
    """Numbers of a run with every kind of time; one method has none."""
    took = {
        "sweep_pokes": [{"name": f"pokes.paper.b0.{n}pokes.seed0", "train_s": seconds} for n in (0, 390)],
        "train_classical": [{"name": "ridge.b0", "train_s": seconds, "one_reading_s": seconds / 1e3}],
    }
    numbers = all_experiments() | {"sweep_pokes": SWEPT, "baselines": METHODS}
    numbers["provenance"] |= {"git": f"code {seconds}", "device": f"machine {seconds}", "seconds": seconds}
    numbers["runtime"] = {
        "trainings_n": 1, "stages": {"report": cost(seconds)}, "choice": {"setting": "1 mm x 5"},
        "quadratures": [STUDY | {"median_s": seconds, "repeats_n": 3}, STUDY | {"method": "reference"}],
        **learning_times(numbers, took),
    }  # fmt: skip
    return numbers


def test_two_runs_differ_in_their_provenance_alone():
    (numbers, provenance), (other_numbers, other) = split(run(1.0)), split(run(2.0))
    assert numbers == other_numbers
    assert provenance != other
    assert all(row.keys() & set(TIMES) for row in provenance["runtime"]["adaptation"])


def test_numbers_hold_neither_commit_nor_machine_nor_times():
    numbers = split(run(1.0))[0]
    assert set(numbers["provenance"]) == {"scene", "source", "seed"}
    assert "stages" not in numbers["runtime"]
    assert [name for name, _ in leaves(numbers["runtime"]) if name.rsplit(".", 1)[-1] in TIMES] == []
    assert numbers["runtime"]["quadratures"][0] == STUDY


def test_split_numbers_can_be_joined_again():
    numbers = run(1.0)
    before = copy.deepcopy(numbers)
    assert join(*split(numbers)) == before
    assert numbers == before


@pytest.mark.parametrize("folder", sorted(file.parent for file in ROOT.glob("reports/*/numbers.json")), ids=str)
def test_committed_reports_are_split(folder):
    numbers, provenance = (read_json(folder / name) for name in ("numbers.json", "provenance.json"))
    assert split(join(numbers, provenance)) == (numbers, provenance)
    assert {"git", "trained", "device", "seconds", "runtime"} <= set(provenance)

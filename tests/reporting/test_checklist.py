from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from ruamel.yaml import YAML

from pipeline.errors import SchemaError
from pipeline.questions import EXPERIMENTS
from pipeline.reporting import paper
from pipeline.reporting.checklist import Row, checklist, constant, judge, read_rows, resolve
from tests.reporting.synthetic import all_questions, stat

ROOT = Path(__file__).resolve().parents[2]
STAGES = set(YAML(typ="safe").load((ROOT / "dvc.yaml").read_text())["stages"]) | set(EXPERIMENTS)
ROWS = read_rows()


def leaves(name: str, value: Any) -> list[str]:
    if isinstance(value, dict):
        return [leaf for key, own in value.items() for leaf in leaves(f"{name}.{key}", own)]
    numbers = value if isinstance(value, tuple) else (value,)
    return [name] if all(isinstance(one, int | float) for one in numbers) else []


def row(**words: Any) -> Row:
    return Row(**{"id": "a", "where": "section 9", "what": "b", "paper": "SINGLE_SENSOR.accuracy_pct"} | words)


def sentence(found: Any, printed: Any, pooled: bool = True, **words: Any) -> str:
    return judge(row(**{"ours": "a.accuracy_pct"} | words), printed, found, pooled=pooled).sentence


@pytest.mark.parametrize("one", ROWS, ids=lambda one: one.id)
def test_every_row_finds_its_number_in_a_scene_that_asks_everything(one):
    assert one.ours is None or resolve(all_questions(), one.ours) is not None
    assert one.stage is None or one.stage in STAGES
    assert (one.paper is None) != (one.says is None)


def test_every_number_of_the_paper_is_used_by_a_row():
    named = {name: value for name, value in vars(paper).items() if name.isupper()}
    printed = {leaf for name, value in named.items() for leaf in leaves(name, value)}
    assert printed - {one.paper for one in ROWS} == set()
    assert len(printed) > 30  # the walk above finds them


def test_every_figure_and_table_of_the_paper_has_a_row():
    there = {one.where for one in ROWS}
    figures = [f"figure 1{letter}" for letter in "ABCDEF"] + ["figure 2", "figure 3"]
    figures += [f"figure {i}{letter}" for i in (4, 5, 6) for letter in "ab"]
    assert {*figures, "table 1", "table 2"} <= there
    assert len({one.id for one in ROWS}) == len(ROWS)


def test_a_question_that_was_not_asked_says_so():
    numbers = all_questions()
    del numbers["shear"]
    table = checklist(numbers).set_index("result")
    assert table.loc["dragged lines: MSE of the place", "difference"] == "not asked in this scene"
    assert table.loc["dragged lines: MSE of the place", "shown in"] == "–"
    assert table.loc["dragged lines: MSE of the place", "paper"] == "0.085 ± 0.006 mm²"
    assert set(table["source"]) == {"simulated"}


def test_better_and_worse_follow_the_metric():
    assert sentence(stat(90.0), (85.0, 10.0)) == "ours is 5 points higher (better); within one sd of the paper's"
    assert sentence(stat(70.0), (85.0, 10.0)) == "ours is 15 points lower (worse); outside one sd of the paper's"
    mse = {"ours": "a.mse_f_N2"}
    assert sentence(stat(0.5), (1.0, 0.1), **mse) == "ours is 50 % lower (better); outside one sd of the paper's"
    assert (
        sentence(stat(3.0), (1.0, 0.1), **mse) == "ours is 3 times the paper's (worse); outside one sd of the paper's"
    )
    assert sentence(105.0, 100.0, ours="a.rate_hz") == "ours is 5 % higher; within 10 % of the paper's"


@given(
    mean=st.floats(1, 100), sd=st.floats(0.1, 50), ours=st.floats(0, 200), path=st.sampled_from(["accuracy_pct", "mse"])
)
def test_a_result_differs_exactly_outside_the_papers_sd(mean, sd, ours, path):
    verdict = judge(row(ours=f"a.{path}"), (mean, sd), stat(ours), pooled=True)
    assert verdict.differs == (abs(ours - mean) > sd)
    alone = judge(row(ours=f"a.{path}"), mean, stat(ours), pooled=True)
    assert alone.differs == (abs(ours - mean) > 0.1 * mean)


def test_limits_findings_and_words_are_judged_by_what_they_say():
    assert sentence(0.05, 0.2, rule="at_most") == "holds: ours is at most 0.2"
    assert sentence(0.3, 0.2, rule="at_most") == "does not hold: ours is not at most 0.2"
    assert sentence(80.0, 90.0, rule="at_least") == "does not hold: ours is not at least 90"
    assert sentence(-0.1, None, rule="positive") == "does not hold: ours is not above 0"
    assert sentence(False, None) == "does not hold"
    found = [{"finding": "f", "holds": False, "why": "w"}, {"finding": "g", "holds": True, "why": ""}]
    assert sentence(found, None) == "1 of 2 hold; not here: f (w)"


def test_one_training_skin_is_not_compared_with_pooled_networks():
    own = {"ours": "table2.multi.accuracy_pct"}
    assert "not the same question" in sentence(stat(90.0), (85.0, 1.0), pooled=False, **own)
    assert "points" in sentence(stat(90.0), (85.0, 1.0), pooled=True, **own)


def test_a_reason_is_given_only_where_ours_differs():
    numbers = all_questions()
    mine = [row(ours="single_random.accuracy_pct", why="Because.")]
    assert checklist(numbers, mine)["difference"][0].endswith("Because.")
    numbers["single_random"]["accuracy_pct"] = stat(99.5)
    assert "Because" not in checklist(numbers, mine)["difference"][0]


def test_a_misspelt_constant_is_one_sentence():
    with pytest.raises(SchemaError, match="paper must be a constant of reporting.paper; got SHEARS.x"):
        constant("SHEARS.x")


def test_a_row_of_a_list_is_picked_by_its_value():
    assert resolve(all_questions(), "sweep_pokes.pokes_n=390.accuracy_pct") == stat()
    assert resolve(all_questions(), "sweep_pokes.pokes_n=391.accuracy_pct") is None

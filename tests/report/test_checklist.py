from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from ruamel.yaml import YAML
from scipy.stats import t

from pipeline.report import paper
from pipeline.report.checklist import checklist, claims_table, look_up, read_rows, resolve
from pipeline.report.judging import Row, judge, p_of
from pipeline.scenes import ANALYSES
from pipeline.statistics import FEW_BOARDS, INCONCLUSIVE, NO, YES
from reskin.errors import SchemaError
from tests.report.synthetic import all_experiments, over_boards, stat

ROOT = Path(__file__).resolve().parents[2]
STAGES = set(YAML(typ="safe").load((ROOT / "dvc.yaml").read_text())["stages"]) | set(ANALYSES)
ROWS = read_rows()


def leaves(name: str, value: Any) -> list[str]:
    if isinstance(value, dict):
        return [leaf for key, own in value.items() for leaf in leaves(f"{name}.{key}", own)]
    numbers = value if isinstance(value, tuple) else (value,)
    return [name] if all(isinstance(one, int | float) for one in numbers) else []


def row(**words: Any) -> Row:
    return Row(**{"id": "a", "where": "section 9", "what": "b", "paper": "SINGLE_SENSOR.accuracy_pct"} | words)


def sentence(found: Any, printed: Any, pooled: bool = True, simulated: bool = True, **words: Any) -> str:
    mine = row(**{"ours": "a.accuracy_pct"} | words)
    return judge(mine, printed, found, pooled=pooled, simulated=simulated).sentence


@pytest.mark.parametrize("one", ROWS, ids=lambda one: one.id)
def test_every_row_finds_its_number_in_a_scene_that_asks_everything(one):
    assert one.ours is None or resolve(all_experiments(), one.ours) is not None
    assert one.stage is None or one.stage in STAGES
    assert (one.paper is None) != (one.says is None)


def test_every_number_of_the_paper_is_used_by_a_row():
    named = {name: value for name, value in vars(paper).items() if name.isupper()}
    printed = {leaf for name, value in named.items() for leaf in leaves(name, value)}
    used = {one.paper for one in ROWS} | {one.reach.paper for one in ROWS if one.reach}
    assert printed - used == set()
    assert len(printed) > 30  # the walk above finds them


def test_every_figure_and_table_of_the_paper_has_a_row():
    there = {one.where for one in ROWS}
    figures = [f"figure 1{letter}" for letter in "ABCDEF"] + ["figure 2", "figure 3"]
    figures += [f"figure {i}{letter}" for i in (4, 5, 6) for letter in "ab"]
    assert {*figures, "table 1", "table 2"} <= there
    assert len({one.id for one in ROWS}) == len(ROWS)


def test_an_experiment_that_was_not_asked_says_so():
    numbers = all_experiments()
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
    assert sentence(stat(200.4), (1.0, 0.1), **mse).startswith("ours is 200 times the paper's")
    assert sentence(105.0, 100.0, ours="a.rate_hz") == "ours is 5 % higher; within 10 % of the paper's"


@given(
    mean=st.floats(1, 100), sd=st.floats(0.1, 50), ours=st.floats(0, 200), path=st.sampled_from(["accuracy_pct", "mse"])
)
def test_a_result_differs_exactly_outside_the_papers_sd(mean, sd, ours, path):
    verdict = judge(row(ours=f"a.{path}"), (mean, sd), stat(ours), pooled=True, simulated=True)
    assert verdict.differs == (abs(ours - mean) > sd)
    alone = judge(row(ours=f"a.{path}"), mean, stat(ours), pooled=True, simulated=True)
    assert alone.differs == (abs(ours - mean) > 0.1 * mean)


def test_limits_findings_and_words_are_judged_by_what_they_say():
    assert sentence(0.05, 0.2, rule="at_most") == "ours is at most 0.2"
    assert sentence(0.3, 0.2, rule="at_most") == "ours is not at most 0.2"
    assert sentence(80.0, 90.0, rule="at_least") == "ours is not at least 90"
    assert sentence(-0.1, None, rule="positive") == "ours is not above 0"
    assert sentence(False, None).startswith("does not hold")
    found = {"verdict": "no", "of_trainings": "yes", "why": "Because."}
    assert sentence(found, None, rule="finding") == "over these trainings: yes. Because"


def word(found: Any, printed: Any = None, **words: Any) -> str:
    mine = row(**{"ours": "a.accuracy_pct"} | words)
    return judge(mine, printed, found, pooled=True, simulated=True).word


@pytest.mark.parametrize(
    ("rule", "low", "high", "said"),
    [
        ("gain", 0.1, 3.0, YES), ("gain", -3.0, -0.1, NO), ("gain", -0.1, 3.0, INCONCLUSIVE),
        ("slight", -4.9, 1.0, YES), ("slight", -9.0, -5.1, NO), ("slight", -6.0, 1.0, INCONCLUSIVE),
        ("plateau", -0.9, 0.9, YES), ("plateau", 1.1, 3.0, NO), ("plateau", -1.1, 0.9, INCONCLUSIVE),
        ("positive", 0.1, 3.0, YES), ("positive", -3.0, -0.1, NO), ("positive", -1.0, 3.0, INCONCLUSIVE),
    ],
)  # fmt: skip
def test_claims_are_judged_by_their_interval_over_boards(rule, low, high, said):
    assert word(over_boards(low, high), rule=rule) == said
    assert word({"mean": (low + high) / 2, "n": 1}, rule=rule) == FEW_BOARDS


@given(low=st.floats(50, 99), width=st.floats(0.1, 20), limit=st.floats(60, 99))
def test_limits_are_judged_from_both_sides_alike(low, width, limit):
    stat = over_boards(low, low + width)
    least, most = word(stat, limit, rule="at_least"), word(stat, limit, rule="at_most")
    assert (least, most) in {(YES, NO), (NO, YES), (INCONCLUSIVE, INCONCLUSIVE)}
    assert (least == YES) == (low > limit)


def test_less_of_an_error_is_a_gain():
    assert word(over_boards(-0.3, -0.1), ours="paired.x.mse_xy_mm2", rule="gain") == YES
    assert word(over_boards(0.1, 0.3), ours="paired.x.mse_xy_mm2", rule="gain") == NO


def test_a_claim_says_whether_the_papers_difference_lies_in_our_interval():
    said = sentence(over_boards(-0.5, 4.3), 5.97, rule="gain")
    assert said == "the 95 % interval over 6 boards includes 0; our 95 % interval excludes the paper's"
    assert sentence(over_boards(2.0, 8.0), 5.97, rule="gain").endswith("our 95 % interval includes the paper's")


@pytest.mark.parametrize(
    ("low", "high", "said", "more"),
    [
        (3.0, 8.0, YES, "lies beyond half of the paper's difference"),
        (2.0, 8.0, INCONCLUSIVE, "includes half"),
        (-1.0, 2.9, NO, "equivalent to none within half of the paper's"),
        (-4.0, 2.9, NO, "lies short of half of the paper's difference, 2.98"),
    ],
)
def test_a_sizeable_gain_is_half_of_the_papers_and_one_below_that_may_be_equivalent_to_none(low, high, said, more):
    assert word(over_boards(low, high), 5.97, rule="sizeable") == said
    found = sentence(over_boards(low, high), 5.97, rule="sizeable")
    assert more in found
    assert ("equivalent" in found) == (max(-low, high) < 5.97 / 2)


def with_p(p: float, mean: float = 1.0) -> dict:
    """A difference over boards whose two-sided p-value is p."""
    se = mean / t.isf(p / 2, 5)
    return {"mean": mean, "sd": se * 6**0.5, "n": 6, "ci95": [mean - 2.571 * se, mean + 2.571 * se], "se": se, "df": 5}


def test_a_family_of_claims_is_judged_by_holm_and_other_rows_are_not():
    rows = [
        row(
            id=f"r{i}",
            what="claim: x",
            paper=None,
            says="claimed",
            ours=f"d{i}.accuracy_pct",
            rule="gain",
            family=i < 3,
        )
        for i in range(4)
    ]
    numbers = all_experiments() | {f"d{i}": {"accuracy_pct": with_p(p)} for i, p in enumerate((0.01, 0.03, 0.04, 0.04))}
    table = checklist(numbers, rows)
    # Of three, 0.01 becomes 0.03; 0.03 and 0.04 become 0.06: no longer significant, though their intervals exclude 0.
    assert table["verdict"].tolist() == [YES, INCONCLUSIVE, INCONCLUSIVE, YES]
    assert table["difference"].tolist()[1].endswith("p = 0.06, adjusted for 3 claims")
    assert "adjusted" not in table["difference"].tolist()[3]


def test_claims_stand_in_a_table_of_their_own_if_they_are_judged():
    claims = claims_table(checklist(all_experiments()))
    assert len(claims) > 15
    assert not claims["claim"].str.startswith("claim").any()
    assert "Holm" in claims.attrs["meaning"]
    family = {one.id for one in ROWS if one.family}
    assert len(family) == 12
    assert all(name.endswith("accuracy_pct") or name.startswith(("pokes", "sensors")) for name in family)


def test_a_score_on_repeats_of_one_skin_is_one_board_however_many_repeats():
    assert word(stat(96.3, 0.1, 5), 90.0, rule="at_least") == FEW_BOARDS


def test_what_is_to_hold_at_every_number_of_skins_fails_where_one_fails():
    sweep = [
        {"skins_n": n, "accuracy_pct": over_boards(*ends)} for n, ends in ((1, (1, 2)), (6, (-1, 2)), (15, (2, 3)))
    ]
    assert word(sweep, rule="each") == INCONCLUSIVE
    assert sentence(sweep, None, rule="each") == "supported with 1, 15; undecided with 6 training skins"
    sweep[0]["accuracy_pct"] = over_boards(-2, -1)
    assert word(sweep, rule="each") == NO


def test_a_calibration_target_is_no_evidence_where_it_was_simulated():
    one = {"ours": "table2.single.accuracy_pct", "rule": "target"}
    assert sentence(stat(25.0), (25.0, 10.0), **one).startswith("a calibration target of the simulated spreads")
    assert sentence(stat(25.0), (25.0, 10.0), simulated=False, **one) == "the same"
    assert {one.id for one in ROWS if one.rule == "target"} == {
        f"table-2-single-{metric}" for metric in ("accuracy_pct", "mse_xy_mm2", "mse_f_N2")
    }


def test_every_claim_of_the_paper_has_a_verdict_in_the_one_vocabulary():
    table = checklist(all_experiments())
    claims = table["result"].str.startswith("claim")
    assert set(table.loc[claims, "verdict"]) <= {YES, NO, INCONCLUSIVE, FEW_BOARDS}
    assert claims.sum() > 20
    assert set(table["verdict"]) <= {YES, NO, INCONCLUSIVE, FEW_BOARDS, "–"}


def test_a_sweep_that_does_not_go_as_far_as_a_claim_says_so():
    numbers = all_experiments()
    del numbers["contrasts"]["pokes_plateau"]
    assert difference(numbers, "plateau") == "not reached in this scene"
    del numbers["sweep_pokes"]
    assert difference(numbers, "plateau") == "not asked in this scene"


def test_one_training_skin_is_not_compared_with_pooled_networks():
    own = {"ours": "table2.multi.accuracy_pct"}
    assert "not comparable" in sentence(stat(90.0), (85.0, 1.0), pooled=False, **own)
    assert "points" in sentence(stat(90.0), (85.0, 1.0), pooled=True, **own)


def test_a_reason_is_given_only_where_ours_differs():
    numbers = all_experiments()
    mine = [row(ours="single_random.accuracy_pct", why="Because.")]
    assert checklist(numbers, mine)["difference"][0].endswith("Because.")
    numbers["single_random"]["accuracy_pct"] = stat(99.5)
    assert "Because" not in checklist(numbers, mine)["difference"][0]


def difference(numbers: dict, name: str) -> str:
    (one,) = [one for one in ROWS if one.id == name]
    return checklist(numbers, [one])["difference"][0]


def test_what_is_seen_earlier_than_in_the_paper_is_said_first():
    numbers = all_experiments()
    assert difference(numbers, "figure-5b") == "after 45,000 contacts; ours is above 0"
    numbers["drift"]["late"]["contacts_n"] = 18_000
    assert difference(numbers, "figure-5b") == "not reached: ours after 18,000 contacts; ours is above 0"
    numbers["drift"]["late"]["bias_N"] = -0.1
    assert difference(numbers, "figure-5b").startswith(
        "not reached: ours after 18,000 contacts; ours is not above 0. The paper explains"
    )
    del numbers["drift"]
    assert difference(numbers, "figure-5b") == "not asked in this scene"


@pytest.mark.parametrize("name", ["rate", "temporal-resolution", "logs", "sleeve-chips", "sleeve-rate"])
def test_settings_of_a_simulated_rig_are_no_agreement_with_the_paper(name):
    said = difference(all_experiments("simulated"), name)
    assert said == "a setting of this scene, not a result"
    assert difference(all_experiments("recorded"), name) in ("the same", "–")


def test_the_flexible_bias_is_judged_after_adaptation():
    numbers = all_experiments()
    numbers["flexible"]["bias_f_N"] = {"before": stat(1.0), "after": stat(-0.2)}
    assert difference(numbers, "flexible-bias").startswith("ours is not above 0")


def test_reasons_about_simulation_are_given_of_simulated_scenes_alone():
    simulation = ("simulat", "assumed", "a possible reason")
    for source in ("simulated", "recorded"):
        found = checklist(all_experiments(source))["difference"]
        shown = [one for one in ROWS if one.only in (None, source)]
        said = found[[one.rule not in ("input", "target") for one in shown]].str.contains("|".join(simulation))
        assert said.any() == (source == "simulated")
    assert not any(word in one.why for one in ROWS for word in simulation)


def test_a_reason_names_numbers_of_the_paper_and_of_ours():
    said = difference(all_experiments(), "flexible-accuracy_pct")
    assert "80 % nearer to the skin, ours 45 %" in said


def test_the_papers_number_is_held_against_our_interval_over_boards():
    inside = "within 10 % of the paper's; our 95 % interval includes the paper's"
    assert sentence(over_boards(74.0, 86.0), 85.0).endswith(inside)
    assert sentence(over_boards(76.0, 84.0), (85.0, 9.0)).endswith("our 95 % interval excludes the paper's")
    assert "our 95 %" not in sentence(stat(80.0, 6.0, 5), 85.0)  # repeats are no boards
    assert "our 95 %" not in sentence({"mean": 80.0, "n": 1}, 85.0)


def test_a_misspelt_constant_is_one_sentence():
    with pytest.raises(
        SchemaError, match="must be a constant of reporting.paper, or a path in numbers.json; got SHEARS.x"
    ):
        look_up({}, "SHEARS.x")


def test_a_row_of_a_list_is_picked_by_its_value():
    assert resolve(all_experiments(), "sweep_pokes.pokes_n=390.accuracy_pct") == stat()
    assert resolve(all_experiments(), "paired.of=adapted,over=multi.over") == "multi"
    assert resolve(all_experiments(), "sweep_pokes.pokes_n=391.accuracy_pct") is None


def test_a_claim_of_several_parts_is_denied_by_one_part_with_bonferronis_p_and_affirmed_by_the_largest():
    row = SimpleNamespace(rule="better", ours="x.accuracy_pct")

    def parts(*means: float) -> list[dict]:
        return [{"accuracy_pct": {"mean": mean, "se": se, "df": 5}} for mean, se in zip(means, (0.5, 1.0), strict=True)]

    alone = [p_of(row, None, one["accuracy_pct"]) for one in parts(-5.0, 0.2)]
    assert p_of(row, None, parts(-5.0, 0.2)) == pytest.approx(2 * alone[0])  # not the 0.85 of the other
    assert p_of(row, None, parts(5.0, 0.2)) == pytest.approx(alone[1])
    assert p_of(row, None, []) is None

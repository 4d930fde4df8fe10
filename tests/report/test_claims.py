"""Tests of the verdicts on the paper's claims."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.stats import ttest_1samp

from pipeline.report.claims import (
    CONTRADICTED,
    INCONCLUSIVE,
    NOT_RUN,
    NOT_TESTABLE,
    SUPPORTED,
    Claim,
    claimed_range,
    evaluate,
    judge,
    read_claims,
    resolve,
)
from pipeline.statistics import p_value_of, statistic
from reskin.errors import ParamsError, SchemaError
from tests.report.synthetic import over_boards, p_value

REPORTS = Path(__file__).resolve().parents[2] / "reports"
CLAIMS = read_claims()
VALUES = st.lists(st.floats(20, 99), min_size=4, max_size=8).filter(lambda values: np.std(values) > 0.01)
RULES: list[dict[str, Any]] = [
    {"gain_above": 0.0}, {"loss_above": 1.0}, {"gain_of_paper": 0.5}, {"within": 5.0}, {"at_least": 70.0},
    {"at_most": 70.0}, {"near": 0.1},
]  # fmt: skip


def claim(**fields: Any) -> Claim:
    plain = {"id": "a", "quote": "q", "where": "section 9", "ours": "x.accuracy_pct", "family": "f"}
    return Claim(**(plain | {"paper": "MANUAL.before.accuracy_pct", "rule": {"gain_above": 0.0}} | fields))


def verdict_on(value: Any, **fields: Any) -> str:
    one = claim(**fields)
    path = one.ours.split(".")
    return evaluate({path[0]: {path[1]: value}}, [one])["verdict"][0]


@given(VALUES, st.floats(20, 99))
def test_p_value_equals_scipys_t_test(values, mean):
    stat = statistic(values, boards=True)
    assert p_value_of(stat, mean) == pytest.approx(ttest_1samp(values, mean).pvalue, abs=1e-9)


@given(VALUES, st.sampled_from(RULES), st.sampled_from(["accuracy_pct", "mse_xy_mm2"]))
def test_verdict_never_contradicts_the_interval(values, rule, metric):
    one = claim(rule=rule, ours=f"x.{metric}", paper=f"MANUAL.before.{metric}")
    stat = statistic(values, boards=True, metric="" if one.is_difference else metric)
    (low, high), (start, end) = stat.ci95, claimed_range({}, one)
    inside, outside = start <= low and high <= end, high <= start or end <= low
    assume(all(abs(a - b) > 1e-6 for a in (low, high) for b in (start, end)))
    verdict, _ = judge({"x": {metric: stat.to_json()}}, one)
    assert verdict == (SUPPORTED if inside else CONTRADICTED if outside else INCONCLUSIVE)


@pytest.mark.parametrize(
    ("rule", "low", "high", "verdict"),
    [
        ({"gain_above": 0.0}, 0.1, 3.0, SUPPORTED), ({"gain_above": 0.0}, -3.0, -0.1, CONTRADICTED),
        ({"gain_above": 0.0}, -0.1, 3.0, INCONCLUSIVE), ({"loss_above": 0.0}, -3.0, -0.1, SUPPORTED),
        ({"gain_of_paper": 0.05}, 4.1, 8.0, SUPPORTED), ({"gain_of_paper": 0.05}, 0.1, 3.9, CONTRADICTED),
        ({"within": 5.0}, -4.9, 1.0, SUPPORTED), ({"within": 5.0}, -9.0, -5.1, CONTRADICTED),
        ({"within": 5.0}, -6.0, 1.0, INCONCLUSIVE), ({"at_least": "PLACE_ACCURACY_MIN_PCT"}, 91.0, 96.0, SUPPORTED),
        ({"at_least": 90.0}, 81.0, 89.0, CONTRADICTED), ({"at_most": 90.0}, 81.0, 89.0, SUPPORTED),
        ({"near": 0.1}, 75.0, 84.0, SUPPORTED), ({"near": 0.1}, 60.0, 70.0, CONTRADICTED),
        ({"near": 0.1}, 60.0, 75.0, INCONCLUSIVE),
    ],
)  # fmt: skip
def test_each_rule_gives_the_verdict_of_a_planted_interval(rule, low, high, verdict):
    assert verdict_on(over_boards(low, high), rule=rule) == verdict  # the paper's number is 79.86


def test_number_is_near_within_the_papers_standard_deviation():
    near = {"rule": {"near": 0.1}, "paper": "TABLE_2.adapted.accuracy_pct"}  # 87 +- 11.81
    assert verdict_on(over_boards(76.0, 80.0), **near) == SUPPORTED


@pytest.mark.parametrize("few", [{"mean": 9.0, "n": 2, "values": [8.0, 10.0]}, {"mean": 9.0, "n": 5, "sd": 0.1}])
def test_fewer_than_four_boards_are_inconclusive(few):
    row = evaluate({"x": {"accuracy_pct": few}}, [claim()]).iloc[0]
    assert row["verdict"] == INCONCLUSIVE
    assert np.isnan(row["p_adjusted"])
    assert row["ours"] == ("+9.0 points (8.0; 10.0)" if "values" in few else "+9.00 points ± 0.10")


def test_p_values_are_adjusted_within_a_family():
    ends = [(0.5, 5.0), (0.2, 5.0), (0.05, 5.0), (0.05, 5.0)]
    claims = [claim(id=f"c{i}", ours=f"x{i}.accuracy_pct", family="g" if i == 3 else "f") for i in range(4)]
    table = evaluate({f"x{i}": {"accuracy_pct": over_boards(*low_high)} for i, low_high in enumerate(ends)}, claims)
    p = [p_value(*low_high) for low_high in ends]
    assert table["p_adjusted"].tolist() == pytest.approx(
        [3 * p[0], max(3 * p[0], 2 * p[1]), max(2 * p[1], p[2]), p[3]], rel=0.005
    )
    assert table["verdict"].tolist() == [INCONCLUSIVE, INCONCLUSIVE, INCONCLUSIVE, SUPPORTED]


def test_claim_about_a_list_holds_only_if_it_holds_for_each_row():
    sweep = [{"skins_n": n, "accuracy_pct": over_boards(*ends)} for n, ends in ((1, (1, 2)), (6, (2, 3)))]
    each = claim(ours="x.*.accuracy_pct")
    assert judge({"x": sweep}, each) == (SUPPORTED, pytest.approx(p_value(1, 2)))
    sweep.append({"skins_n": 9, "accuracy_pct": over_boards(-1, 2)})
    assert judge({"x": sweep}, each)[0] == INCONCLUSIVE
    sweep.append({"skins_n": 15, "accuracy_pct": over_boards(-2, -1)})
    assert judge({"x": sweep}, each) == (CONTRADICTED, pytest.approx(4 * p_value(-2, -1)))
    assert judge({"x": sweep}, claim(ours="x.skins_n=6.accuracy_pct"))[0] == SUPPORTED


def test_missing_numbers_and_shorter_experiments_are_not_run():
    numbers = {"x": {"accuracy_pct": over_boards(), "n": 390}}
    assert judge(numbers, claim(reach={"x.n": "ADAPTED_POKES_N"}))[0] == SUPPORTED
    assert judge(numbers, claim(reach={"x.n": "PLATEAU_POKES_N"})) == (NOT_RUN, None)
    assert judge(numbers, claim(ours="y.accuracy_pct")) == (NOT_RUN, None)
    assert judge(numbers, claim(rule={"at_most": "y.accuracy_pct"})) == (NOT_RUN, None)


@pytest.mark.parametrize(
    "fault",
    [
        "metrics: [acuracy_pct], rule: {gain_above: 0}, family: f", "rule: {gain_abov: 0}, family: f",
        "rule: {gain_above: 0}", "rule: {gain_above: 0, within: 1}, family: f", "verdict: not testable here",
        "rule: {at_least: PLACE_ACCURACY}, family: f", "rule: {within: 1}, family: f, paper: TABLE_2.mono",
        "rule: {within: 1}, family: f, reach: {x.n: POKES_N}", "rule: {within: 1}, family: f, why: x",
        "rule: {near: 0.1}, family: f",
    ],
)  # fmt: skip
def test_wrong_entry_is_an_error_that_names_the_claim(tmp_path, fault):
    file = tmp_path / "claims.yaml"
    file.write_text(f"- {{id: wrong, quote: q, where: section 9, ours: x, {fault}}}")
    with pytest.raises((ParamsError, SchemaError), match="claim wrong"):
        read_claims(file)


@pytest.mark.parametrize("scene", ["paper", "quick"])
def test_every_claim_has_one_verdict(scene):
    table = evaluate(json.loads((REPORTS / scene / "numbers.json").read_text()), CLAIMS)
    assert table["id"].is_unique
    assert set(table["verdict"]) <= {SUPPORTED, CONTRADICTED, INCONCLUSIVE, NOT_TESTABLE, NOT_RUN}
    assert list(table) == ["id", "where", "claim", "paper", "ours", "verdict", "p_adjusted", "note"]


def test_every_path_is_in_a_committed_report():
    reports = [json.loads((REPORTS / scene / "numbers.json").read_text()) for scene in ("paper", "quick")]
    paths = {path for one in CLAIMS for path in (one.ours, *(one.reach or {})) if path}
    assert [path for path in paths if all(resolve(numbers, path) is None for numbers in reports)] == []

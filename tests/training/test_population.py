"""Experts read skins of their population: no poke is shown and asked, labels gain, the weight is one more reading."""

import numpy as np
import pytest

from pipeline.training import population
from pipeline.training.population import WAYS, WEIGHT_N, WEIGHT_SD, Experts, cases_of, ready, scores_of, trust
from pipeline.training.universal import TEMPERS
from reskin.seeds import rng_for
from reskin.universal.map import Estimate, new_map
from reskin.universal.training import draw_weights
from tests.universal.skins import made_population, made_tables


@pytest.fixture(scope="module")
def experts() -> Experts:
    return Experts(new_map(made_tables()), [draw_weights(15, rng_for(0, "population"))])


@pytest.fixture(scope="module")
def cases():
    return cases_of(made_population(3, rng_for(1, "population"), WEIGHT_N), rng_for(2, "population"))


def test_no_poke_that_is_shown_is_asked(cases):
    for case in cases:
        shown, asked = ({tuple(row) for row in part} for part in (case.pool.db_uT, case.test_uT))
        assert not shown & asked
        assert len(np.unique(case.pool.place_mm.round(0), axis=0)) == len(case.pool.place_mm)  # one a place


def test_an_untaught_network_spoils_no_map_and_labels_gain(experts, cases):
    how = trust(experts, cases, (0, 0))
    rows = [row for told in ((0, 0), (65, 40)) for case in cases for row in scores_of(experts, case, told, how)]
    off_N2 = {
        (way, n): np.mean([row["mse_f_N2"] for row in rows if (row["way"], row["labels_n"]) == (way, n)])
        for way in WAYS
        for n in (0, 40)
    }
    assert off_N2["map", 40] < off_N2["map", 0] < off_N2["network", 0]
    for row in rows:
        assert row["mse_f_factor_N2"] <= min(row["mse_f_N2"], row["mse_f_weight_N2"]) + 1e-9  # the best factor of all


def test_a_weight_is_known_and_the_rows_are_not(experts, cases):
    case = cases[0]
    asked = ready(experts, case, (16, 0)).read_uT
    np.testing.assert_array_equal(asked[-1], case.weight.db_uT)
    np.testing.assert_array_equal(asked[:-1], case.test_uT)
    off = [np.log(one.weight.force_N / WEIGHT_N) for one in cases]
    assert 0 < np.abs(off).max() < 5 * WEIGHT_SD


def test_the_share_of_a_weight_is_told_at_the_temper_that_is_used(cases, monkeypatch):
    # Forces are off by a factor that grows with the temper; intervals of one temper alone hold 90 %.
    class Told:
        def __init__(self, case):
            self.case = case

        def answers(self, tempers):
            temper, case = tempers["map"], self.case
            reach = 10.0 if temper == TEMPERS[1] else 0.0
            true_mm = np.vstack([case.true[:, :2], [[0, 0]]])
            force_N = np.append(case.true[:, 2] * np.exp(temper), case.weight.force_N * np.exp(0.1))
            found = Estimate(true_mm + 0.1, np.full_like(true_mm, reach), force_N, np.full(len(force_N), np.nan))
            return dict.fromkeys(WAYS, found)

    monkeypatch.setattr(population, "ready", lambda experts, case, told: Told(case))
    how = trust(None, cases, (0, 0))
    assert set(how.temper.values()) == {TEMPERS[1]}
    assert how.weight_share == pytest.approx(dict.fromkeys(WAYS, TEMPERS[1] / 0.1))

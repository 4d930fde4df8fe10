"""Intervals of experts that know no board widen as unlabelled pokes misfit; what answers are is not moved by it."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from pipeline.core.seeds import rng_for
from pipeline.trials import sureness
from pipeline.trials.experts import Experts
from pipeline.trials.sureness import SURENESS, best, skins_of_prior, tell_sureness, told_of
from pipeline.trials.universal import read_both, ready
from pipeline.twin.network import draw_weights
from pipeline.twin.tables import NOMINAL, OF_NOMINAL
from pipeline.twin.training import Syllabus
from tests.twin.skins import SETUP, made_population, made_tables


@pytest.fixture(autouse=True)
def made(monkeypatch):
    draw = lambda centre, spreads, setup, n, rng: made_population(n, rng)  # noqa: E731
    monkeypatch.setattr(sureness, "draw_population", draw)


@pytest.fixture(scope="module")
def nominal() -> Experts:
    networks = [draw_weights(15, rng_for(0, "sureness"))]
    return Experts(made_tables(), networks, None, Syllabus("nominal", NOMINAL, OF_NOMINAL, SETUP))


def plain(skins, rng):
    return skins.db_uT


def half_off(skins, rng):
    return skins.db_uT * np.exp(0.5 * rng.standard_normal((len(skins), 1, 15)))


def test_that_temper_is_best_under_which_nine_in_ten_lie_inside():
    held = [np.array([[0.5, 0.7], [0.9, 0.8], [1.0, 1.0]]), np.array([[0.7, 0.9], [0.9, 0.9], [1.0, 1.0]])]
    assert best((1.0, 0.5, 0.1), held) == (0.5, 0.5)


def test_pokes_that_fit_worse_make_intervals_wider_and_move_no_answer(nominal):
    fits, misfits = (told_of(nominal, skins_of_prior(nominal, 1, 0, "asked", one), 0, 0) for one in (plain, half_off))
    assert misfits[0].misfit > 2 * fits[0].misfit
    assert misfits[0].tempers((0.2, 0.1))[0] == pytest.approx(min(1.0, 0.2 / misfits[0].misfit))
    told, asked = misfits
    by_misfit = [replace(told, misfit=misfit).tempers((0.5, 0.5)) for misfit in (0.1, 1.0, 4.0)]
    assert by_misfit == [(1.0, 1.0), (0.5, 0.5), (0.125, 0.125)]
    for answers in zip(*read_both(ready(told, 0), asked.db_uT, by_misfit), strict=True):
        for one, wider in pairwise(answers):
            np.testing.assert_array_equal(one.place_mm, wider.place_mm)
            assert wider.sd_mm.mean() > one.sd_mm.mean()


def test_sureness_is_told_by_skins_of_the_prior_for_every_number_of_labels(nominal, monkeypatch):
    monkeypatch.setattr(sureness, "FURTHER_N", 2)
    found = tell_sureness(nominal, (0, 40), seed=0)
    assert set(found) == {0, 40}
    assert set(np.ravel(list(found.values()))) <= set(SURENESS)

"""Intervals of experts that know no board widen as pokes misfit and labels are off; no answer is moved by it."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from pipeline.training import universal
from pipeline.training.universal import (
    SURENESS,
    Experts,
    Pokes,
    best,
    by_own_labels,
    read_both,
    ready,
    skins_of_prior,
    tell_sureness,
    told_of,
)
from reskin.seeds import rng_for
from reskin.universal.calibration import variance_inflation
from reskin.universal.map import NOMINAL, OF_NOMINAL
from reskin.universal.training import Syllabus, draw_weights
from tests.universal.skins import SETUP, made_population, made_tables


@pytest.fixture(autouse=True)
def made(monkeypatch):
    draw = lambda centre, spreads, setup, n, rng: made_population(n, rng)  # noqa: E731
    monkeypatch.setattr(universal, "draw_population", draw)


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


@pytest.fixture
def labelled(nominal):
    """A skin that fits, and the same with labels that are 3 mm off, each its own way."""
    told, asked = told_of(nominal, skins_of_prior(nominal, 1, 0, "asked", plain), 0, 0)
    off_mm = 3 * rng_for(1, "labels").standard_normal(told.pool.place_mm.shape)
    misled = replace(told, pool=Pokes(told.pool.place_mm + off_mm, told.pool.force_N, told.pool.db_uT))
    return told, misled, asked


def test_labels_that_are_off_where_they_were_not_told_make_intervals_wider(labelled):
    told, misled, _ = labelled
    of_told, of_misled = (np.array(by_own_labels(one, 40, [(0.3, 0.3), (0.1, 0.1)])) for one in (told, misled))
    assert (of_misled < of_told / 2).all()
    assert by_own_labels(misled, 0, [(0.3, 0.2)]) == [(0.3, 0.2)]  # no label tells nothing
    few = np.array(by_own_labels(misled, 3, [(0.3, 0.3), (0.1, 0.1)]))
    assert (of_misled < few).all()  # three tell less than forty


def test_a_single_label_is_read_by_experts_that_were_told_none(labelled):
    told, misled, _ = labelled
    (found,) = by_own_labels(misled, 1, [(0.3, 0.3)])
    (blind,) = read_both(ready(told, 0), told.pool.db_uT[:1], [(0.3, 0.3)])
    off = [np.abs(one.place_mm - misled.pool.place_mm[:1]) / one.sd_mm for one in blind]
    assert found == pytest.approx([0.3 / variance_inflation(one) for one in off])


def test_sureness_is_told_by_skins_of_the_prior_for_every_number_of_labels(nominal, monkeypatch):
    monkeypatch.setattr(universal, "FURTHER_N", 2)
    found = tell_sureness(nominal, (0, 40), seed=0)
    assert set(found) == {0, 40}
    assert set(np.ravel(list(found.values()))) <= set(SURENESS)

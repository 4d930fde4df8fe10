"""Intervals of the nominal variant widen with misfit and errors of labels; estimates do not change."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from pipeline.training import universal
from pipeline.training.universal import (
    NOMINAL_POWERS,
    PoolCalibration,
    Powers,
    best_powers,
    calibrate_on_simulated,
    calibrate_to_simulated,
    draw_prior_skins,
    estimate,
    lower_by_labels,
)
from pipeline.training.universal_variants import Variant
from reskin.seeds import rng_for
from reskin.universal.calibration import LabelledPresses, variance_inflation
from reskin.universal.map import NOMINAL, NOMINAL_SPREADS, new_map
from reskin.universal.model import PriorModel
from reskin.universal.training import SkinPrior, draw_weights
from tests.universal.skins import SETUP, made_population, made_tables


@pytest.fixture(autouse=True)
def made(monkeypatch):
    draw = lambda centre, spreads, setup, n, rng: made_population(n, rng)  # noqa: E731
    monkeypatch.setattr(universal, "draw_population", draw)


@pytest.fixture(scope="module")
def nominal() -> Variant:
    model = PriorModel(new_map(made_tables()), [draw_weights(15, rng_for(0, "sureness"))])
    return Variant(SkinPrior("nominal", NOMINAL, NOMINAL_SPREADS, SETUP), model)


def plain(skins, rng):
    return skins.db_uT


def half_off(skins, rng):
    return skins.db_uT * np.exp(0.5 * rng.standard_normal((len(skins), 1, 15)))


def calibrated(nominal: Variant, error) -> tuple[PoolCalibration, LabelledPresses]:
    return calibrate_to_simulated(nominal.model, draw_prior_skins(nominal.prior, 1, 0, "asked", error), 0, 0)


def test_the_best_powers_cover_nine_in_ten():
    found = [np.array([[0.5, 0.7], [0.9, 0.8], [1.0, 1.0]]), np.array([[0.7, 0.9], [0.9, 0.9], [1.0, 1.0]])]
    assert best_powers((1.0, 0.5, 0.1), found) == (0.5, 0.5)


def test_a_larger_misfit_widens_intervals_and_moves_no_estimate(nominal):
    (fitting, _), (misfitting, tested) = (calibrated(nominal, error) for error in (plain, half_off))
    assert misfitting.misfit > 2 * fitting.misfit
    powers = misfitting.nominal_powers(Powers(0.2, 0.1))
    assert powers.map == pytest.approx(min(1.0, 0.2 / misfitting.misfit))
    by_misfit = [replace(misfitting, misfit=misfit).nominal_powers(Powers(0.5, 0.5)) for misfit in (0.1, 1.0, 4.0)]
    assert by_misfit == [(1.0, 1.0), (0.5, 0.5), (0.125, 0.125)]
    for estimates in zip(*estimate(misfitting.with_labels(0), tested.db_uT, by_misfit), strict=True):
        for one, wider in pairwise(estimates):
            np.testing.assert_array_equal(one.place_mm, wider.place_mm)
            assert wider.sd_mm.mean() > one.sd_mm.mean()


@pytest.fixture
def fits_and_misled(nominal) -> tuple[PoolCalibration, PoolCalibration]:
    """A skin that fits, and the same with labels that are 3 mm off, each its own way."""
    fits, _ = calibrated(nominal, plain)
    off_mm = 3 * rng_for(1, "labels").standard_normal(fits.pool.place_mm.shape)
    return fits, replace(fits, pool=replace(fits.pool, place_mm=fits.pool.place_mm + off_mm))


def test_errors_of_held_out_labels_widen_intervals(fits_and_misled):
    powers = [Powers(0.3, 0.3), Powers(0.1, 0.1)]
    of_fits, of_misled = (np.array(lower_by_labels(one, 40, powers)) for one in fits_and_misled)
    _, misled = fits_and_misled
    assert (of_misled < of_fits / 2).all()
    assert lower_by_labels(misled, 0, [Powers(0.3, 0.2)]) == [(0.3, 0.2)]  # without labels, unchanged
    assert (of_misled < np.array(lower_by_labels(misled, 3, powers))).all()  # three labels tell less than forty


def test_a_single_label_is_held_out_from_a_calibration_without_labels(fits_and_misled):
    fits, misled = fits_and_misled
    (found,) = lower_by_labels(misled, 1, [Powers(0.3, 0.3)])
    (without,) = estimate(fits.with_labels(0), fits.pool.db_uT[:1], [Powers(0.3, 0.3)])
    off = [np.abs(one.place_mm - misled.pool.place_mm[:1]) / one.sd_mm for one in without]
    assert found == pytest.approx([0.3 / variance_inflation(one) for one in off])


def test_powers_are_calibrated_for_every_number_of_labels(nominal, monkeypatch):
    monkeypatch.setattr(universal, "CALIBRATION_SKINS_N", 2)
    found = calibrate_on_simulated(nominal, (0, 40), seed=0)
    assert set(found) == {0, 40}
    assert set(np.ravel(list(found.values()))) <= set(NOMINAL_POWERS)

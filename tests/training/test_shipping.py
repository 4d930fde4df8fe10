"""Tests of the calibration and of the settings of the shipped universal model."""

import numpy as np
import pytest

from pipeline.training import shipping
from pipeline.training.shipping import NOMINAL_POWERS, best_power, calibrate, calibrate_powers, read_inputs
from reskin.seeds import rng_for
from reskin.universal.batches import SkinPrior
from reskin.universal.calibration import LikelihoodPowers
from reskin.universal.map import NOMINAL, NOMINAL_SPREADS
from reskin.universal.model import Universal, load_universal
from reskin.universal.population import PRESSES_N, Population
from tests.universal.skins import SETUP


@pytest.fixture
def model() -> Universal:
    return load_universal()


def skins_of(model: Universal, skins_n: int, error: float = 0.3) -> Population:
    """Return simulated skins near the nominal one, whose presses are at lattice points.

    Errors of the law (the simulation that gives the field change of a press) are proportional to the field.
    """
    tables, rng = model.tables, rng_for(0, "shipping")
    place_i = rng.integers(2, len(tables.axis_mm) - 2, (2, skins_n, PRESSES_N))
    force_i = rng.integers(1, len(tables.force_N), (skins_n, PRESSES_N))
    number = 0.5 * rng.standard_normal((skins_n, len(tables.names)))
    db_uT = tables.mean_uT[*place_i, force_i] + np.einsum("smct,st->smc", tables.slope_uT[*place_i, force_i], number)
    size_uT = np.linalg.norm(db_uT, axis=2, keepdims=True) / np.sqrt(db_uT.shape[2])
    db_uT = db_uT + error * size_uT * rng.standard_normal(db_uT.shape)
    rest_uT = tables.rest_uT + number @ tables.rest_slope_uT.T
    parts = db_uT, rest_uT, np.moveaxis(tables.axis_mm[place_i], 0, -1), tables.force_N[force_i]
    return Population(*(part.astype(np.float32) for part in parts))


@pytest.mark.parametrize("presses_n", [12, 65])
def test_larger_misfit_lowers_the_likelihood_power(model, presses_n):
    misfits, powers = [], []
    for error in (0.1, 1.0):
        calibrate(model, skins_of(model, 1, error), 0, (presses_n, 0), even=False, seed=0)
        misfits.append(model.misfit)
        powers.append(model.power)
        calibrate(model, skins_of(model, 1, error), 0, (5, 0), even=False, seed=0)
        assert (model.misfit, model.power) == (1.0, model.powers.power_for(0, 0, even=False))
    assert misfits[1] > 3 * misfits[0]
    assert powers == pytest.approx([min(1, model.powers.power_for(presses_n, 0, even=False) / of) for of in misfits])


def test_calibrated_likelihood_power_gives_intervals_that_cover_90_percent():
    assert best_power((1.0, 0.5, 0.1), [np.array([0.5, 0.9, 1.0]), np.array([0.7, 0.9, 1.0])]) == 0.5


def test_likelihood_powers_are_calibrated_for_all_numbers_of_presses_and_labels(model, monkeypatch):
    monkeypatch.setattr(shipping, "CALIBRATION_SKINS_N", 1)
    monkeypatch.setattr(shipping, "draw_prior_skins", lambda *_: skins_of(model, 1))
    found = calibrate_powers(model, SkinPrior("nominal", NOMINAL, NOMINAL_SPREADS, SETUP), (0, 10), seed=0)
    assert {n: set(of) for n, of in found.anywhere.items()} == {n: {0, 10} for n in (0, 12, 65)}
    assert {*found.even.values(), *(one for of in found.anywhere.values() for one in of.values())} <= {*NOMINAL_POWERS}
    assert found == LikelihoodPowers.from_card(found.to_card())


def test_settings_of_the_shipped_model_equal_those_of_scene_lab(model):
    inputs, card = read_inputs(), model.card
    assert inputs.training.model_dump() | {"seed": inputs.seed} == card["training"]
    assert inputs.prior.spreads == card["spreads"]
    assert set(inputs.labels_n) == set(model.powers.even)

"""Tests that a short training run of the network learns from simulated skins and is reproducible."""

import numpy as np
import pytest

from reskin.seeds import rng_for
from reskin.universal.batches import Batches, RecordedBoard, SkinPrior, add_error, draw_kept, draw_recorded, residual_uT
from reskin.universal.map import NOMINAL, NOMINAL_SPREADS, fit_residual
from reskin.universal.network import predict
from reskin.universal.population import PLACES_N, PRESSES_N
from reskin.universal.training import train
from tests.universal.skins import SETUP, fields_uT, make_population

PRIOR = SkinPrior("made up", NOMINAL, NOMINAL_SPREADS, SETUP)
SKINS = make_population(20, rng_for(0, "taught"))


@pytest.fixture(scope="module")
def weights():
    return train(SKINS, PRIOR, 80, rng_for(0, "training"))


def test_short_training_predicts_new_skins_better_than_the_mean(weights):
    tested = slice(PLACES_N, None)
    fresh, off_mm2, off_log2 = make_population(5, rng_for(1, "fresh")), [], []
    for db_uT, rest_uT, place_mm, force_N in zip(
        fresh.db_uT, fresh.rest_uT, fresh.place_mm, fresh.force_N, strict=True
    ):
        found = predict([weights], db_uT[tested], rest_uT, db_uT[:PLACES_N])
        off_mm2.append(((found.place_mm - place_mm[tested]) ** 2).mean())
        off_log2.append(((found.log_N - np.log(force_N[tested])) ** 2).mean())
    assert np.mean(off_mm2) < 0.3 * fresh.place_mm[:, tested].var()
    assert np.mean(off_log2) < 0.5 * np.log(fresh.force_N).var()


def test_equal_generators_give_equal_weights():
    one, other = (train(SKINS, PRIOR, 3, rng_for(2, "same")) for _ in range(2))
    assert all((one[name] == other[name]).all() for name in one)


def test_random_errors_of_the_law_have_the_given_size():
    db_uT = np.full((400, 20, 15), 100.0, np.float32)
    rng = rng_for(3, "errors")
    place_mm = rng.uniform(-8, 8, (400, 20, 2)).astype(np.float32)
    off_uT = add_error(db_uT, place_mm, np.zeros((400, 20), np.float32), (0.3, 0.3), rng) - db_uT
    assert off_uT.std() == pytest.approx(30.0, rel=0.05)
    same_mm = np.zeros((400, 20, 2), np.float32)
    together_uT = add_error(db_uT, same_mm, np.zeros((400, 20), np.float32), (0.3, 0.3), rng)
    # Presses at equal places with equal forces must have equal errors.
    assert np.abs(np.diff(together_uT, axis=1)).max() < 0.01


def test_number_of_presses_shown_to_the_network_varies_from_none_to_all():
    kept_n = draw_kept(4000, rng_for(4, "kept")).sum(axis=1)
    assert (kept_n == 0).mean() == pytest.approx(0.25, abs=0.03)
    assert kept_n[kept_n > 0].min() == 1
    assert kept_n.max() == PLACES_N
    assert kept_n[kept_n > 0].mean() == pytest.approx((PLACES_N + 1) / 2, abs=1.5)


def test_batches_contain_recorded_boards_and_simulated_skins():
    place_mm = SKINS.place_mm[0, :40]
    force_N = np.repeat(SKINS.force_N[0, :40, None], 3, axis=1)
    db_uT = np.repeat(fields_uT(place_mm, force_N[:, 0])[:, None], 3, axis=1).astype(np.float32)
    board = RecordedBoard(db_uT, np.ones(15, np.float32), place_mm, force_N)
    drawn = draw_recorded(board, rng_for(5, "recorded"))
    assert drawn[0].shape == (PRESSES_N, 15)  # The board has only 40 presses, so some of them are drawn repeatedly.
    np.testing.assert_allclose(drawn[0], fields_uT(drawn[2], np.exp(drawn[3])), rtol=1e-4, atol=1e-2)

    residual = fit_residual([place_mm.astype(float)], [force_N[:, 0].astype(float)], [np.full((40, 15), 0.1)])
    added = residual_uT(SKINS, residual)
    expected = residual.at(SKINS.place_mm[3].astype(float), np.log(SKINS.force_N[3].astype(float)))
    length_uT = np.linalg.norm(SKINS.db_uT[3], axis=1, keepdims=True)
    np.testing.assert_allclose(added[3], expected * length_uT, rtol=1e-3, atol=1e-3)

    batch = Batches(SKINS, SkinPrior("rig", NOMINAL, NOMINAL_SPREADS, SETUP, [board], residual)).draw(
        rng_for(6, "batch")
    )
    assert batch.db_uT.shape == (10, PRESSES_N, 15)
    assert batch.target.shape == (10, PRESSES_N - PLACES_N, 3)
    assert (batch.rest_uT == 1).all(axis=1).sum() == 2

"""A short training learns, and learns the same again."""

import numpy as np
import pytest

from reskin.seeds import rng_for
from reskin.universal.map import NOMINAL, OF_NOMINAL, carry
from reskin.universal.network import predict
from reskin.universal.population import PLACES_N, POKES_N
from reskin.universal.training import Feed, Recorded, Syllabus, add_error, carried_uT, draw_kept, draw_recorded, train
from tests.universal.skins import SETUP, fields_uT, made_population

SYLLABUS = Syllabus("made up", NOMINAL, OF_NOMINAL, SETUP)
SKINS = made_population(20, rng_for(0, "taught"))


@pytest.fixture(scope="module")
def weights():
    return train(SKINS, SYLLABUS, 80, rng_for(0, "training"))[0]


def test_a_short_training_beats_the_mean_on_skins_that_it_has_not_seen(weights):
    asked = slice(PLACES_N, None)
    fresh, off_mm2, off_log2 = made_population(5, rng_for(1, "fresh")), [], []
    for db_uT, rest_uT, place_mm, force_N in zip(
        fresh.db_uT, fresh.rest_uT, fresh.place_mm, fresh.force_N, strict=True
    ):
        said = predict([weights], db_uT[asked], rest_uT, db_uT[:PLACES_N])
        off_mm2.append(((said.place_mm - place_mm[asked]) ** 2).mean())
        off_log2.append(((said.log_N - np.log(force_N[asked])) ** 2).mean())
    assert np.mean(off_mm2) < 0.3 * fresh.place_mm[:, asked].var()
    assert np.mean(off_log2) < 0.5 * np.log(fresh.force_N).var()


def test_the_same_generator_gives_the_same_weights():
    one, other = (train(SKINS, SYLLABUS, 3, rng_for(2, "same"))[0] for _ in range(2))
    assert all((one[name] == other[name]).all() for name in one)


def test_errors_of_the_law_are_as_large_as_asked_where_all_chips_read_alike():
    db_uT = np.full((400, 20, 15), 100.0, np.float32)
    rng = rng_for(3, "errors")
    place_mm = rng.uniform(-8, 8, (400, 20, 2)).astype(np.float32)
    off_uT = add_error(db_uT, place_mm, np.zeros((400, 20), np.float32), (0.3, 0.3), rng) - db_uT
    assert off_uT.std() == pytest.approx(30.0, rel=0.05)
    same_mm = np.zeros((400, 20, 2), np.float32)
    together_uT = add_error(db_uT, same_mm, np.zeros((400, 20), np.float32), (0.3, 0.3), rng)
    assert np.abs(np.diff(together_uT, axis=1)).max() < 0.01  # at one place under one force, one error


def test_some_skins_come_without_a_poke_and_the_others_with_any_number():
    shown_n = draw_kept(4000, rng_for(4, "kept")).sum(axis=1)
    assert (shown_n == 0).mean() == pytest.approx(0.25, abs=0.03)
    assert shown_n[shown_n > 0].min() == 1
    assert shown_n.max() == PLACES_N
    assert shown_n[shown_n > 0].mean() == pytest.approx((PLACES_N + 1) / 2, abs=1.5)


def test_known_boards_are_taught_beside_simulated_skins_with_what_they_miss():
    place_mm = SKINS.place_mm[0, :40]
    force_N = np.repeat(SKINS.force_N[0, :40, None], 3, axis=1)
    db_uT = np.repeat(fields_uT(place_mm, force_N[:, 0])[:, None], 3, axis=1).astype(np.float32)
    board = Recorded(db_uT, np.ones(15, np.float32), place_mm, force_N)
    drawn = draw_recorded(board, rng_for(5, "recorded"))
    assert drawn[0].shape == (POKES_N, 15)  # of 40 pokes, some come again
    np.testing.assert_allclose(drawn[0], fields_uT(drawn[2], np.exp(drawn[3])), rtol=1e-4, atol=1e-2)

    missed = carry([place_mm.astype(float)], [force_N[:, 0].astype(float)], [np.full((40, 15), 0.1)])
    added = carried_uT(SKINS, missed)
    expected = missed.at(SKINS.place_mm[3].astype(float), np.log(SKINS.force_N[3].astype(float)))
    length_uT = np.linalg.norm(SKINS.db_uT[3], axis=1, keepdims=True)
    np.testing.assert_allclose(added[3], expected * length_uT, rtol=1e-3, atol=1e-3)

    batch = Feed(SKINS, Syllabus("rig", NOMINAL, OF_NOMINAL, SETUP, [board], missed)).draw(rng_for(6, "batch"))
    assert batch.db_uT.shape == (10, POKES_N, 15)
    assert batch.target.shape == (10, POKES_N - PLACES_N, 3)
    assert (batch.rest_uT == 1).all(axis=1).sum() == 2

"""The earth's field on a board that turns: rotation by hand as truth, known answers, rest and size as laws."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.core.seeds import rng_for
from pipeline.experiments.ambient.fields import Instrument
from pipeline.experiments.logs.estimates import contacts_n, estimate, score_contacts
from pipeline.experiments.logs.turning import PERIOD_S, PITCHES_DEG, Log, earth_T, step_period_s, swing, turn_log
from pipeline.physics.ambient import EARTH_DIP_DEG, EARTH_SIZE_T, EARTH_T
from pipeline.physics.board import Board
from tests.evaluation.test_logs import answers, truth, walk


def plain_board(name, chips_n):
    """Chips that read the field as it is, none of them turned."""
    eyes = np.tile(np.eye(3), (chips_n, 1, 1))
    return Board(name, np.zeros((chips_n, 3)), eyes, eyes, np.zeros((chips_n, 3)))


def instrument(noise_uT=0.0):
    own = plain_board("b0", 5)
    return Instrument(own, plain_board("aside", 1), own.turn, np.full(3, noise_uT))


def turned(noise_uT=0.0):
    t_s, b_uT, force_N = walk()
    quiet_n = estimate(t_s, b_uT, [answers], where="log").quiet_n
    log = Log(t_s, b_uT, truth(force_N), quiet_n)
    return log, turn_log(log, instrument(noise_uT), [answers], rng_for(0, "aside"))


def test_a_board_that_pitches_reads_the_earths_field_turned_the_other_way():
    np.testing.assert_allclose(earth_T(np.array([0.0])), EARTH_T[None])
    # nose down by the dip: what points north and down at the dip now lies along the board's own x axis
    along_T = earth_T(np.radians([EARTH_DIP_DEG]))
    np.testing.assert_allclose(along_T, [[EARTH_SIZE_T, 0, 0]], atol=1e-18)


@given(st.floats(-1.5, 1.5))
def test_the_field_changes_by_the_chord_of_its_turn_and_keeps_its_size(pitch_rad):
    turned_T = earth_T(np.array([pitch_rad]))[0]
    assert np.linalg.norm(turned_T) == pytest.approx(EARTH_SIZE_T)
    chord_T = 2 * EARTH_SIZE_T * np.sin(abs(pitch_rad) / 2)
    assert np.linalg.norm(turned_T - EARTH_T) == pytest.approx(chord_T, abs=1e-18)  # rounding of 50 uT


def test_a_board_rests_until_it_swings_once_a_period():
    t_s = np.array([0.0, 1.0, 1.125, 1.25, 1.375, 1.5])
    np.testing.assert_allclose(swing(t_s, start_s=1.0, period_s=0.5), [0, 0, 1, 0, -1, 0], atol=1e-12)


def test_the_period_is_the_usual_time_between_starts_of_contact():
    t_s = np.arange(12) / 10
    assert step_period_s(t_s, np.array([0, 1, 1, 0, 0, 1, 0, 0, 0, 0, 1, 1], bool)) == pytest.approx(0.45)
    assert step_period_s(t_s, np.arange(12) == 3) == PERIOD_S
    assert step_period_s(t_s, np.zeros(12, bool)) == PERIOD_S


def test_a_board_that_does_not_pitch_is_read_as_if_there_were_no_earth():
    log, rows = turned()
    found = estimate(log.t_s, log.b_uT, [answers], where="log")
    level = rows[0]
    assert level["pitch_deg"] == 0
    assert level["contacts_n"] == contacts_n(found.contact) == 4
    scores = score_contacts(found, log.true)
    assert level["false_readings_n"] == scores["false_readings_n"] == 0
    assert level["mse_f_N2"] == pytest.approx(scores["mse_f_N2"], rel=1e-3)  # 1000 uT in float32: 6e-5 uT


def test_false_contacts_grow_with_the_pitch_and_a_perfect_chip_aside_takes_them_away():
    log, rows = turned()
    assert [row["pitch_deg"] for row in rows] == list(PITCHES_DEG)
    false_n = [row["false_readings_n"] for row in rows]
    assert false_n == sorted(false_n)
    # At 45 degrees the field of all five chips swings by up to sqrt(5) 38 uT = 86 uT, against a threshold of
    # sqrt(15) 3 uT + 18 uT = 30 uT: hidden while sin is small, for less than a third of the time.
    off_n = int((np.isnan(log.true[:, 2]) & (np.arange(len(log.t_s)) >= log.quiet_n)).sum())
    assert 0.6 * off_n < false_n[-1] < off_n
    for row in rows:
        assert row["reference_chip"] == {name: rows[0]["reference_chip"][name] for name in row["reference_chip"]}
        assert row["reference_chip"]["false_readings_n"] == 0


def test_the_noise_of_the_chip_aside_is_paid_in_readings_and_forces():
    rows = turned(noise_uT=3.0)[1]
    assert all(row["reference_chip"]["mse_f_N2"] > 1.5 * rows[0]["mse_f_N2"] for row in rows)
    assert all(row["reference_chip"]["contacts_n"] == 4 for row in rows)

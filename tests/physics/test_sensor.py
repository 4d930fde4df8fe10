"""The chip against its data sheet: units, frames, steps, range and noise."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.core.seeds import rng_for
from pipeline.physics.board import Board
from pipeline.physics.sensor import ChipDesign, Overruns, read_field, read_temperature, steps_uT

QUARTER = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
QUIET = ChipDesign(gain_sel=7, noise_xy_uT=0.0, noise_z_uT=0.0, noise_temperature_degC=0.0)
LOUD = ChipDesign(gain_sel=7, noise_xy_uT=3.3, noise_z_uT=5.0, noise_temperature_degC=0.1)
fields_T = st.tuples(*[st.floats(-4e-3, 4e-3)] * 3).map(np.array)


def board(*, turn=None, gain=1.0, offset_T=0.0):
    turn = np.eye(3) if turn is None else turn
    return Board("b0", np.zeros((1, 3)), turn[None], gain * np.eye(3)[None], np.full((1, 3), offset_T))


def read(b_T, of=None, design=QUIET):
    b_T = np.asarray(b_T, dtype=float).reshape(-1, 1, 3)
    return read_field(b_T, of or board(), design=design, rng=rng_for(0, "sensor"))


def test_the_steps_are_those_of_the_data_sheet():
    np.testing.assert_allclose(steps_uT(7), (0.150, 0.150, 0.242))
    np.testing.assert_allclose(steps_uT(6), (0.200, 0.200, 0.3227), atol=5e-5)  # four published decimals
    np.testing.assert_allclose(steps_uT(0), np.multiply(5, (0.150, 0.150, 0.242)))


@given(fields_T)
def test_a_quiet_chip_reads_the_field_in_uT_to_half_a_step(b_T):
    b_uT, overruns = read(b_T)
    assert b_uT.dtype == np.float32
    assert overruns == Overruns(clipped_n=0, wrapped_n=0)
    assert (np.abs(b_uT[0] - 1e6 * b_T) <= steps_uT(7) / 2 + 1e-3).all()  # float32 of 4000 uT: 2e-4


def test_a_chip_turned_by_90_degrees_reads_the_boards_y_on_its_x():
    b_uT, _ = read([0, 300e-6, 0], board(turn=QUARTER))
    np.testing.assert_allclose(b_uT, [[300, 0, 0]], atol=0.08)  # half a step


def test_gain_and_offset_act_in_the_chips_frame():
    b_uT, _ = read([100e-6, 0, 0], board(gain=2.0, offset_T=30e-6))
    np.testing.assert_allclose(b_uT, [[230, 30, 30]], atol=0.13)  # half a step of z


def test_readings_are_whole_steps():
    b_uT, _ = read(rng_for(1, "sensor").uniform(-4e-3, 4e-3, size=(500, 3)), design=LOUD)
    counts = b_uT.astype(np.float64) / steps_uT(7)
    np.testing.assert_allclose(counts, np.rint(counts), atol=2e-3)  # float32 of 4000 uT is off by 1e-3 steps


def test_past_its_range_a_reading_wraps_and_is_counted():
    b_uT, overruns = read([[5e-3, 0, 0], [0, 0, -8e-3], [4.9e-3, 0, 7.9e-3]])
    assert overruns == Overruns(clipped_n=0, wrapped_n=2)
    assert b_uT[0, 0] == pytest.approx(5000 - 2**16 * 0.150, abs=0.08)
    assert b_uT[1, 2] == pytest.approx(-8000 + 2**16 * 0.242, abs=0.13)


@pytest.mark.parametrize(("field_T", "clipped_n"), [(49.99e-3, 0), (50.01e-3, 1), (-60e-3, 1)])
def test_past_50_mT_the_chip_reads_50_mT_and_wraps_that(field_T, clipped_n):
    b_uT, overruns = read([0, field_T, 0])
    held_uT = 1e6 * np.clip(field_T, -50e-3, 50e-3)
    turns_n = round(held_uT / (2**16 * 0.150))
    assert overruns == Overruns(clipped_n=clipped_n, wrapped_n=1)
    assert b_uT[0, 1] == pytest.approx(held_uT - turns_n * 2**16 * 0.150, abs=0.08)  # half a step


def test_what_clips_is_the_field_that_the_chip_sees_and_not_its_offset():
    _, overruns = read([0, 0, 49.9e-3], board(offset_T=200e-6))
    assert overruns.clipped_n == 0
    assert read([0, 0, 49.9e-3], board(gain=1.1))[1].clipped_n == 1


def test_noise_has_the_stated_spread_on_each_axis():
    b_uT, _ = read(np.zeros((40_000, 3)), design=LOUD)
    # 2 %: four times the sampling error 1 / sqrt(2 n); the step adds less than 0.1 %
    np.testing.assert_allclose(b_uT.std(axis=0), (3.3, 3.3, 5.0), rtol=0.02)
    np.testing.assert_allclose(b_uT.mean(axis=0), 0, atol=0.1)


def test_temperature_comes_in_steps_of_the_data_sheet_around_the_truth():
    read_degC = read_temperature(np.full((10_000, 5), 25.0), LOUD, rng_for(2, "sensor"))
    steps = (read_degC.astype(np.float64) - 25) * 45.2
    np.testing.assert_allclose(steps, np.rint(steps), atol=1e-3)  # float32 of 25
    assert read_degC.std() == pytest.approx(0.1, rel=0.05)
    assert read_degC.mean() == pytest.approx(25, abs=0.01)


def test_the_same_generator_gives_the_same_readings():
    first, again = (read(np.full((50, 3), 1e-3), design=LOUD)[0] for _ in range(2))
    assert first.tobytes() == again.tobytes()

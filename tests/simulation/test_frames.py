"""Tests of frames that chips read from simulated fields: blocks, repeated conversions, temperature, sensitivity."""

import numpy as np
import pytest

from reskin.physics.aging import REMANENCE_PER_K, Temperature
from reskin.physics.board import Board
from reskin.physics.chip import ChipDesign
from reskin.seeds import rng_for
from reskin.simulation import rig
from reskin.simulation.contact import Response
from reskin.simulation.rig import Readout, Rig, read_frames, timeline
from tests.simulation.scene import SECTIONS

N, CHIPS_N = 40, 2
IDENTITIES = np.tile(np.eye(3), (CHIPS_N, 1, 1))
BOARD = Board("b0", np.zeros((CHIPS_N, 3)), IDENTITIES, IDENTITIES, np.zeros((CHIPS_N, 3)))
LOUD = ChipDesign(gain_sel=7, noise_xy_uT=3.0, noise_z_uT=5.0, noise_temperature_degC=0.1)
QUIET = ChipDesign(gain_sel=7, noise_xy_uT=0.0, noise_z_uT=0.0, noise_temperature_degC=0.0)
WARMING = Temperature(warming_K=10.0, warming_s=1.0, swing_K=2.0, swing_s=3.0, chip_sensitivity_per_K=0.0)


def response():
    rng = rng_for(0, "felt")
    rest_T = 1e-3 + 1e-4 * rng.standard_normal((N, CHIPS_N, 3))
    return Response(rest_T, 2e-4 * rng.standard_normal((N, 1, CHIPS_N, 3)), np.zeros((N, 1, 3)), 0)


def read(chip=LOUD, rate_hz=400.0, temperature=None, sensitivity_per_K=(0.0, 0.0), contact_response=None):
    reader = Readout(BOARD, chip, rate_hz, np.array([0.2e-3, 1.5e-3]), temperature, np.array(sensitivity_per_K))
    line = timeline(Rig(**SECTIONS["rig"]), 1)
    return read_frames(
        contact_response or response(), line, reader, noise=rng_for(0, "noise"), warmth_noise=rng_for(0, "warmth")
    )


@pytest.mark.parametrize("rate_hz", [400.0, 1000.0])
def test_frames_do_not_depend_on_the_size_of_blocks(rate_hz, monkeypatch):
    whole = read(rate_hz=rate_hz, temperature=WARMING)
    monkeypatch.setattr(rig, "BLOCK_INDENTATIONS_N", 7)
    parts = read(rate_hz=rate_hz, temperature=WARMING)
    np.testing.assert_array_equal(whole.b_uT, parts.b_uT)
    np.testing.assert_array_equal(whole.temperature_degC, parts.temperature_degC)


def test_chip_reads_the_field_of_an_earlier_time_because_conversion_takes_time():
    one = response()
    ramp = one.change_T[:, 0].copy()
    frames_n = len(timeline(Rig(**SECTIONS["rig"]), 1))
    found_uT = read(QUIET).b_uT.reshape(N, frames_n, CHIPS_N, 3)
    # Frame 5 is the first one while the tip moves down. At its time, the field change is a third of the whole change.
    share = (found_uT[:, 5] / 1e6 - one.rest_T) / ramp
    large = np.abs(ramp) > 1e-4  # One step of 0.15 uT is less than 0.002 of this change.
    assert (share[large] < 1 / 3 + 0.002).all()
    assert (share[large] > -0.01).all()
    # The field changes differ, because the time since the last conversion differs between chips and between
    # indentations.
    assert share[large].max() - share[large].min() > 0.2


def test_warming_changes_the_field_of_the_skin_and_the_sensitivity_of_the_chip():
    warm, room = (read(QUIET, temperature=drift, sensitivity_per_K=(0.004, -0.002)).b_uT for drift in (WARMING, None))
    last = slice(-8, -3)  # In these frames, the field is constant.
    late_s = len(room) / 400.0
    warmer_K = 10 * (1 - np.exp(-late_s)) + 2 * np.sin(2 * np.pi * late_s / 3)
    ratio = (warm[last] / room[last]).mean(axis=0).reshape(CHIPS_N, 3).mean(axis=1)
    truth = (1 + REMANENCE_PER_K * warmer_K) * (1 + warmer_K * np.array([0.004, -0.002]))
    # The tolerance is the rounding of 0.15 in 1000 uT, and the warming during 10 frames.
    np.testing.assert_allclose(ratio, truth, atol=1.5e-3)

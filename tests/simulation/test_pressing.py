"""Tests of protocols with weights and walks: forces, half sines in time, footfalls."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from reskin.data.grid import SKIN_MM
from reskin.errors import CaptureError, ParamsError
from reskin.physics.skin import draw_skin, forces
from reskin.recordings.header import write_capture
from reskin.recordings.ingest import open_capture
from reskin.recordings.readers.sd_card import read_log
from reskin.seeds import rng_for
from reskin.simulation.capture import simulate_capture, to_files
from reskin.simulation.protocols import Walk, depths_under_load
from tests.recordings.headers import DEFAULT_POLICY
from tests.simulation.scene import synthesis, with_protocol

SHARED = {"boards": "rigid", "skins_n": 1, "terms": []}
GLASS = {"kind": "load", "passes_n": 3, "force_max_N": 1.0, "step_N": 0.25} | SHARED
WALK = {
    "kind": "walk", "steps_n": 3, "stance_s": (0.2, 0.5), "swing_s": (0.2, 0.6), "quiet_s": 0.4,
    "depth_mm": (0.4, 1.2), "rate_hz": 250.0,
} | SHARED  # fmt: skip
SKIN = draw_skin(synthesis().skin, synthesis().spreads, seed=1, name="b0_s0")


def capture_of(name, protocol, **changes):
    return simulate_capture(with_protocol(name, protocol, **changes), name, board="b0", skin="b0_s0", seed=1)


@given(st.floats(1e-3, 2.0))
def test_force_at_the_depth_of_a_weight_equals_the_weight(weight_N):
    depth_m = depths_under_load(SKIN, np.array([[weight_N]]))
    # Tolerance: 1e-12 m times at most 20 N/mm is 2e-8 N.
    assert forces(SKIN, depth_m[0])[0] == pytest.approx(weight_N, abs=2e-8)


def test_labels_of_a_filling_are_weights_and_no_depths():
    capture = capture_of("glass", GLASS)
    log = capture.probe
    assert np.isnan(log.depth_mm[log.contact]).all()
    read_N = log.Fz_N[log.contact].reshape(3, 5)
    # The tolerance is six standard deviations.
    np.testing.assert_allclose(read_N, np.tile([0, 0.25, 0.5, 0.75, 1.0], (3, 1)), atol=6 * 0.006)
    assert set(log.x_mm[log.contact]) == {8.0}


def test_frames_in_contact_form_dwells():
    log = capture_of("log", WALK).probe
    plan = Walk(**WALK | {"terms": ()}).plan(rng_for(1, "recording", "log", "b0", "b0_s0", "plan"), SKIN_MM)
    assert log.contact.sum() == (plan.depth_mm > 0).sum()
    dwell_s = (log.t_end_s - log.t_start_s)[log.contact]
    np.testing.assert_allclose(dwell_s, 1 / 250, rtol=1e-3)
    depths_mm = log.depth_mm[log.contact]
    np.testing.assert_allclose(depths_mm, plan.depth_mm[plan.depth_mm > 0], rtol=1e-6)


def one_step(rate_hz):
    """Return a walk with one step: 4 frames at rest, and 20 frames in contact."""
    times_s = {"stance_s": (20 / rate_hz,) * 2, "swing_s": (4 / rate_hz,) * 2, "quiet_s": 4 / rate_hz}
    return WALK | {"steps_n": 1, "rate_hz": rate_hz, **times_s}


def test_readings_of_a_rising_step_lag_behind_the_field():
    quiet = {**synthesis().chip.model_dump(), "noise_xy_uT": 0.0, "noise_z_uT": 0.0}
    fast, slow = (
        capture_of("log", one_step(rate_hz), chip=quiet)
        # Both steps have 20 frames. They are 2.5 ms apart in the fast step, and 250 ms in the slow one.
        for rate_hz in (400.0, 4.0)
    )
    still_uT, moving_uT = (one.b_uT.reshape(-1, 5, 3)[4:24].astype(float) for one in (slow, fast))
    late_uT = np.abs(moving_uT - still_uT).max(axis=(0, 2))  # of each chip
    assert (late_uT > 1.0).all()  # A difference of 1 uT is more than three steps of z.
    # The fast step is read up to 1.84 ms late, and frames are 2.5 ms apart. Each reading must therefore be between two
    # readings of the slow step.
    low_uT, high_uT = (np.sort([still_uT[1:], still_uT[:-1]], axis=0)[i] for i in (0, 1))
    assert (moving_uT[1:] >= low_uT - 1).all()  # The tolerance of 1 uT is more than the resolution of the chips.
    assert (moving_uT[1:] <= high_uT + 1).all()


def test_times_of_true_forces_start_at_the_first_frame_of_the_log():
    capture = capture_of("log", WALK)
    assert capture.card_rate_hz == 250.0
    log = capture.probe
    assert log.t_start_s[0] == pytest.approx(0.5 / 250)
    assert log.t_end_s[0] == pytest.approx(100.5 / 250)  # The first contact starts after 0.4 s at rest.
    touched = log.depth_mm[log.contact].astype(float)
    skin = draw_skin(
        synthesis().skin,
        synthesis().spreads,
        seed=1,
        name="b0_s0",
        rule=synthesis().main_boards.quadrature.in_si(),
    )
    # The relative tolerance is for depths in single precision.
    np.testing.assert_allclose(log.Fz_N[log.contact], forces(skin, touched * 1e-3), rtol=1e-4)
    # Two gaps between contacts mean three footfalls.
    assert (np.diff(log.t_start_s[log.contact]) > 1.5 / 250).sum() == 2


def test_weights_and_walks_cannot_be_simulated_with_relaxation_or_wear():
    with pytest.raises(ParamsError, match="terms"):
        with_protocol("log", WALK | {"terms": ["relaxation"]})
    with pytest.raises(ParamsError, match="stance_s must list the smaller value first"):
        with_protocol("log", WALK | {"stance_s": (1.0, 0.05)})
    with pytest.raises(ParamsError, match="multiple of step_N"):
        with_protocol("glass", GLASS | {"step_N": 0.3})


def test_walk_is_written_as_the_log_of_an_sd_card(tmp_path):
    capture = capture_of("log", WALK)
    header = write_capture(tmp_path / capture.name, *to_files(capture, with_protocol("log", WALK)))
    assert sorted(header.files) == ["log.csv", "probe.csv"]
    assert (header.layout, header.wire, header.source) == ("sd-card", None, "simulated")
    t_s, b_uT, temperature_degC, account = read_log(tmp_path / capture.name / "log.csv")
    np.testing.assert_allclose(t_s, (1 + np.arange(len(capture.b_uT))) / 250)
    np.testing.assert_allclose(b_uT, capture.b_uT, atol=5.1e-3)  # Tolerance: the log has two decimals.
    np.testing.assert_allclose(temperature_degC, capture.temperature_degC, atol=5.1e-3)
    assert account["rows_n"] == len(t_s)
    with pytest.raises(CaptureError, match="layout must be native or one of .*; got sd-card"):
        open_capture(tmp_path / capture.name, DEFAULT_POLICY)

"""A synthetic capture against the protocol it follows and the field it is made of; clocks, names and seeds as laws."""

from dataclasses import fields

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.dataset.grid import points_mm
from pipeline.dataset.synthetic import Synthesis, record_skin, roster
from pipeline.errors import ParamsError
from pipeline.physics.board import draw_board
from pipeline.physics.skin import changes_of_field, draw_skin, forces
from pipeline.strict import parse

NOLOAD_N, MOVING_N, READINGS_N, RATE_HZ = 4, 2, 3, 400.0
FRAMES_N = NOLOAD_N + 2 * MOVING_N + READINGS_N
CONTACT_I = NOLOAD_N + MOVING_N

PARAMETERS = {
    "boards_n": 2,
    "skins_per_board_n": 2,
    "recording": {
        "passes_n": 2,
        "depths_mm": (0.6, 1.2),
        "noload_frames_n": NOLOAD_N,
        "moving_frames_n": MOVING_N,
        "readings_n": READINGS_N,
        "rate_hz": RATE_HZ,
        "chunk_frames_max_n": 4,
        "arrival_jitter_s": 1e-4,
        "probe_clock_offset_s": 5.0,
        "probe_clock_rate_error": 5e-5,
        "force_noise_N": 0.006,
    },
    "skin": {
        "polarity": "checkerboard",
        "saturation_T": 0.17,
        "half_field_T": 0.5,
        "thickness_mm": 2.0,
        "modulus_kPa": 190.0,
        "tip_radius_mm": 3.0,
    },
    "board": {
        "chips_xy_mm": ((0.0, 0.0), (-7.0, 0.0), (0.0, -7.0), (7.0, 0.0), (0.0, 7.0)),
        "chips_turn_deg": (0.0, 180.0, 0.0, 90.0, 270.0),
        "gap_mm": 1.1,
    },
    "chip": {"gain_sel": 2, "noise_xy_uT": 3.3, "noise_z_uT": 5.0, "noise_temperature_degC": 0.1},
    "spreads": {
        "board_gap_mm": 0.1,
        "chip_gain": 0.025,
        "chip_cross_axis": 0.01,
        "chip_tilt_deg": 2.0,
        "chip_offset_uT": 200.0,
        "skin_amplitude": 0.1,
        "skin_filler": 0.1,
        "skin_filler_length_mm": 3.0,
        "skin_thickness": 0.03,
        "skin_modulus": 0.1,
        "skin_seat_mm": 0.25,
        "skin_depth_zero_mm": 0.05,
    },
}


def parameters(section=None, **changes):
    value = PARAMETERS | ({section: PARAMETERS[section] | changes} if section else changes)
    return parse(Synthesis, value, "test")


def record(of=None, *, board="b0", skin="b0_s0", seed=1):
    return record_skin(of or parameters(), board, skin=skin, seed=seed)


@pytest.fixture(scope="module")
def capture():
    return record()


def same(one, other):
    arrays = ("b_uT", "temperature_degC", "arrived_frames_n", "arrived_s")
    return all(getattr(one, name).tobytes() == getattr(other, name).tobytes() for name in arrays) and same_log(
        one, other
    )


def same_log(one, other):
    return all(np.array_equal(getattr(one.probe, f.name), getattr(other.probe, f.name)) for f in fields(one.probe))


def shaped(capture):
    """Frames as indentation, frame within it, chip, axis."""
    return capture.b_uT.astype(np.float64).reshape(-1, FRAMES_N, 5, 3)


def test_there_is_a_frame_for_every_reading_and_two_dwells_an_indentation(capture):
    indentations_n = 2 * 2 * 65
    assert capture.b_uT.shape == (indentations_n * FRAMES_N, 15)
    assert capture.temperature_degC.shape == (indentations_n * FRAMES_N, 5)
    assert len(capture.probe) == 2 * indentations_n
    assert np.array_equal(capture.probe.contact, np.tile([False, True], indentations_n))
    assert capture.wrapped_n == 0


def test_a_quiet_capture_holds_the_field_of_its_board_and_skin():
    quiet = parameters("chip", gain_sel=2, noise_xy_uT=0.0, noise_z_uT=0.0)
    b_uT = shaped(record(quiet))
    board = draw_board(quiet.board, quiet.spreads, seed=1, name="b0")
    skin = draw_skin(quiet.skin, quiet.spreads, seed=1, name="b0_s0")
    pokes_m = np.array([[x - 8, y - 8, depth] for depth in (0.6, 1.2) for x, y in points_mm()]) * 1e-3
    _, changes_T = changes_of_field(board, skin, pokes_m)
    truth_uT = 1e6 * np.einsum("kij,klj,nkl->nki", board.sensitivity, board.turn, changes_T)
    found_uT = (b_uT[:, CONTACT_I : CONTACT_I + READINGS_N] - b_uT[:, :1])[:130]
    assert np.abs(found_uT - truth_uT[:, None]).max() < 0.75  # a step of z, lost twice by half


def test_moving_frames_lie_between_rest_and_contact_and_belong_to_no_dwell():
    b_uT = shaped(record(parameters("chip", noise_xy_uT=0.0, noise_z_uT=0.0)))
    rest, down, contact = b_uT[:, 0], b_uT[:, CONTACT_I - 1], b_uT[:, CONTACT_I]
    np.testing.assert_allclose(down - rest, (contact - rest) * 2 / 3, atol=1.0)  # steps of 0.45 and 0.73 uT
    np.testing.assert_array_equal(b_uT[:, CONTACT_I + READINGS_N], down)


def test_each_dwell_holds_its_frames_and_no_other_once_the_clocks_are_joined(capture):
    (stream_0, probe_0), (stream_1, probe_1) = capture.marks
    rate = (stream_1 - stream_0) / (probe_1 - probe_0)
    frame_s = (1 + np.arange(len(capture.b_uT))) / RATE_HZ
    start_s, end_s = (stream_0 + rate * (t - probe_0) for t in (capture.probe.t_start_s, capture.probe.t_end_s))
    first_i, after_i = np.searchsorted(frame_s, start_s), np.searchsorted(frame_s, end_s)
    begins = FRAMES_N * np.repeat(np.arange(260), 2) + np.tile([0, CONTACT_I], 260)
    np.testing.assert_array_equal(first_i, begins)
    np.testing.assert_array_equal(after_i - first_i, np.tile([NOLOAD_N, READINGS_N], 260))


def test_the_probe_has_a_clock_of_its_own(capture):
    (stream_0, probe_0), (stream_1, probe_1) = capture.marks
    assert abs(probe_0 - stream_0) > 0.01
    assert 0 < abs((probe_1 - probe_0) / (stream_1 - stream_0) - 1) < 5e-4


@settings(max_examples=5, deadline=None)
@given(st.integers(1, 7), st.floats(0, 0.01), st.integers(0, 1000))
def test_chunks_bring_every_frame_once_in_order_and_never_early(chunk_frames_max_n, jitter_s, seed):
    how = parameters("recording", passes_n=1, chunk_frames_max_n=chunk_frames_max_n, arrival_jitter_s=jitter_s)
    one = record(how, seed=seed)
    assert one.arrived_frames_n[0] == 0
    assert one.arrived_frames_n[-1] == len(one.b_uT)
    sizes = np.diff(one.arrived_frames_n)
    assert sizes.min() >= 1
    assert sizes.max() <= chunk_frames_max_n
    assert (np.diff(one.arrived_s) >= 0).all()
    assert (one.arrived_s >= one.arrived_frames_n / RATE_HZ).all()


def test_labels_are_what_was_commanded_and_the_force_is_the_skins(capture):
    log = capture.probe
    touching = log.contact
    np.testing.assert_array_equal(np.column_stack([log.x_mm, log.y_mm])[touching], np.tile(points_mm(), (4, 1)))
    assert not log.depth_mm[~touching].any()
    of = parameters()
    skin = draw_skin(of.skin, of.spreads, seed=1, name="b0_s0")
    noise_N = log.Fz_N[touching] - forces(skin, np.repeat([0.6e-3, 1.2e-3] * 2, 65))
    assert noise_N.std() == pytest.approx(0.006, rel=0.2)  # four times the sampling error of 260 draws
    assert np.abs(np.concatenate([noise_N, log.Fz_N[~touching], log.Fx_N, log.Fy_N])).max() < 6 * 0.006


def test_passes_repeat_the_field_and_differ_by_noise():
    b_uT = shaped(record())
    differences = (b_uT[:130] - b_uT[130:]) / np.sqrt(2)
    np.testing.assert_allclose(differences.std(axis=(0, 1, 2)), (3.3, 3.3, 5.0), rtol=0.05)  # 7000 draws: 0.8 %


def test_the_same_seed_gives_the_same_bytes_and_another_seed_another_skin(capture):
    assert same(capture, record())
    assert not same(capture, record(seed=2))


def test_more_boards_and_skins_leave_the_others_as_they_are(capture):
    more = parameters(boards_n=3, skins_per_board_n=5)
    assert set(roster(parameters())) < set(roster(more))
    assert same(capture, record(more))


def test_each_board_appears_with_its_own_skins():
    six_by_three = roster(parameters(boards_n=6, skins_per_board_n=3))
    assert len(six_by_three) == len({skin for _, skin in six_by_three}) == 18
    assert len({board for board, _ in six_by_three}) == 6


def test_two_skins_on_one_board_share_its_chips_but_not_their_response(capture):
    other = record(skin="b0_s1")
    assert not np.allclose(shaped(capture)[0, 0], shaped(other)[0, 0], atol=20)  # six times the noise


def test_a_skin_without_magnetisation_reads_offset_and_noise_only():
    b_uT = shaped(record(parameters("skin", saturation_T=0.0)))
    np.testing.assert_allclose(b_uT.std(axis=(0, 1)), np.tile([3.3, 3.3, 5.0], (5, 1)), rtol=0.1)


@pytest.mark.parametrize(("section", "name"), [("recording", "rate"), ("skin", "stickiness"), ("spreads", "chip_gian")])
def test_an_unknown_parameter_is_refused_by_name(section, name):
    with pytest.raises(ParamsError, match=name):
        parameters(section, **{name: 1.0})


def test_a_depth_that_the_skin_cannot_take_is_refused():
    with pytest.raises(ParamsError, match="depth must be"):
        record(parameters("recording", depths_mm=(1.8,)))

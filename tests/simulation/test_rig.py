"""Tests of the simulated rig: its timeline, clocks, chunks of bytes and dwells, and the noise and range of its force
sensor.
"""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from reskin.data.grid import SKIN_MM
from reskin.seeds import rng_for
from reskin.simulation.protocols import Drag, Grid
from reskin.simulation.rig import (
    FORCE_RANGE_N,
    Rig,
    actual_positions,
    draw_arrivals,
    draw_clock,
    probe_log,
    read_force,
    timeline,
)
from tests.simulation.scene import SECTIONS

SHARED = {"boards": "rigid", "skins_n": 1, "terms": ()}


def rig(**changes):
    return Rig(**(SECTIONS["rig"] | changes))


def plan(protocol=None):
    protocol = protocol or Grid(kind="grid", passes_n=1, depths_mm=(0.6, 1.2), **SHARED)
    return protocol.plan(rng_for(0, "plan"), SKIN_MM)


DRAG = Drag(kind="drag", passes_n=1, depths_mm=(1.0,), step_mm=4.0, **SHARED)


def test_timeline_of_an_indentation_is_rest_approach_contact_and_retraction():
    frames = timeline(rig(), 1)
    np.testing.assert_allclose(frames.share, [0] * 5 + [1 / 3, 2 / 3] + [1] * 4 + [2 / 3, 1 / 3])
    assert frames.noload_i == 1
    assert frames.contact_i.tolist() == [8]
    assert not frames.stop_i.any()


@given(st.integers(1, 7), st.floats(0, 0.01), st.integers(0, 1000))
def test_chunks_contain_every_frame_once_and_never_arrive_early(chunk_frames_max_n, jitter_s, seed):
    frame_s = (1 + np.arange(500)) / 400.0
    settings_of_rig = rig(chunk_frames_max_n=chunk_frames_max_n, arrival_jitter_s=jitter_s)
    arrived_n, arrived_s = draw_arrivals(frame_s, settings_of_rig, rng_for(seed, "chunks"))
    assert (arrived_n[0], arrived_n[-1]) == (0, 500)
    sizes = np.diff(arrived_n)
    assert sizes.min() >= 1
    assert sizes.max() <= chunk_frames_max_n
    assert (np.diff(arrived_s) >= 0).all()
    assert (arrived_s >= arrived_n / 400.0).all()


@pytest.mark.parametrize("protocol", [None, DRAG])
def test_dwells_in_the_log_contain_the_frames_of_their_stops(protocol):
    settings_of_rig, one = rig(), plan(protocol)
    stops_n = one.x_mm.shape[1]
    frames = timeline(settings_of_rig, stops_n)
    offset_s, rate = clock = draw_clock(settings_of_rig, rng_for(1, "clock"))
    log = probe_log(one, np.zeros((len(one), 1 + stops_n, 3)), settings_of_rig, clock)
    assert abs(offset_s) > 0.01
    assert 0 < abs(rate - 1) < 5e-4
    frame_s = (1 + np.arange(len(one) * len(frames))) / settings_of_rig.rate_hz
    first_i, after_i = (np.searchsorted(frame_s, (t_s - offset_s) / rate) for t_s in (log.t_start_s, log.t_end_s))
    begins = np.arange(len(one))[:, None] * len(frames) + np.append(frames.noload_i, frames.contact_i)
    np.testing.assert_array_equal(first_i, begins.ravel())
    np.testing.assert_array_equal(after_i - first_i, np.tile([4] + [3] * stops_n, len(one)))
    np.testing.assert_array_equal(log.contact, np.tile([False] + [True] * stops_n, len(one)))


def test_position_errors_of_the_robot_have_the_given_standard_deviations():
    grid, line = plan(), plan(DRAG)
    exact_mm = actual_positions(grid, rig(), rng_for(0, "robot"))
    np.testing.assert_array_equal(exact_mm[:, 0], np.hstack([grid.x_mm, grid.y_mm, grid.depth_mm]))
    loose = rig(robot_place_sd_mm=0.1, robot_depth_sd_mm=0.02)
    missed_mm = actual_positions(grid, loose, rng_for(0, "robot")) - exact_mm
    # The tolerance of 25 % is four standard errors, which are 6 % each for 130 draws.
    np.testing.assert_allclose(missed_mm.std(axis=(0, 1)), [0.1, 0.1, 0.02], rtol=0.25)
    planned_mm = np.stack([line.x_mm, line.y_mm, line.depth_mm], axis=2)
    along_mm = actual_positions(line, loose, rng_for(0, "robot")) - planned_mm
    np.testing.assert_allclose(along_mm, np.repeat(along_mm[:, :1], 5, axis=1))


inside_N = st.tuples(st.floats(-25, 25), st.floats(-25, 25), st.floats(-35, 35))


def read_clipped(force_N, noise_N=0.0):
    return read_force(np.atleast_2d(np.asarray(force_N, float)), noise_N=noise_N, rng=rng_for(0, "force"))


@given(inside_N)
def test_force_sensor_without_noise_reads_the_true_force_within_its_range(force_N):
    read_N, clipped_n = read_clipped(force_N)
    np.testing.assert_array_equal(read_N[0], np.float32(force_N))
    assert clipped_n == 0


def test_forces_beyond_the_range_of_the_sensor_are_clipped_and_counted():
    read_N, clipped_n = read_clipped([[25.1, 0, 0], [0, -1e4, 1e4], [0, 0, -36], [0, 0, 34.9]])
    np.testing.assert_array_equal(read_N, np.float32([[25, 0, 0], [0, -25, 35], [0, 0, -35], [0, 0, 34.9]]))
    assert clipped_n == 4


def test_noise_of_the_force_sensor_has_the_given_standard_deviation():
    read_N, clipped_n = read_clipped(np.zeros((40_000, 3)), noise_N=1 / 160)
    # The tolerance is four standard errors, 1 / sqrt(2 n) each.
    np.testing.assert_allclose(read_N.std(axis=0), 1 / 160, rtol=0.02)
    assert clipped_n == 0
    read_N, clipped_n = read_clipped(np.tile(FORCE_RANGE_N, (1000, 1)), noise_N=1 / 160)
    assert (read_N <= np.float32(FORCE_RANGE_N)).all()
    assert 1400 < clipped_n < 1600  # The expected number is half of 3000. The limits are 3.7 standard deviations.

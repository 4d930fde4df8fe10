"""Tests of the description of captures, on synthetic readings with known noise, LSB and forces."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.description import describe, over_skins, rank
from reskin.schema import Readings
from reskin.seeds import rng_for

INDENTATIONS_N, READINGS_N = 400, 5
REST_uT = np.array([300.0, -400.0, 0.0, 1000.0, 0.0, -2500.0], np.float32)


def example_readings(*, uT_per_N=100.0, noise_uT=(3.0, 5.0), force_N=2.0, places=True, known_force=True):
    """Return readings of two chips. The field changes of the second chip are a quarter of those of the first."""
    rng, readings_n = rng_for(0, "made"), INDENTATIONS_N * READINGS_N
    forces_N = force_N * np.repeat(rng.uniform(0.9, 1.1, INDENTATIONS_N), READINGS_N)
    shape = np.array([0, 0, 4.0, 0, 0, 1.0]) / np.sqrt(17)
    sd_uT = np.tile([noise_uT[0], noise_uT[0], noise_uT[1]], 2)
    b_uT = REST_uT + uT_per_N * forces_N[:, None] * shape + sd_uT * rng.standard_normal((readings_n, 6))
    steps_uT = np.tile([0.2, 0.2, 0.3227], 2)
    ones, index = np.ones(readings_n, np.float32), np.arange(readings_n, dtype=np.int32)
    return Readings(
        "c", "b", "s", "simulated", index // READINGS_N, 0 * index, index % READINGS_N,
        ones if places else np.nan * ones, ones if places else np.nan * ones, ones, 0 * ones, 0 * ones,
        (forces_N if known_force else np.nan * ones).astype(np.float32),
        (np.rint(b_uT / steps_uT) * steps_uT).astype(np.float32), np.tile(REST_uT, (readings_n, 1)),
        np.ones((readings_n, 2), np.float32),
        index / 400.0, index // READINGS_N,
    )  # fmt: skip


def test_description_recovers_the_fields_noise_steps_and_forces_of_synthetic_readings():
    found = describe(example_readings())
    assert found["field_at_rest_chip_median_uT"] == pytest.approx((500 + np.hypot(1000, 2500)) / 2)
    assert found["field_at_rest_channel_max_uT"] == 2500
    # The noise has 1600 degrees of freedom, so its standard error is 2 %.
    assert found["noise_xy_uT"] == pytest.approx(3.0, rel=0.05)
    assert found["noise_z_uT"] == pytest.approx(5.0, rel=0.05)
    assert found["step_xy_uT"] == pytest.approx(0.2, rel=1e-3)
    assert found["step_z_uT"] == pytest.approx(0.3227, rel=1e-3)
    assert found["force_median_N"] == pytest.approx(2.0, rel=0.02)
    assert found["change_at_2_N_uT"] == pytest.approx(200, rel=0.02)
    assert found["weakest_over_strongest_chip"] == pytest.approx(0.25, rel=0.1)
    assert found["rate_hz"] == pytest.approx(400.0)


def test_changes_of_a_random_walk_at_rest_grow_with_the_root_of_the_number_of_contacts():
    without_walk = example_readings()
    steps_uT = 0.5 * rng_for(0, "walk").standard_normal((INDENTATIONS_N, 6))
    drifting = replace(
        without_walk, noload_uT=REST_uT + np.repeat(np.cumsum(steps_uT, axis=0), READINGS_N, axis=0).astype(np.float32)
    )
    found = describe(drifting)
    assert found["rest_changes_in_1_uT"] == pytest.approx(0.5, rel=0.05)
    assert found["rest_changes_in_10_uT"] == pytest.approx(0.5 * np.sqrt(10), rel=0.1)
    # The tolerance is large, because there are only 4 x 6 changes over this number of contacts.
    assert found["rest_changes_in_100_uT"] == pytest.approx(0.5 * 10, rel=0.35)
    assert "rest_changes_in_1000_uT" not in found
    assert describe(without_walk)["rest_changes_in_100_uT"] == 0


def test_motion_between_stops_is_not_counted_as_noise():
    line = example_readings()
    moved = replace(line, indentation=line.indentation // 2, x_mm=(line.indentation % 2).astype(np.float32))
    assert describe(moved)["noise_z_uT"] == describe(line)["noise_z_uT"]


def test_field_is_described_without_forces():
    found = describe(example_readings(known_force=False))
    assert "force_max_N" not in found
    assert "change_at_2_N_uT" not in found
    assert found["noise_z_uT"] == pytest.approx(5.0, rel=0.05)
    assert found["weakest_over_strongest_chip"] == pytest.approx(0.25, rel=0.1)


def test_values_of_the_captures_of_one_skin_are_averaged_first():
    summary = over_skins([("s0", {"a": 1.0}), ("s0", {"a": 3.0}), ("s1", {"a": 4.0, "b": 7.0})])
    assert summary["a"] == {"mean": 3.0, "least": 2.0, "most": 4.0, "sd": pytest.approx(np.sqrt(2)), "n": 2}
    assert summary["b"] == {"mean": 7.0, "least": 7.0, "most": 7.0, "n": 1}


def test_ratio_of_field_changes_at_two_forces_uses_all_captures_of_a_skin():
    summary = over_skins([("s0", {"change_at_1_N_uT": 200.0}), ("s0", {"change_at_3_N_uT": 500.0}), ("s1", {"a": 1.0})])
    assert summary["change_at_3_N_over_1_N"]["mean"] == pytest.approx(2.5)
    assert summary["change_at_3_N_over_1_N"]["n"] == 1


def test_largest_force_of_a_skin_is_the_largest_of_all_its_captures():
    summary = over_skins([("s0", {"force_max_N": 2.0}), ("s0", {"force_max_N": 6.0}), ("s1", {"force_max_N": 3.0})])
    assert summary["force_max_N"]["most"] == 6
    assert summary["force_max_N"]["mean"] == 4.5


def test_rank_numbers_indentations_in_their_order_in_time():
    assert rank(np.array([5, 5, 2, 9, 9])).tolist() == [0, 0, 1, 2, 2]
    assert rank(np.zeros(0, np.int32)).tolist() == []

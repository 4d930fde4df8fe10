"""No-load policies: what is subtracted, told by a loop over rows."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from pipeline.dataset import baseline
from pipeline.schema import Readings
from pipeline.seeds import rng_for


def readings_of(indentation: list[int]) -> Readings:
    """Readings whose no-load field is different in every indentation, and the same within one."""
    number = np.array(indentation, np.int32)
    f = len(number)
    rng = rng_for(0, "baseline")
    noload_uT = rng.normal(0, 100, (1000, 15)).astype(np.float32)[number]
    zero, label = np.zeros(f, np.int32), np.zeros(f, np.float32)
    return Readings(
        "c", "b", "s", "simulated", number, zero, zero, label, label, label, label, label, label,
        b_uT=rng.normal(0, 100, (f, 15)).astype(np.float32), noload_uT=noload_uT,
        temperature_degC=np.zeros((f, 5), np.float32), t_s=np.arange(f, dtype=np.float64), n_contacts=zero,
    )  # fmt: skip


NUMBERS = st.lists(st.integers(0, 999), min_size=1, max_size=60)


@given(indentation=NUMBERS, k=st.integers(1, 70))
def test_every_k_gives_the_field_of_the_last_kth_indentation(indentation: list[int], k: int) -> None:
    readings = readings_of(indentation)
    seen = sorted(set(indentation))
    got_uT = baseline.every(readings, k)
    for row_i, number in enumerate(indentation):
        taken_at = seen[seen.index(number) // k * k]
        np.testing.assert_array_equal(got_uT[row_i], readings.noload_uT[indentation.index(taken_at)])


@given(indentation=NUMBERS)
def test_every_first_is_immediate_and_a_long_interval_is_initial(indentation: list[int]) -> None:
    readings = readings_of(indentation)
    np.testing.assert_array_equal(baseline.every(readings, 1), baseline.immediate(readings))
    np.testing.assert_array_equal(baseline.every(readings, 1000), baseline.initial(readings))
    assert len(np.unique(baseline.initial(readings), axis=0)) == 1


def test_a_policy_leaves_the_readings_as_they_are() -> None:
    readings = readings_of([3, 3, 4])
    baseline.initial(readings)[:] = 0
    assert (readings.noload_uT != 0).any()


def test_the_change_of_field_is_zero_where_nothing_touches() -> None:
    readings = readings_of([0, 0, 1])
    assert not baseline.subtract(readings.noload_uT, baseline.immediate(readings)).any()
    np.testing.assert_array_equal(baseline.subtract(readings.b_uT, 0 * readings.b_uT), readings.b_uT)

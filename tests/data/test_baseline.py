import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from reskin.data.baseline import alike_within_uT, follow_free, free, rank, subtract
from reskin.seeds import rng_for

B_uT, NOLOAD_uT = (rng_for(0, name).normal(0, 500, (5, 15)).astype(np.float32) for name in ("b", "noload"))


def test_field_changes_equal_those_computed_by_nested_loops():
    expected = [[float(B_uT[f, ch] - NOLOAD_uT[f, ch]) for ch in range(15)] for f in range(5)]
    assert subtract(B_uT, NOLOAD_uT).tolist() == expected


@given(st.floats(-3000, 3000, width=32))
def test_field_changes_are_not_affected_by_a_constant_external_field(ambient_uT):
    # The tolerance in uT is rounding: single precision rounds fields of a few thousand uT by about 1e-4 uT.
    shifted = subtract(B_uT + np.float32(ambient_uT), NOLOAD_uT + np.float32(ambient_uT))
    np.testing.assert_allclose(shifted, subtract(B_uT, NOLOAD_uT), atol=2e-3)


def test_rank_numbers_indentations_in_their_order_in_time():
    assert rank(np.array([5, 5, 2, 9, 9])).tolist() == [0, 0, 1, 2, 2]
    assert rank(np.zeros(0, np.int32)).tolist() == []


def make_touches(rows_n: int, touches_n: int = 200, walk_uT: float = 1.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the field, the randomly drifting no-load field and the touch number of each row.

    A touch has `rows_n` rows.
    """
    rng = rng_for(0, "touched")
    rest_uT = np.cumsum(walk_uT * rng.standard_normal((touches_n, 15)), axis=0)
    touch_uT = 60 * rng.standard_normal((touches_n, 15))
    indentation = np.repeat(np.arange(touches_n, dtype=np.int32), rows_n)
    noload_uT = rest_uT[indentation].astype(np.float32)
    return noload_uT + touch_uT[indentation].astype(np.float32), noload_uT, indentation


@pytest.mark.parametrize("rows_n", [1, 4, 50])
def test_no_load_field_estimated_between_touches_follows_the_drift(rows_n):
    b_uT, noload_uT, indentation = make_touches(rows_n)
    within_uT = alike_within_uT(noload_uT[: 20 * rows_n], indentation[: 20 * rows_n])
    assert within_uT == pytest.approx(2.0, rel=0.2)
    off_uT = free(b_uT, noload_uT, indentation, within_uT=within_uT) - noload_uT
    # The estimate is usually less than one touch old, and occasionally one or two touches.
    assert np.sqrt((off_uT**2).mean()) < 0.7
    assert np.sqrt(((noload_uT[0] - noload_uT) ** 2).mean()) > 5


def test_no_load_reading_is_not_replaced_during_a_long_slide():
    b_uT, noload_uT, _ = make_touches(1, walk_uT=0.1)
    sent = [field for pair in zip(noload_uT, b_uT, strict=True) for field in pair]
    slid = [*sent[:100], *(sent[101] + 20 * i for i in range(60)), *sent[100:]]
    zeros = list(follow_free(slid, within_uT=0.5))
    np.testing.assert_array_equal(zeros[159], sent[98])
    np.testing.assert_array_equal(zeros[-1], sent[-2])


def test_no_load_field_estimated_between_touches_does_not_depend_on_later_readings():
    b_uT, noload_uT, indentation = make_touches(2)
    whole, part = (free(b_uT[:n], noload_uT[:n], indentation[:n], within_uT=2.0) for n in (400, 123))
    np.testing.assert_array_equal(whole[:123], part)

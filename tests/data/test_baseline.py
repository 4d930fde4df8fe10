import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from reskin.data.baseline import rank, subtract
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

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from pipeline.dataset.baseline import subtract
from pipeline.seeds import rng_for

B_uT, NOLOAD_uT = (rng_for(0, name).normal(0, 500, (5, 15)).astype(np.float32) for name in ("b", "noload"))


def test_the_change_is_what_two_loops_find():
    expected = [[float(B_uT[f, ch] - NOLOAD_uT[f, ch]) for ch in range(15)] for f in range(5)]
    assert subtract(B_uT, NOLOAD_uT).tolist() == expected


@given(st.floats(-3000, 3000, width=32))
def test_a_field_that_is_always_there_drops_out(ambient_uT):
    # float32 numbers of thousands carry some 1e-4 of rounding each
    shifted = subtract(B_uT + np.float32(ambient_uT), NOLOAD_uT + np.float32(ambient_uT))
    np.testing.assert_allclose(shifted, subtract(B_uT, NOLOAD_uT), atol=2e-3)

"""Tests of the inputs of networks, which are computed from field changes.

Input `raw` is the field change itself. Input `shape` is its direction and the logarithm of its length.
"""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from reskin.models.inputs import VIEW
from reskin.seeds import rng_for

# Tolerance for the components of a direction, which are at most 1: a few roundings in single precision, 6e-8 each.
SHAPE_ATOL = 1e-6
LOG_ATOL = 1e-5  # Tolerance for logarithms, which are at most 17: a few roundings in single precision.


def rows(seed: int = 0, n: int = 20, ch: int = 15) -> np.ndarray:
    """Return field changes of about 120 uT.

    Field changes below a limit, which is far smaller, are not normalised to unit length.
    """
    return rng_for(seed, "rows").normal(3, 30, (n, ch)).astype(np.float32)


def test_input_shape_consists_of_the_direction_and_the_log_length_of_the_field():
    db_uT = rows()
    seen = VIEW["shape"](db_uT)
    assert seen.shape == (20, 16)
    assert seen.dtype == np.float32
    for i in range(len(db_uT)):
        length_uT = math.sqrt(sum(float(value) ** 2 for value in db_uT[i]))
        for channel in range(15):
            assert seen[i, channel] == pytest.approx(float(db_uT[i, channel]) / length_uT, abs=SHAPE_ATOL)
        assert seen[i, 15] == pytest.approx(math.log(length_uT), abs=LOG_ATOL)


@given(st.integers(0, 10_000), st.floats(1, 1e6))
def test_stronger_magnetisation_changes_only_the_log_length(seed, times):
    db_uT = rows(seed)
    seen, stronger = VIEW["shape"](db_uT), VIEW["shape"]((db_uT * times).astype(np.float32))
    np.testing.assert_allclose(stronger[:, :-1], seen[:, :-1], atol=SHAPE_ATOL)
    np.testing.assert_allclose(stronger[:, -1] - seen[:, -1], math.log(times), atol=LOG_ATOL)


@given(st.floats(0, 2.0**100))
def test_input_shape_of_any_field_change_is_finite(length_uT):
    assert np.isfinite(VIEW["shape"](np.array([[length_uT, -length_uT, 0]], np.float32))).all()

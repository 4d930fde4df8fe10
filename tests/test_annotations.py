"""Tests that annotations of arrays are checked while tests run, so that a wrong shape or type is an error."""

import numpy as np
import pytest
from jaxtyping import TypeCheckError

from reskin.board.wire import Frames
from reskin.physics.deformation import rotation_angle
from tests.conftest import CHECKED_N


@pytest.mark.parametrize("wrong", [np.zeros((4, 2, 3)), np.zeros((4, 2, 2), int)], ids=["wrong shape", "wrong dtype"])
def test_array_of_a_wrong_shape_or_dtype_raises_an_error(wrong):
    with pytest.raises(TypeCheckError, match="rotation_angle"):
        rotation_angle(wrong)


def test_arrays_whose_shapes_do_not_match_raise_an_error():
    with pytest.raises(TypeCheckError, match="Frames"):
        Frames(np.zeros((3, 15), "f4"), np.zeros((2, 5), "f4"), np.zeros(3), np.zeros(3, int))


@pytest.mark.parametrize("test_name", ["one test", "the next"])
def test_only_the_first_calls_in_each_test_are_checked(test_name):
    for _ in range(CHECKED_N - 1):
        rotation_angle(np.zeros((4, 2, 2)))
    with pytest.raises(TypeCheckError, match="rotation_angle"):
        rotation_angle(np.zeros((4, 2, 3)))
    rotation_angle(np.zeros((4, 2, 3)))  # After CHECKED_N calls in a test, arrays are no longer checked.

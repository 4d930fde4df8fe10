"""Annotations of arrays are executed: what has another shape or kind than its function says is an error in tests."""

import numpy as np
import pytest
from jaxtyping import TypeCheckError

from reskin.board.wire import Frames
from reskin.physics.deformation import rotation_angle
from tests.conftest import CHECKED_N


@pytest.mark.parametrize("wrong", [np.zeros((4, 2, 3)), np.zeros((4, 2, 2), int)], ids=["shape", "kind"])
def test_an_array_that_a_function_does_not_take_is_an_error(wrong):
    with pytest.raises(TypeCheckError, match="rotation_angle"):
        rotation_angle(wrong)


def test_arrays_that_do_not_fit_each_other_are_an_error():
    with pytest.raises(TypeCheckError, match="Frames"):
        Frames(np.zeros((3, 15), "f4"), np.zeros((2, 5), "f4"), np.zeros(3), np.zeros(3, int))


@pytest.mark.parametrize("of", ["one test", "the next"])
def test_calls_are_counted_from_the_beginning_of_each_test(of):
    for _ in range(CHECKED_N - 1):
        rotation_angle(np.zeros((4, 2, 2)))
    with pytest.raises(TypeCheckError, match="rotation_angle"):
        rotation_angle(np.zeros((4, 2, 3)))
    rotation_angle(np.zeros((4, 2, 3)))  # no more are checked

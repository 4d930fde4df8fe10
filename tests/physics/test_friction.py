"""Tests of friction under a dragged tip, whose force is Q = min(k s, mu F).

The tip sticks to the skin, which acts as a spring of stiffness k, until the force reaches the limit mu F. The tests
check the energy, Coulomb's limit, and paths that are subdivided or rotated.
"""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from reskin.errors import ParamsError
from reskin.physics.shear import drag_force

ROUNDING = 1e-12  # This is the relative rounding error of some hundred steps in double precision.
K = 1000.0  # The stiffness of the spring in N/m is of the same order as that of the skin.
paths_m = st.integers(2, 40).flatmap(lambda t: arrays(float, (t, 2), elements=st.floats(-1e-2, 1e-2)))
frictions = st.floats(0, 2)


def drag(path_m, normal_N, stiffness_N_per_m, mu):
    """Drag a tip over a layer with the same stiffness along x and y: one number, or one number for each place."""
    matrices = np.where(np.eye(2) > 0, np.broadcast_to(stiffness_N_per_m, len(path_m))[:, None, None], 0.0)
    return drag_force(path_m, normal_N, stiffness_N_per_m=matrices, friction=mu)


def constant_force_N(path_m, force_N=1.0):
    return np.full(len(path_m), force_N)


def slipped_m(path_m, found):
    return np.diff(path_m, axis=0) - np.diff(found.elastic_m, axis=0)


@given(st.floats(1e-6, 1e-2), st.floats(1e-3, 5), st.floats(1e-3, 2), st.floats(0, 5e3), st.integers(1, 50))
def test_force_of_a_straight_drag_is_the_smaller_of_spring_force_and_friction(end_m, normal_N, mu, stiffness, steps_n):
    path_m = np.column_stack([np.linspace(0, end_m, steps_n + 1), np.zeros(steps_n + 1)])
    found = drag(path_m, constant_force_N(path_m, normal_N), stiffness, mu)
    truth_N = np.minimum(stiffness * path_m[:, 0], mu * normal_N)
    np.testing.assert_allclose(found.force_N[:, 0], truth_N, atol=ROUNDING * mu * normal_N)


@given(paths_m)
def test_tip_with_infinite_friction_acts_as_a_spring(path_m):
    found = drag(path_m, constant_force_N(path_m), K, 1e6)
    np.testing.assert_allclose(found.force_N, K * (path_m - path_m[0]), atol=ROUNDING * K * 1e-2)
    assert not found.sliding.any()


@given(paths_m, frictions, st.data())
def test_tangential_force_is_never_above_the_friction_limit(path_m, mu, data):
    t = len(path_m)
    normal_N = data.draw(arrays(float, t, elements=st.floats(0, 5)))
    stiffness = data.draw(arrays(float, t, elements=st.floats(0, 5e3)))
    found = drag(path_m, normal_N, stiffness, mu)
    size_N = np.hypot(*found.force_N.T)
    # The absolute tolerance is for subnormal numbers, which have fewer digits.
    assert (size_N <= mu * normal_N * (1 + ROUNDING) + 1e-300).all()
    np.testing.assert_allclose(size_N[found.sliding], (mu * normal_N)[found.sliding], rtol=ROUNDING, atol=1e-300)
    np.testing.assert_allclose(found.force_N, stiffness[:, None] * found.elastic_m, rtol=ROUNDING, atol=1e-300)


def test_loop_dissipates_friction_force_times_sliding_length():
    reach_m, mu, steps_n = 3e-3, 0.8, 300
    # The spring's greatest length of 0.8 mm is a whole number of steps of 10 um. Therefore sticking changes to sliding
    # exactly at the end of a step.
    stuck_m = mu * 1.0 / K
    along_m = np.concatenate(
        [np.linspace(a, b, n + 1)[:-1] * reach_m for a, b, n in ((0, 1, steps_n), *[(1, -1, 600), (-1, 1, 600)] * 2)]
    )
    path_m = np.append(along_m, reach_m)[:, None] * [0.8, 0.6]
    found = drag(path_m, constant_force_N(path_m), K, mu)
    work_J = ((found.force_N[1:] + found.force_N[:-1]) / 2 * np.diff(path_m, axis=0)).sum(axis=1)
    loop_J = work_J[-1200:].sum()
    # A loop has a length of 4 reaches. At each of the two reversals, the tip sticks while the spring changes from one
    # greatest length to the opposite one. On the rest of the loop, it slides. Tolerance: rounding of sums over 1200
    # straight pieces.
    assert loop_J == pytest.approx(mu * 1.0 * (4 * reach_m - 4 * stuck_m), rel=1e-9)
    slid_m = np.hypot(*slipped_m(path_m, found)[-1200:].T).sum()
    assert slid_m == pytest.approx(4 * reach_m - 4 * stuck_m, rel=1e-9)
    # If the tip starts at rest, the work equals the dissipated energy plus the energy that is stored in the spring.
    all_slid_m = np.hypot(*slipped_m(path_m, found).T).sum()
    assert work_J.sum() == pytest.approx(mu * 1.0 * all_slid_m + K * stuck_m**2 / 2, rel=1e-9)


def test_lifting_the_tip_relaxes_the_spring():
    path_m = np.array([[0.0, 0.0], [0.5e-3, 0.0], [5e-3, 0.0], [9e-3, 1e-3], [9.1e-3, 1e-3]])
    found = drag(path_m, np.array([1.0, 1.0, 0.0, 1.0, 1.0]), K, 0.8)
    np.testing.assert_allclose(found.force_N, [[0, 0], [0.5, 0], [0, 0], [0, 0], [0.1, 0]], atol=1e-12)
    assert not found.force_N[2:4].any()
    assert not found.sliding.any()


@pytest.mark.parametrize(
    ("what", "of"),
    [
        ("every place of the tip", {"path_m": np.array([[0.0, np.nan], [0.0, 0.0]])}),
        ("every place of the tip", {"path_m": np.array([[0.0, 0.0], [np.inf, 0.0]])}),
        ("normal force", {"normal_N": np.array([1.0, -1e-9])}),
        ("normal force", {"normal_N": np.array([np.nan, 1.0])}),
        ("stiffness", {"stiffness_N_per_m": -1.0}),
        ("stiffness", {"stiffness_N_per_m": np.array([K, np.inf])}),
        ("friction", {"mu": -0.1}),
        ("friction", {"mu": np.nan}),
        ("friction", {"mu": np.inf}),
    ],
)
def test_invalid_drags_are_refused(what, of):
    fine = {"path_m": np.zeros((2, 2)), "normal_N": np.ones(2), "stiffness_N_per_m": K, "mu": 0.8}
    with pytest.raises(ParamsError, match=f"drag: {what} must be"):
        drag(**(fine | of))

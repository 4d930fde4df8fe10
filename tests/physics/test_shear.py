"""Tests of the shear of the skin under a dragged tip.

References are 50-digit arithmetic, a boundary value problem and published solutions.
"""

import mpmath
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.linalg import polar
from scipy.special import jv

from pipeline.experiments.extremes import physics as laws
from reskin.errors import ParamsError
from reskin.physics import layer, shear
from reskin.physics.shear import Traction
from tests.laws import LIMITS

H_M, TIP_M, YOUNG_PA = 2e-3, 3e-3, 190e3
SKIN = {"thickness_m": H_M, "tip_radius_m": TIP_M, "base": "bonded"}
DEPTHS_M = np.arange(1, 7) * 0.2e-3


def of_shape(chi, radius_m):
    """Return a traction on a contact of radius a, given by the function chi.

    The two-dimensional Fourier transform of the traction is the integral of chi(x / a) cos(k x) dx.
    """
    weights = layer.CONTACT_W * chi(layer.CONTACT_X)
    return Traction(radius_m, radius_m * layer.CONTACT_X, weights / weights.sum())


def hertzian(radius_m=1.5e-3):
    """Return the traction q = 3 Q / (2 pi a^2) sqrt(1 - r^2 / a^2) for Q = 1.

    Its Fourier transform is 3 (sin ka - ka cos ka) / (ka)^3.
    """
    return of_shape(lambda x: 1 - x**2, radius_m)


def sliding(depth_m=0.6e-3):
    return shear.slip_traction(layer.contact_of_depth(depth_m, **SKIN))


def displacement_m(traction, places_m, thickness_m=H_M):
    """Return the displacement in m at the given places for Q / G = 1 m^2 (Q: force along x, G: shear modulus)."""
    found = []
    for x, y, z in np.atleast_2d(places_m):
        r, f = np.hypot(x, y), np.arctan2(y, x)
        a, b, c = shear.evaluate_map(traction, np.array([r]), np.array([z]), thickness_m=thickness_m)[0, 0, :3]
        found.append([a + b * np.cos(2 * f), b * np.sin(2 * f), c * np.cos(f)])
    return np.array(found)


def gradients(traction, places_m, step_m=2e-6):
    """Return the displacement gradient u_i,j by central differences, with a relative error of at most 3e-4.

    The error is largest for the shortest wavelength, 0.3 mm.
    """
    steps = step_m * np.eye(3)
    pairs = [(displacement_m(traction, places_m + e) - displacement_m(traction, places_m - e)) for e in steps]
    return np.stack(pairs, axis=-1) / (2 * step_m)


def random_places_m(places_n=40, top=0.95):
    rng = np.random.default_rng(5)
    r_m, f = 4e-3 * np.sqrt(rng.uniform(0, 1, places_n)), rng.uniform(0, 2 * np.pi, places_n)
    return np.stack([r_m * np.cos(f), r_m * np.sin(f), H_M * rng.uniform(0.05, top, places_n)], axis=1)


def displace(
    force_N, nodes_m, table=None, centre_m=(0.3e-3, -0.2e-3), modulus_Pa=YOUNG_PA, by=shear.shear_displacement
):
    table = shear.tabulate_depth(0.6e-3, **SKIN) if table is None else table
    force_N, centre_m = np.asarray(force_N, dtype=float), np.asarray(centre_m, dtype=float)
    return by(table, nodes_m, centre_m, force_N=force_N, modulus_Pa=modulus_Pa)


@given(st.floats(0.01, 200), st.floats(0, 1))
def test_response_of_the_layer_to_a_wave_equals_50_digit_arithmetic(kh, share):
    with mpmath.workdps(250):
        a, z = mpmath.mpf(kh), mpmath.mpf(kh * share)
        size = mpmath.cosh(a) ** 2 + a**2

        def w(x):
            return (a * x * mpmath.cosh(a - x) - (a - x) * mpmath.cosh(a) * mpmath.sinh(x)) / size

        second = mpmath.diff(w, z, 2)
        truth = [
            w(z),
            mpmath.diff(w, z),
            second - w(z),
            mpmath.sinh(z) / mpmath.cosh(a),
            mpmath.cosh(z) / mpmath.cosh(a),
        ]
    found = shear.wave_response(np.array([[kh * share]]), np.array([kh]))
    found = [found.w, found.w_slope, found.w_spin, found.v, found.v_slope]
    # The tolerance is relative to a traction of 1. Rounding of kz adds 1e-16 kh to the exponents.
    np.testing.assert_allclose([part[0, 0] for part in found], [float(part) for part in truth], atol=1e-13)


@pytest.mark.parametrize("radius_m", [0.6e-3, 1.5e-3])
def test_surface_displacement_equals_johnsons_half_space_minus_the_effect_of_the_base(radius_m):
    traction, r_m = hertzian(radius_m), np.linspace(0, radius_m, 12)
    found = shear.evaluate_map(traction, r_m, np.array([H_M]), thickness_m=H_M)[:, 0, :2].T
    # Johnson, Contact Mechanics (1985), equation 3.91 for Poisson's ratio 1/2: u_x = pi q0 / 32 G a (6 a^2 - 2.5 x^2 -
    # 3.5 y^2), u_y = pi q0 / 32 G a x y
    free = 3 / (64 * radius_m**3) * np.stack([6 * radius_m**2 - 3 * r_m**2, r_m**2 / 2])

    def held(k, r, order):
        ka, kh = k * radius_m, k * H_M
        slope, across = (kh + np.sinh(kh) * np.cosh(kh)) / (np.cosh(kh) ** 2 + kh**2), np.tanh(kh)
        missing = 3 - 2 * across - slope if order == 0 else 1 - 2 * across + slope
        return 3 * (np.sin(ka) - ka * np.cos(ka)) / ka**3 * missing * jv(order, k * r) / (8 * np.pi)

    base = [[quad(held, 1e-3, 25 / H_M, args=(r, order), limit=200)[0] for r in r_m] for order in (0, 2)]
    # The tolerance is 1 % of the displacement in the middle, because waves shorter than 0.3 mm are omitted.
    np.testing.assert_allclose(found, free - np.array(base), atol=0.01 * found[0, 0])


def test_shear_stress_at_the_surface_equals_the_traction():
    traction, step_m = hertzian(), 4e-6
    r_m, f = np.linspace(0, 0.9, 10) * traction.radius_m, np.linspace(0, 3, 10)
    places_m = np.stack([r_m * np.cos(f), r_m * np.sin(f), np.full(10, H_M)], axis=1)
    top, below, deeper = (displacement_m(traction, places_m - [0, 0, n * step_m]) for n in range(3))
    along_z = (3 * top - 4 * below + deeper) / (2 * step_m)
    slope = [
        (displacement_m(traction, places_m + e) - displacement_m(traction, places_m - e))[:, 2] / (2 * step_m)
        for e in step_m * np.eye(3)[:2]
    ]
    q_per_m2 = 1.5 / np.pi / traction.radius_m**2 * np.sqrt(1 - (r_m / traction.radius_m) ** 2)
    # The tolerance is 2 % of the peak, because waves shorter than 0.3 mm are omitted.
    np.testing.assert_allclose(along_z[:, 0] + slope[0], q_per_m2, atol=0.02 * q_per_m2[0])
    np.testing.assert_allclose(along_z[:, 1] + slope[1], 0, atol=0.02 * q_per_m2[0])


def test_volume_is_conserved_and_rotation_is_half_the_curl():
    traction, places_m = sliding(), random_places_m()
    grad = gradients(traction, places_m)
    size = np.abs(grad).max()
    # The tolerance is the error of central differences.
    np.testing.assert_allclose(np.trace(grad, axis1=1, axis2=2), 0, atol=1e-5 * size)
    truth = np.stack(
        [grad[:, 2, 1] - grad[:, 1, 2], grad[:, 0, 2] - grad[:, 2, 0], grad[:, 1, 0] - grad[:, 0, 1]], axis=1
    )
    table = shear.tabulate(traction, H_M, traction.radius_m + 5 * H_M)
    found = displace([YOUNG_PA / 3, 0], places_m, table, centre_m=(0, 0)).half_curl
    # The tolerance is the error of central differences and of the table.
    np.testing.assert_allclose(found, truth / 2, atol=2e-3 * size)


@pytest.mark.parametrize("force", [(1.0, 0.0), (-0.6, 0.8)])
def test_tabulated_displacement_equals_direct_integration(force):
    traction, places_m = sliding(), random_places_m(top=1.0)
    found = displace(
        np.array(force) * YOUNG_PA / 3,
        places_m,
        shear.tabulate(traction, H_M, traction.radius_m + 5 * H_M),
        centre_m=(0, 0),
    )
    turn = np.array([[force[0], -force[1], 0], [force[1], force[0], 0], [0, 0, 1]])
    truth_m = displacement_m(traction, places_m @ turn) @ turn.T
    # The tolerance is the error of interpolation between places of the table, which are 25 um apart.
    np.testing.assert_allclose(found.displacement_m, truth_m, atol=1e-3 * np.abs(truth_m).max())


@pytest.mark.parametrize("radius_m", [0.05e-3, 0.3e-3])
def test_stiffness_on_thick_layers_equals_mindlins_formula(radius_m):
    assert laws.sticking(radius_m) <= LIMITS["sticking"]
    assert laws.sliding(radius_m, TIP_M, "bonded") <= LIMITS["sliding"]
    # u is the mean displacement, weighted by the traction q ~ sqrt(a^2 - r^2). The mean of 6 a^2 - 3 r^2 is 24/5 a^2,
    # so u = pi q0 a / 32 G * 24/5 = 9 Q / 40 G a.
    assert shear.tangential_stiffness_m(hertzian(radius_m), 100.0) == pytest.approx(40 / 9 * radius_m, rel=1e-4)


def test_sticking_contact_moves_rigidly():
    for a_h in (0.5, 1.0, 2.0):
        traction = shear.stick_traction(a_h * H_M, H_M)
        parts = shear.evaluate_map(traction, np.linspace(0, 0.8, 9) * a_h * H_M, np.array([H_M]), thickness_m=H_M)[
            :, 0, :2
        ].T
        mean_per_m = 1 / shear.tangential_stiffness_m(traction, H_M)
        # At the edge, the traction is infinite, which waves of 0.3 mm do not resolve. Therefore only the inner part is
        # compared.
        np.testing.assert_allclose(parts[0], mean_per_m, rtol=0.03)
        # The tolerance is the error of assuming that the traction is axisymmetric.
        assert np.abs(parts[1]).max() < 0.05 * mean_per_m


def test_sliding_contact_is_19_to_20_percent_softer_than_a_sticking_one():
    tractions = [sliding(float(depth_m)) for depth_m in DEPTHS_M]
    ratio = [
        shear.tangential_stiffness_m(t, H_M) / shear.tangential_stiffness_m(shear.stick_traction(t.radius_m, H_M), H_M)
        for t in tractions
    ]
    np.testing.assert_allclose(ratio, 0.803, atol=0.008)


# Hypothesis tries fewer examples than usual, because each example computes a table, which takes 20 ms.


# The absolute tolerance is for numbers below 1e-150, whose squares lose digits.
@given(st.floats(-20, 20).filter(lambda amount: amount == 0 or abs(amount) > 1e-150), st.floats(-np.pi, np.pi))
def test_rotation_in_simple_shear_equals_that_of_the_polar_decomposition(amount, towards_rad):
    ahead = np.array([np.cos(towards_rad), np.sin(towards_rad), 0.0])
    truth, _ = polar(np.eye(3) + amount * np.outer(ahead, [0, 0, 1]))
    half_curl = amount / 2 * np.array([[-ahead[1], ahead[0], 0]])
    angle_rad, axis = shear.rotation_from_curl(half_curl)
    x, y, z = axis[0]
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    found = np.eye(3) + np.sin(angle_rad) * cross + (1 - np.cos(angle_rad)) * cross @ cross
    np.testing.assert_allclose(found, truth, atol=1e-13)
    assert np.linalg.norm(axis) == pytest.approx(1)


def shear_in_many_steps(force_N, nodes_m, table, steps_n):
    """Return a reference: the nodes after the force has been applied in many small steps.

    Each step moves the nodes and the traction. The contact starts at 0.
    """
    at_m, ahead_m = nodes_m, np.array(force_N) * 3 / YOUNG_PA / table.stiffness_m
    for step_i in range(steps_n):
        centre_m = ahead_m * (step_i + 0.5) / steps_n
        half_m = at_m + displace(np.array(force_N) / steps_n, at_m, table, centre_m).displacement_m / 2
        at_m = at_m + displace(np.array(force_N) / steps_n, half_m, table, centre_m).displacement_m
    return at_m - nodes_m


def test_midpoint_steps_equal_many_small_steps_of_force():
    nodes_m, over = [0.5, 0.5, 1] * random_places_m(200), []
    # The friction coefficients are 0.8, 0.4 and 0.8. For them, the code takes 1, 1 and 2 midpoint steps.
    for depth_m, force_N in ((0.6e-3, 0.59), (0.6e-3, 0.59 / 2), (1.2e-3, 2.40)):
        table = shear.tabulate_depth(depth_m, **SKIN)
        truth_m = shear_in_many_steps([force_N, 0], nodes_m, table, 48)
        found_m, one_shot_m = (
            displace([force_N, 0], nodes_m, table, (0, 0), by=by).displacement_m
            for by in (shear.shear_in_steps, shear.shear_displacement)
        )
        over.append(np.abs(found_m - truth_m).max() / np.abs(truth_m).max())
        assert over[-1] < np.abs(one_shot_m - truth_m).max() / np.abs(truth_m).max() / 5
    assert over[0] < 0.02
    assert over[2] < 0.05
    # A second-order method would reduce the error to a quarter. The factor is smaller, because the interpolated table
    # has kinks.
    assert over[1] < over[0] / 3


@pytest.mark.parametrize(
    ("what", "of"),
    [
        ("depth", lambda: shear.tabulate_depth(0.0, **SKIN)),
        ("depth", lambda: shear.tabulate_depth(np.nan, **SKIN)),
        ("depth", lambda: shear.tabulate_depth(2e-3, **SKIN)),
        ("thickness", lambda: shear.tabulate_depth(1e-3, thickness_m=0.0, tip_radius_m=3e-3, base="bonded")),
        ("contact radius", lambda: shear.tabulate(hertzian(6.1e-3), H_M, 10e-3)),
        ("contact radius", lambda: shear.tabulate(hertzian(), np.inf, 10e-3)),
        ("modulus", lambda: displace([1, 0], np.zeros((1, 3)), modulus_Pa=0.0)),
        ("modulus", lambda: displace([1, 0], np.zeros((1, 3)), modulus_Pa=np.nan)),
        ("height of nodes", lambda: displace([1, 0], np.array([[0.0, 0.0, 2.41e-3]]))),
        ("height of nodes", lambda: displace([1, 0], np.array([[0.0, 0.0, -1e-6]]))),
        ("height of nodes", lambda: displace([1, 0], np.array([[0.0, 0.0, np.nan]]))),
        ("half of the curl of the displacement", lambda: displace([3, 0], random_places_m(), by=shear.shear_in_steps)),
        (
            "half of the curl of the displacement",
            lambda: displace([0, np.nan], random_places_m(), by=shear.shear_in_steps),
        ),
        ("modulus", lambda: displace([1, 0], np.zeros((1, 3)), modulus_Pa=0.0, by=shear.shear_in_steps)),
    ],
)
def test_invalid_drags_are_refused(what, of):
    with pytest.raises(ParamsError, match=f"{what} must be"):
        of()

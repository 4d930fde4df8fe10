"""Tests of a bonded elastic layer under a tip against limits, 50-digit arithmetic and experiment extremes."""

from dataclasses import asdict

import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import jv

from pipeline.experiments.extremes import physics as laws
from reskin.errors import ParamsError
from reskin.physics import layer
from reskin.physics.layer import IndentedLayer
from tests.laws import LIMITS

PRESS = IndentedLayer(2e-3, 3e-3, "bonded")
SKIN = asdict(PRESS)
DEPTHS_M = np.arange(1, 7) * 0.2e-3
waves_kh = st.floats(0.01, 30)


def force(depth_m, modulus_Pa=190e3, **changes):
    return layer.force(np.atleast_1d(np.asarray(depth_m, dtype=float)), modulus_Pa=modulus_Pa, **(SKIN | changes))


@settings(max_examples=20, deadline=None)
@given(waves_kh)
def test_compliance_equals_a_50_digit_solution(kh):
    assert laws.compliance(np.array([kh]), "bonded") <= LIMITS["compliance_bonded"]


def test_compliance_has_the_limits_of_long_and_short_waves():
    long, short = (
        layer.bonded_compliance(np.array([0.0, 1e-6, 1e-3])),
        layer.bonded_compliance(np.array([20.0, 1e4, 1e150])),
    )
    # For long waves, the compliance is 2 A^3 / 3 with A = kh. The next term of the series is smaller by the factor A^2.
    np.testing.assert_allclose(long, [0, 2e-18 / 3, 2e-9 / 3], rtol=2e-6)
    np.testing.assert_allclose(short, 1, rtol=1e-13)


@given(st.floats(0.01, 30), st.floats(0, 1))
def test_displacement_divided_by_depth_equals_50_digit_arithmetic(kh, share):
    with mpmath.workdps(50):
        a, z = mpmath.mpf(kh), mpmath.mpf(kh) * mpmath.mpf(share)
        ratio = (mpmath.cosh(a) + a * mpmath.sinh(a)) / (a * mpmath.cosh(a))

        def w(x):
            return ratio * (mpmath.sinh(x) - x * mpmath.cosh(x)) + x * mpmath.sinh(x)

        size = (mpmath.sinh(2 * a) - 2 * a) / (mpmath.cosh(2 * a) + 2 * a**2 + 1) / w(a)
        truth = [float(size * mpmath.diff(w, z, order)) for order in range(3)]
    found = layer._bonded_wave(kh * share, kh, layer._bonded_factors(kh))
    # The tolerance is relative to the value on a half-space, which is 1.
    np.testing.assert_allclose(found, truth, atol=1e-12)


@pytest.mark.parametrize("tip_m", [2e-3, 3e-3, 4e-3])
def test_forces_on_thick_and_thin_layers_equal_published_solutions(tip_m):
    press = IndentedLayer(2e-3, tip_m, "bonded")
    assert laws.hertz(tip_m, "bonded") <= LIMITS["hertz_bonded"]
    assert laws.sneddon(tip_m, "bonded") <= LIMITS["sneddon"]
    assert laws.long_2011(DEPTHS_M, press) <= LIMITS["long_2011"]


def test_force_is_proportional_to_modulus_and_squared_length_and_equals_that_without_interpolation():
    once_N = force(DEPTHS_M, 1.0)
    np.testing.assert_allclose(force(DEPTHS_M, 1e9), 1e9 * once_N, rtol=1e-13)
    larger = {"thickness_m": 3 * PRESS.thickness_m, "tip_radius_m": 3 * PRESS.tip_radius_m}
    np.testing.assert_allclose(force(3 * DEPTHS_M, 1.0, **larger), 9 * once_N, rtol=1e-9)
    exact_N = [4 * np.pi / 3 * PRESS.contact(float(d)).weights_m2.sum() for d in DEPTHS_M]
    # The cubic spline through 48 nodes is not exact between the nodes.
    np.testing.assert_allclose(once_N, exact_N, atol=1e-6 * once_N.max())


@pytest.mark.parametrize("base", ["bonded", "slipping"])
@pytest.mark.parametrize("depth_m", [0.6e-3, 1.2e-3])
def test_small_step_of_depth_conserves_volume_and_follows_the_tip(base, depth_m):
    press = IndentedLayer(2e-3, 3e-3, base)
    contact = press.contact(depth_m)
    waves = layer.waves(contact, 2e-3, base)
    r_m, z_m = (of.ravel() for of in np.meshgrid(np.linspace(0.07e-3, 5e-3, 17), np.linspace(0.06e-3, 1.94e-3, 9)))
    u = layer.displacement(r_m, z_m, waves)
    np.testing.assert_allclose(u.r_r + u.hoop + u.z_z, 0, atol=1e-13)
    top_m = 0.95 * contact.radius_m * np.linspace(0, 1, 30)
    found_m = layer.displacement(top_m, np.full(30, 2e-3), waves).z_m
    # Waves shorter than 1/6 of the thickness are omitted.
    np.testing.assert_allclose(found_m, 3e-3 - np.sqrt(3e-3**2 - top_m**2) - depth_m, atol=0.01 * depth_m)


def test_forces_equal_those_of_the_specification():
    # The specification gives forces with two decimals.
    np.testing.assert_allclose(force(DEPTHS_M), [0.09, 0.33, 0.74, 1.33, 2.08, 3.00], atol=0.006)


def test_force_is_zero_if_the_tip_does_not_touch_or_the_skin_has_no_stiffness():
    assert not force([-1e-3, -1e-12, 0.0]).any()
    assert not force(DEPTHS_M, modulus_Pa=0.0).any()


@pytest.mark.parametrize(
    ("what", "changes"),
    [
        ("thickness", {"thickness_m": 0.0}),
        ("thickness", {"thickness_m": -2e-3}),
        ("thickness", {"thickness_m": np.nan}),
        ("tip radius", {"tip_radius_m": 0.0}),
        ("tip radius", {"tip_radius_m": np.inf}),
        ("modulus", {"modulus_Pa": -1.0}),
        ("modulus", {"modulus_Pa": np.inf}),
        ("depth", {"depth_m": 2e-3}),
        ("depth", {"depth_m": 3e-3, "thickness_m": 5e-3}),
        ("depth", {"depth_m": np.nan}),
        ("depth", {"depth_m": -np.inf}),
    ],
)
def test_invalid_layers_and_pokes_are_refused(what, changes):
    with pytest.raises(ParamsError, match=f"{what} must be"):
        force(**({"depth_m": 1e-3} | changes))


@pytest.mark.parametrize("base", ["bonded", "slipping"])
def test_displacement_equals_the_sum_of_its_waves(base):
    h_m = 2e-3
    waves = layer.waves(layer.contact_of_depth(0.8e-3, thickness_m=h_m, tip_radius_m=3e-3, base=base), h_m, base)
    r_m, z_m = np.array([0.0, 0.4e-3, 2e-3, 40e-3]), np.array([1e-3, 2.1e-3, 0.0, 1.3e-3])
    factors, wave = (getattr(layer, f"_{base}_{name}") for name in ("factors", "wave"))
    profiles = [[wave(k * z, k * h_m, factors(k * h_m)) for k in waves.k_per_m] for z in z_m]
    g, slope, bend = np.moveaxis(profiles, 2, 0)
    zero, one = (jv(order, np.outer(r_m, waves.k_per_m)) for order in (0, 1))
    truth = {
        "r_m": (slope * one) @ waves.amplitude_m, "z_m": -(g * zero) @ waves.amplitude_m,
        "z_z": -(slope * zero) @ (waves.amplitude_m * waves.k_per_m),
        "r_z": (bend * one) @ (waves.amplitude_m * waves.k_per_m),
        "z_r": (g * one) @ (waves.amplitude_m * waves.k_per_m),
    }  # fmt: skip
    found = layer.displacement(r_m, z_m, waves)
    for name, right in truth.items():
        np.testing.assert_allclose(getattr(found, name), right, atol=1e-11 * np.abs(right).max())
    np.testing.assert_allclose(found.r_r + found.hoop + found.z_z, 0.0, atol=1e-11 * np.abs(found.z_z).max())

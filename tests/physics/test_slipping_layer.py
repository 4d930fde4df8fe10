"""Tests of the layer on a slipping base against a dense 50-digit solution, limits, and the bonded layer."""

import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.experiments.extremes import physics as laws
from reskin.physics import layer
from tests.laws import LIMITS

SKIN = {"thickness_m": 2e-3, "tip_radius_m": 3e-3}
waves_kh = st.floats(0.01, 30)


@settings(max_examples=20, deadline=None)
@given(waves_kh, st.floats(0.05, 0.95))
def test_profile_and_compliance_equal_a_50_digit_solution(kh, share):
    with mpmath.workdps(50):
        w, z = laws.profile(mpmath.mpf(kh), "slipping"), mpmath.mpf(kh) * mpmath.mpf(share)
        truth = [float(mpmath.diff(w, z, n)) for n in range(3)]
    found = layer._slipping_wave(kh * share, kh, layer._slipping_factors(kh))
    # The tolerance is 1e-10: for long waves, the profile is a difference of numbers that are larger by the factor 1 /
    # (kh)^2, so digits are lost.
    np.testing.assert_allclose(found, truth, atol=1e-10 * np.abs(truth).max())
    assert laws.compliance(np.array([kh]), "slipping") <= LIMITS["compliance_slipping"]


def test_compliance_has_the_limits_of_long_and_short_waves():
    found = layer.slipping_compliance(np.array([0.0, 1e-6, 1e-3, 20.0, 1e4, 1e150]))
    # Tolerance: the next term of the series is (kh)^3 / 6 or smaller.
    np.testing.assert_allclose(found, [0, 5e-7, 5e-4, 1, 1, 1], rtol=1e-6)


def test_slipping_skin_moves_more_than_a_bonded_skin_far_from_the_tip():
    under = layer.contact_of_depth(0.2e-3, **SKIN, base="slipping")
    r_m, z_m = np.repeat([8e-3, 12e-3], 3), np.tile([0.0, 1e-3, 2e-3], 2)
    far = layer.displacement(r_m, z_m, layer.waves(under, SKIN["thickness_m"], "slipping"))
    volume_m3 = 2 * np.pi * r_m * SKIN["thickness_m"] * far.r_m
    # Volume is conserved, so the displaced volume flows through every circle, uniformly over the thickness. The
    # tolerance of 0.01 allows for waves that have decayed to exp(-pi r / h) at r = 4 h.
    np.testing.assert_allclose(volume_m3, volume_m3.mean(), rtol=0.01)
    assert volume_m3.mean() > 0
    bonded = layer.contact_of_depth(0.2e-3, **SKIN, base="bonded")
    held = layer.displacement(r_m, z_m, layer.waves(bonded, SKIN["thickness_m"], "bonded"))
    # At 1.5 times the distance, the surface of a slipping skin moves 2/3 as far, but the surface of a bonded skin moves
    # less than 1/4 as far.
    assert far.r_m[5] == pytest.approx(far.r_m[2] * 2 / 3, rel=0.01)
    assert held.r_m[5] < held.r_m[2] / 4


def test_skin_on_a_slipping_base_is_1_8_times_softer():
    press = {**SKIN, "modulus_Pa": 190e3}
    held, sliding = (layer.force(np.array([1.2e-3]), **press, base=base) for base in ("bonded", "slipping"))
    assert held / sliding == pytest.approx(1.8, abs=0.05)  # The factor 1.8 is known to two digits.

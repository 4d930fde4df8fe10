"""Tests of the prior for fields from outside the skin, against random dipoles and the laws of magnetostatics."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from reskin.physics import magnet
from reskin.physics.ambient import random_directions
from reskin.physics.external import covariance, suppressor
from reskin.seeds import rng_for
from reskin.universal.layout import paper_layout

CHIPS = paper_layout().chips_mm


def test_covariance_of_external_fields_equals_that_of_random_dipoles():
    rng, n = rng_for(0, "dipoles"), 20_000
    chips_m = 1e-3 * np.column_stack([CHIPS, np.zeros(5)])
    places_m, moments = 0.05 * random_directions(n, rng), rng.standard_normal((n, 3))
    fields = np.stack([
        magnet.field(place_m[None], moment[None], chips_m).ravel()
        for place_m, moment in zip(places_m, moments, strict=True)
    ])  # fmt: skip
    drawn = fields.T @ fields / n
    # The drawn fields are scaled so that the chip at the centre (the first one) has the given variance.
    drawn *= 3 * 100**2 / np.trace(drawn[:3, :3])
    # Tolerance: the standard error of an element is at most sqrt(3 / n) = 1.2 % of the largest, because kurtosis is
    # about 3.
    np.testing.assert_allclose(covariance(CHIPS, 100.0, 50.0), drawn, atol=0.05 * 100**2)


@given(st.floats(1.0, 300.0), st.floats(20.0, 500.0))
def test_field_at_the_centre_has_the_given_standard_deviation(sd_uT, distance_mm):
    at_centre = covariance(CHIPS, sd_uT, distance_mm)[:3, :3]
    # The 150 directions of the dipoles are isotropic to within 1 %.
    np.testing.assert_allclose(at_centre, sd_uT**2 * np.eye(3), atol=0.01 * sd_uT**2)


def test_drawn_fields_have_no_curl():
    """The z component of the curl vanishes: dBy/dx = dBx/dy."""
    fields = rng_for(1, "draws").multivariate_normal(np.zeros(15), covariance(CHIPS, 30.0, 200.0), 50, method="eigh")
    _, left, below, right, above = fields.reshape(50, 5, 3).transpose(1, 0, 2)
    by_dx, bx_dy = (right - left)[:, 1], (above - below)[:, 0]
    # The finite differences neglect third derivatives, which causes a relative error of about 10 (7 mm / 200 mm)^2 = 1
    # %.
    np.testing.assert_allclose(by_dx, bx_dy, atol=0.05 * np.abs(by_dx).max())


@pytest.mark.parametrize("noise_uT", [1.0, 4.0])
def test_suppressor_whitens_the_sum_of_external_field_and_noise(noise_uT):
    """The suppressor is a matrix by which readings are multiplied, so that external fields become small."""
    cov = covariance(CHIPS, 100.0)
    matrix = suppressor(cov, noise_uT)
    total = cov + noise_uT**2 * np.eye(15)
    np.testing.assert_allclose(matrix @ total @ matrix, noise_uT**2 * np.eye(15), atol=1e-8 * 100**2)


def test_suppressor_removes_uniform_fields_and_keeps_fields_with_curl():
    matrix = suppressor(covariance(CHIPS, 100.0), 4.0)
    uniform_uT = np.tile([50.0, -30.0, 80.0], 5)
    assert np.linalg.norm(uniform_uT @ matrix) < 0.05 * np.linalg.norm(uniform_uT)
    curl_uT = np.zeros((5, 3))
    # The field is a vortex around the centre, which no magnet outside the skin can cause.
    curl_uT[:, :2] = 10 * CHIPS @ [[0, 1], [-1, 0]]
    # A part of the vortex is removed, because external fields of high order resemble it.
    assert np.linalg.norm(curl_uT.ravel() @ matrix) > 0.8 * np.linalg.norm(curl_uT)

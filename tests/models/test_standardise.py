"""Tests of scalers, which shift and scale inputs and targets of networks."""

import numpy as np

from reskin.models.inputs import SCALE_FLOOR, fit_released, fit_standard
from reskin.seeds import rng_for


def rows(n: int = 50, ch: int = 6) -> tuple[np.ndarray, np.ndarray]:
    rng = rng_for(0, "rows")
    return rng.normal(3, 40, (n, ch)).astype(np.float32), rng.uniform(0, 16, (n, 3)).astype(np.float32)


def test_scaled_inputs_have_zero_mean_and_unit_standard_deviation():
    db_uT, target = rows()
    scaled = fit_standard(db_uT, target).encode(db_uT).astype(float)
    # Tolerance: numbers of about 3 standard deviations are rounded to single precision.
    np.testing.assert_allclose(scaled.mean(axis=0), 0, atol=1e-5)
    np.testing.assert_allclose(scaled.std(axis=0), 1, atol=1e-5)


def test_scale_of_a_constant_channel_is_the_minimum_scale():
    db_uT, target = rows()
    db_uT[:, 2] = 5.0
    for fit in (fit_standard, fit_released):
        scaler = fit(db_uT, target)
        assert scaler.input_scale[2] == SCALE_FLOOR
        assert np.isfinite(scaler.encode(db_uT)).all()


def test_scaler_is_finite_if_all_forces_are_unknown():
    db_uT, target = rows()
    target[:, 2] = np.nan
    scaler = fit_standard(db_uT, target)
    assert np.isfinite(scaler.decode(np.zeros((1, 3), np.float32))).all()


def test_released_scaling_equals_that_of_the_papers_code():
    db_uT, target = rows()
    scaler = fit_released(db_uT, target)
    # Tolerance: single precision is compared with double precision.
    np.testing.assert_allclose(scaler.input_scale, 5 * db_uT.std(axis=0, dtype=float), rtol=1e-6)
    assert (scaler.input_shift == 0).all()
    assert scaler.encode_target(np.array([[16, 8, 3]], np.float32)).tolist() == [[1.0, 0.5, 1.0]]

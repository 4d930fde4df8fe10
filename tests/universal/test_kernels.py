"""Tests of the compiled loops over hypotheses.

A hypothesis is a place with a force. References are NumPy and, for Gaussian distributions, closed forms.
"""

import numpy as np
import pytest

from reskin.seeds import rng_for
from reskin.universal.kernels import CELL_SD_MM, LANES_N, Lattice, in_blocks, means, products, whiten

AXIS_mm = np.arange(-8, 8.01, 0.4)
AT = Lattice(np.stack(np.meshgrid(AXIS_mm, AXIS_mm, indexing="ij"), axis=-1).reshape(-1, 2), np.log([0.5, 1, 2, 4, 8]))
FIRST_mm, FIRST_SD_mm, LOG_N = np.array([1.0, -2.0]), 1.2, 0.8


def total() -> np.ndarray:
    """Return the deviances of all hypotheses for four readings, as an array [4, hypotheses].

    In this order, the likelihoods are: a Gaussian, a noisy Gaussian that is sharper, a noisy Gaussian, and a nearly
    flat Gaussian.
    """
    of_place = ((AT.place_mm - FIRST_mm) ** 2).sum(axis=1) / FIRST_SD_mm**2
    of_force = (AT.log_N - LOG_N) ** 2 / 0.5
    of_all = (of_place[:, None] + of_force).ravel() + 300.0
    ruffle = rng_for(0, "answers").normal(0, 5, of_all.shape)
    return np.stack([of_all, 6 * (of_all + ruffle), of_all + ruffle, 0.1 * of_all]).astype(np.float32)


def with_best(total: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the deviances, and the index of the most likely hypothesis in each row."""
    return total, total.argmin(axis=1)


def probabilities(power: float) -> np.ndarray:
    found = np.exp(-0.5 * power * (total().astype(float) - total().min(axis=1, keepdims=True)))
    return (found / found.sum(axis=1, keepdims=True)).reshape(4, len(AT.place_mm), -1)


def spread(of_place: np.ndarray, about_mm: np.ndarray) -> np.ndarray:
    var = np.array([p @ (AT.place_mm - m) ** 2 for p, m in zip(of_place, about_mm, strict=True)])
    return np.sqrt(np.maximum(var, CELL_SD_MM**2))


@pytest.mark.parametrize("power", [1.0, 0.3])
def test_compiled_means_equal_sums_over_all_hypotheses(power):
    place_mm, sd_mm, force_N = means(*with_best(total()), AT, power)
    of_place = probabilities(power).sum(axis=2)
    # The tolerance covers hypotheses below e^-25 of the maximum, which the compiled loop omits.
    np.testing.assert_allclose(place_mm, of_place @ AT.place_mm, atol=1e-6)
    np.testing.assert_allclose(sd_mm, spread(of_place, place_mm), atol=1e-6)
    np.testing.assert_allclose(np.log(force_N), probabilities(power).sum(axis=1) @ AT.log_N, atol=1e-6)


@pytest.mark.parametrize("power", [1.0, 0.3])
def test_compiled_product_of_map_and_network_equals_that_of_numpy(power):
    rng = rng_for(1, "answers")
    normals = np.column_stack(
        [rng.normal(0, 3, (4, 2)), rng.uniform(0.5, 2, (4, 2)), rng.normal(0, 1, 4), np.full(4, 0.4)]
    )
    place_mm, sd_mm, force_N, map_log_N = products(*with_best(total()), AT, normals, 0.6, power, 0.3)
    off = (AT.place_mm - normals[:, None, :2]) / normals[:, None, 2:4]
    of_place = probabilities(0.6).sum(axis=2) * np.exp(-0.5 * (off**2).sum(axis=2))
    of_force = probabilities(0.6).sum(axis=1) * np.exp(-0.5 * ((AT.log_N - normals[:, 4:5]) / normals[:, 5:]) ** 2)
    raised = of_place**power
    of_place, of_force, raised = (part / part.sum(axis=1, keepdims=True) for part in (of_place, of_force, raised))
    np.testing.assert_allclose(place_mm, of_place @ AT.place_mm, atol=1e-6)
    np.testing.assert_allclose(sd_mm, spread(raised, place_mm), atol=1e-6)
    np.testing.assert_allclose(np.log(force_N), of_force @ AT.log_N, atol=1e-6)
    of_map = probabilities(0.6).sum(axis=1) ** 0.3
    np.testing.assert_allclose(map_log_N, of_map / of_map.sum(axis=1, keepdims=True) @ AT.log_N, atol=1e-6)


def test_product_of_two_gaussians_has_the_closed_form():
    second_mm, second_sd = np.array([2.5, 0.0]), np.array([1.0, 0.8])
    second = np.concatenate([second_mm, second_sd, np.ones(2)])[None]
    place_mm, sd_mm, *_ = products(*with_best(total()[:1]), AT, second, 1.0, 1.0, 1.0)
    var = 1 / (1 / FIRST_SD_mm**2 + 1 / second_sd**2)
    np.testing.assert_allclose(place_mm[0], var * (FIRST_mm / FIRST_SD_mm**2 + second_mm / second_sd**2), atol=1e-4)
    np.testing.assert_allclose(sd_mm[0], np.sqrt(var), atol=1e-4)


def test_estimate_follows_a_more_certain_network_against_the_map():
    """Each place keeps a minimum probability, so a network that is certain of another place determines the estimate."""
    far = np.full((1, total().shape[1]), 1e4, np.float32)
    far[0, 0] = 0.0
    normals = np.array([[8.0, 8.0, 0.1, 0.1, 1.0, 1.0]])
    place_mm, sd_mm, *_ = products(*with_best(far), AT, normals, 1.0, 1.0, 1.0)
    np.testing.assert_allclose(place_mm, [[8.0, 8.0]], atol=0.05)
    assert np.isfinite(sd_mm).all()


def test_nan_deviances_give_nan_estimates():
    none = np.full((1, total().shape[1]), np.nan, np.float32)
    normals = np.ones((1, 6))
    for found in (means(*with_best(none), AT, 1.0), products(*with_best(none), AT, normals, 1.0, 1.0, 1.0)):
        assert all(np.isnan(part).all() for part in found)


@pytest.mark.parametrize("h", [1, LANES_N, LANES_N + 3])
def test_chi2_is_the_mahalanobis_distance(h):
    rng = rng_for(0, "gaussians", h)
    mean, slope = rng.normal(0, 300, (h, 6)), rng.normal(0, 60, (h, 6, 4))
    number, root = rng.standard_normal(4), np.linalg.cholesky(np.cov(rng.standard_normal((4, 20))))
    residual, share, error_cov = (
        0.1 * rng.standard_normal((h, 6)),
        rng.uniform(0.5, 1, h),
        np.cov(rng.normal(0, 0.1, (6, 20))),
    )
    noise_cov = 20.0 * np.eye(6) + np.cov(rng.normal(0, 30, (6, 20)))
    expected = mean + slope @ number
    length = np.linalg.norm(expected, axis=1, keepdims=True)
    expected, spread = expected + length * residual, slope @ root
    read = expected[0] + rng.normal(0, 50, (5, 6))
    mean, slope, number, root, residual, share, error_cov, noise_cov, read = (
        part.astype(np.float32) for part in (mean, slope, number, root, residual, share, error_cov, noise_cov, read)
    )
    gaussians = whiten(in_blocks(mean, slope), (number, root), residual, share, error_cov, noise_cov)
    chi2, deviance = gaussians.evaluate(read)
    cov = spread @ spread.transpose(0, 2, 1) + (length[:, 0] ** 2 * share)[:, None, None] * error_cov + noise_cov
    off, which = read[:, None] - expected, np.arange(5) % h
    solved = np.stack([np.linalg.solve(cov[j], off[i, j]) for i, j in enumerate(which)])
    np.testing.assert_allclose(gaussians.solve(read, which), solved, rtol=1e-3, atol=1e-5)
    np.testing.assert_allclose(chi2, np.einsum("nhi,hij,nhj->nh", off, np.linalg.inv(cov), off), rtol=1e-4, atol=0.01)
    # The tolerance is that of single precision.
    np.testing.assert_allclose(deviance - chi2, np.tile(np.linalg.slogdet(cov)[1], (5, 1)), atol=1e-3)

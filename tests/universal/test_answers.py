"""Compiled answers are NumPy's sums over all hypotheses; of Gaussians, the closed form."""

import numpy as np
import pytest

from reskin.seeds import rng_for
from reskin.universal.answers import CELL_SD_MM, Lattice, Likelihoods, means, products

AXIS_mm = np.arange(-8, 8.01, 0.4)
AT = Lattice(np.stack(np.meshgrid(AXIS_mm, AXIS_mm, indexing="ij"), axis=-1).reshape(-1, 2), np.log([0.5, 1, 2, 4, 8]))
FIRST_mm, FIRST_SD_mm, LOG_N = np.array([1.0, -2.0]), 1.2, 0.8


def total() -> np.ndarray:
    """-2 log likelihoods of a Gaussian about a place and a force, and of three readings that tell less and less."""
    of_place = ((AT.place_mm - FIRST_mm) ** 2).sum(axis=1) / FIRST_SD_mm**2
    of_force = (AT.log_N - LOG_N) ** 2 / 0.5
    of_all = (of_place[:, None] + of_force).ravel() + 300.0
    ruffle = rng_for(0, "answers").normal(0, 5, of_all.shape)
    return np.stack([of_all, 6 * (of_all + ruffle), of_all + ruffle, 0.1 * of_all]).astype(np.float32)


def of(total: np.ndarray) -> Likelihoods:
    return Likelihoods(total, total.argmin(axis=1))


def likely(temper: float) -> np.ndarray:
    found = np.exp(-0.5 * temper * (total().astype(float) - total().min(axis=1, keepdims=True)))
    return (found / found.sum(axis=1, keepdims=True)).reshape(4, len(AT.place_mm), -1)


def spread(of_place: np.ndarray, about_mm: np.ndarray) -> np.ndarray:
    var = np.array([p @ (AT.place_mm - m) ** 2 for p, m in zip(of_place, about_mm, strict=True)])
    return np.sqrt(np.maximum(var, CELL_SD_MM**2))


@pytest.mark.parametrize("temper", [1.0, 0.3])
def test_means_are_sums_over_all_hypotheses(temper):
    place_mm, sd_mm, force_N = means(of(total()), AT, temper)
    of_place = likely(temper).sum(axis=2)
    np.testing.assert_allclose(place_mm, of_place @ AT.place_mm, atol=1e-6)  # what lies e^-25 below is left out
    np.testing.assert_allclose(sd_mm, spread(of_place, place_mm), atol=1e-6)
    np.testing.assert_allclose(np.log(force_N), likely(temper).sum(axis=1) @ AT.log_N, atol=1e-6)


@pytest.mark.parametrize("temper", [1.0, 0.3])
def test_products_are_numpys_of_both_margins_and_normals(temper):
    rng = rng_for(1, "answers")
    said = np.column_stack(
        [rng.normal(0, 3, (4, 2)), rng.uniform(0.5, 2, (4, 2)), rng.normal(0, 1, 4), np.full(4, 0.4)]
    )
    place_mm, sd_mm, force_N = products(of(total()), AT, said, 0.6, temper)
    off = (AT.place_mm - said[:, None, :2]) / said[:, None, 2:4]
    of_place = likely(0.6).sum(axis=2) * np.exp(-0.5 * (off**2).sum(axis=2))
    of_force = likely(0.6).sum(axis=1) * np.exp(-0.5 * ((AT.log_N - said[:, 4:5]) / said[:, 5:]) ** 2)
    power = of_place**temper
    of_place, of_force, power = (part / part.sum(axis=1, keepdims=True) for part in (of_place, of_force, power))
    np.testing.assert_allclose(place_mm, of_place @ AT.place_mm, atol=1e-6)
    np.testing.assert_allclose(sd_mm, spread(power, place_mm), atol=1e-6)
    np.testing.assert_allclose(np.log(force_N), of_force @ AT.log_N, atol=1e-6)


def test_a_product_on_a_lattice_is_the_closed_form_of_two_gaussians():
    second_mm, second_sd = np.array([2.5, 0.0]), np.array([1.0, 0.8])
    second = np.concatenate([second_mm, second_sd, np.ones(2)])[None]
    place_mm, sd_mm, _ = products(of(total()[:1]), AT, second, 1.0, 1.0)
    var = 1 / (1 / FIRST_SD_mm**2 + 1 / second_sd**2)
    np.testing.assert_allclose(place_mm[0], var * (FIRST_mm / FIRST_SD_mm**2 + second_mm / second_sd**2), atol=1e-4)
    np.testing.assert_allclose(sd_mm[0], np.sqrt(var), atol=1e-4)


def test_a_place_that_the_map_rules_out_is_no_less_likely_than_single_precision_holds():
    far = np.full((1, total().shape[1]), 1e4, np.float32)
    far[0, 0] = 0.0
    said = np.array([[8.0, 8.0, 0.1, 0.1, 1.0, 1.0]])
    place_mm, sd_mm, _ = products(of(far), AT, said, 1.0, 1.0)
    np.testing.assert_allclose(place_mm, [[8.0, 8.0]], atol=0.05)
    assert np.isfinite(sd_mm).all()


def test_no_number_in_none_out():
    none = np.full((1, total().shape[1]), np.nan, np.float32)
    said = np.ones((1, 6))
    for found in (means(of(none), AT, 1.0), products(of(none), AT, said, 1.0, 1.0)):
        assert all(np.isnan(part).all() for part in found)

"""Tests of choosing the next place to label: the expected gain equals the variance removed by Gaussian conditioning."""

import numpy as np
import pytest

from reskin.errors import SchemaError
from reskin.universal.map import NOISE_uT, SkinMap, condition_on_labels, expected_gain, kernel, new_map
from reskin.universal.model import load_universal
from tests.universal.skins import fields_uT, make_tables

# These are places and forces at lattice points.
PLACE_mm, FORCE_N = np.array([[0.4, -1.2], [5.2, 2.8]]), np.array([2.0, 2.0])


@pytest.fixture(scope="module")
def skin() -> SkinMap:
    return new_map(make_tables())


def test_expected_gain_equals_the_variance_removed_by_a_press(skin):
    hypotheses, at_force = skin.hypotheses, np.arange(3, len(skin.hypotheses.mean_uT), len(skin.hypotheses.log_N))
    i = int(np.linalg.norm(hypotheses.place_mm - PLACE_mm[1], axis=1).argmin())
    slope = (hypotheses.slope_uT / np.linalg.norm(hypotheses.mean_uT, axis=1)[:, None, None])[at_force].astype(float)
    at_mm, at_log_N = (part[at_force] for part in hypotheses.at)
    force_N = np.exp(hypotheses.log_N[3:4])
    press_uT = np.linalg.norm(hypotheses.mean_uT[at_force[i]])
    # This is the covariance between the fields of a press at place i and the fields at all places, for all pairs of
    # channels.
    correlation = kernel(at_mm, at_mm[i : i + 1], at_log_N, at_log_N[i : i + 1])[:, 0]
    covariance = slope @ skin.cov @ slope[i].T + correlation[:, None, None] * skin.error_cov
    press_covariance = covariance[i] + skin.residual.noise * skin.error_cov + (NOISE_uT / press_uT) ** 2 * np.eye(15)
    removed = [np.trace(cross @ np.linalg.solve(press_covariance, cross.T)) for cross in covariance]
    found = expected_gain(skin, hypotheses.place_mm[i : i + 1], force_N)
    # The relative tolerance is the rounding of the tables, which are in single precision.
    assert found[0] == pytest.approx(np.mean(removed), rel=1e-5)


def test_labelling_a_place_reduces_the_expected_gain_there(skin):
    before = expected_gain(skin, PLACE_mm, FORCE_N)
    labelled = condition_on_labels(skin, PLACE_mm[:1], FORCE_N[:1], fields_uT(PLACE_mm[:1], FORCE_N[:1]))
    after = expected_gain(labelled, PLACE_mm, FORCE_N)
    assert after[0] < 0.2 * before[0]
    assert after[1] > 1.5 * after[0]


def test_next_place_after_a_label_is_at_least_2_mm_away():
    model = load_universal().zero(np.zeros(15))
    first_mm = model.next_place()
    press_uT = 300 * np.sin(np.arange(15.0))[None]
    next_mm = model.label(first_mm[None], np.array([2.0]), press_uT).next_place()
    assert ((first_mm > 0) & (first_mm < 16)).all()
    assert np.linalg.norm(next_mm - first_mm) > 2


@pytest.mark.parametrize("force_N", [0.0, -1.0, np.nan, np.inf])
def test_next_place_requires_a_positive_finite_force(force_N):
    with pytest.raises(SchemaError, match="next_place: the force must be finite and above 0 N"):
        load_universal().next_place(force_N)

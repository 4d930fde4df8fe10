"""Tests of the likelihood that tells whether a skin is like the simulated ones."""

import numpy as np
import pytest
from sklearn.mixture import GaussianMixture

from reskin.seeds import rng_for
from reskin.universal.likeness import JITTER, Likeness, directions_of, strong

SKINS_N, PRESSES_N, CHANNELS_N = 60, 40, 6
RNG = rng_for(0, "likeness")
USUAL_uT, WAYS = RNG.normal(0, 1500, CHANNELS_N), RNG.normal(0, 300, (3, CHANNELS_N))


def skins(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Draw skins whose presses change the field in a few ways."""
    rest_uT = USUAL_uT + RNG.normal(0, 100, (n, CHANNELS_N))
    return rest_uT, RNG.normal(0, 1, (n, PRESSES_N, 3)) @ WAYS + RNG.normal(0, 20, (n, PRESSES_N, CHANNELS_N))


@pytest.fixture(scope="module")
def likeness() -> Likeness:
    return Likeness.fit(*skins(SKINS_N))


def test_misfits_of_new_skins_are_below_the_limit(likeness):
    rest_uT, db_uT = skins(50)
    by_skin = [likeness.skin_misfit(rest, changes) for rest, changes in zip(rest_uT, db_uT, strict=True)]
    assert np.median(by_skin) < 0.6
    assert (np.array(by_skin) > 1).mean() <= 0.12  # the limits come from 30 skins
    assert (likeness.misfit(np.concatenate(db_uT)) > 1).mean() < 0.02
    assert (likeness.misfit(0.01 * db_uT[0]) == 0).all()  # too small to be judged


def test_exchanged_and_dead_channels_and_other_changes_are_above_the_limit(likeness):
    (rest_uT,), (db_uT,) = skins(1)
    for order in ([1, 0, 2, 3, 4, 5], [3, 4, 5, 0, 1, 2]):
        assert likeness.skin_misfit(rest_uT[order], db_uT[:, order]) > 1
    dead = np.arange(CHANNELS_N) != 2
    assert likeness.skin_misfit(rest_uT * dead, db_uT * dead) > 1
    assert likeness.skin_misfit(rest_uT, RNG.normal(0, 300, db_uT.shape)) > 1
    assert (likeness.misfit(RNG.normal(0, 300, (100, CHANNELS_N))) > 1).mean() > 0.8


def test_mixture_is_that_of_scikit_learn(likeness):
    """The likelihood is computed here from means and whitening matrices; scikit-learn's own one is the reference."""
    db_uT = strong(np.concatenate(skins(5)[1]))
    mixture = GaussianMixture(len(likeness.means), reg_covar=JITTER)
    mixture.means_, mixture.precisions_cholesky_ = likeness.means, likeness.whiten
    mixture.weights_ = np.exp(likeness.log_weights - np.log(np.diagonal(likeness.whiten, axis1=1, axis2=2)).sum(axis=1))
    median, limit = likeness.scales[1]
    constant = CHANNELS_N / 2 * np.log(2 * np.pi)
    expected = (-mixture.score_samples(directions_of(db_uT)) - constant - median) / (limit - median)
    np.testing.assert_allclose(likeness.misfit(db_uT), expected, rtol=1e-6, atol=1e-9)

"""A field at rest that wanders further: nothing before the end of training, a walk after it, in both readings alike."""

import numpy as np
import pytest

from pipeline.experiments.drift import walked
from tests.experiments.drift.test_run import capture

AFTER_N = 100


def walk_uT(step_uT: float, seed: int = 0) -> np.ndarray:
    line = capture("s0-wear")
    further = walked(line, step_uT, after_n=AFTER_N, seed=seed)
    np.testing.assert_allclose(further.b_uT - line.b_uT, further.noload_uT - line.noload_uT, atol=2e-3)
    return (further.noload_uT - line.noload_uT)[::2].astype(float)  # two readings a contact


def test_the_walk_begins_where_training_ends_and_grows_as_the_root_of_the_contacts():
    walk = np.concatenate([walk_uT(2.0, seed) for seed in range(20)], axis=1)
    assert np.abs(walk[:AFTER_N]).max() == 0
    for contacts_n in (1, 16, 256):
        rms_uT = np.sqrt((walk[AFTER_N - 1 + contacts_n] ** 2).mean())
        assert rms_uT == pytest.approx(2.0 * np.sqrt(contacts_n), rel=0.15)  # 300 walks


def test_twice_the_step_is_twice_the_same_walk():
    np.testing.assert_allclose(walk_uT(2.0), 2 * walk_uT(1.0), atol=2e-3)
    assert np.abs(walk_uT(0.0)).max() == 0

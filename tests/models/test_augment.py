"""Tests of virtual boards: copies of training rows as chips with other gains, tilts and noise would read them."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from reskin.models.batches import virtual_boards
from reskin.models.recipe import Augmentation
from reskin.seeds import rng_for

SKIN = np.array(["s1", "s1", "s2", "s1", "s2"])


def rows() -> np.ndarray:
    return rng_for(0, "rows").normal(0, 100, (5, 6)).astype(np.float32)


def augmentation(**changes: float) -> Augmentation:
    return Augmentation.model_validate({"copies_n": 3, "gain_sd": 0.0, "lean_sd_deg": 0.0, "noise_uT": 0.0} | changes)


def test_tilt_rotates_the_field_of_each_chip_and_keeps_its_length():
    copies, _ = virtual_boards(rows(), SKIN, augmentation(lean_sd_deg=20.0), rng_for(1, "draw"))
    before, after = (np.linalg.norm(values.reshape(-1, 2, 3), axis=2) for values in (np.tile(rows(), (3, 1)), copies))
    np.testing.assert_allclose(after, before, rtol=1e-5)  # Tolerance: rotations are computed in single precision.
    assert np.abs(copies - np.tile(rows(), (3, 1))).max() > 10


def test_all_rows_of_a_copied_skin_have_the_gains_of_one_virtual_board():
    copies, skin = virtual_boards(rows(), SKIN, augmentation(gain_sd=0.3), rng_for(1, "draw"))
    gain = copies / np.tile(rows(), (3, 1))
    for name in np.unique(skin):
        gain_of_copy = gain[skin == name]
        # The tolerance is the rounding of quotients in single precision.
        np.testing.assert_allclose(gain_of_copy, np.broadcast_to(gain_of_copy[0], gain_of_copy.shape), rtol=1e-5)
    one_of_each = np.array([gain[skin == name][0] for name in np.unique(skin)])
    assert len(np.unique(np.round(one_of_each, 4), axis=0)) == 6


def test_noise_has_the_given_standard_deviation():
    no_field = np.zeros((2000, 15), np.float32)
    copies, _ = virtual_boards(no_field, np.array(["s"] * 2000), augmentation(noise_uT=5.0), rng_for(1, "draw"))
    # The tolerance is four standard errors. The standard error for 90,000 draws is 0.012.
    assert abs(copies.std() - 5.0) < 0.05


@given(st.floats(0.1, 10))
def test_readings_of_virtual_boards_are_proportional_to_the_field(factor):
    settings = augmentation(gain_sd=0.2, lean_sd_deg=10.0)
    one, _ = virtual_boards(rows(), SKIN, settings, rng_for(1, "draw"))
    other, _ = virtual_boards(np.float32(factor) * rows(), SKIN, settings, rng_for(1, "draw"))
    # The tolerance is the rounding of sums of three single-precision terms.
    np.testing.assert_allclose(other, np.float32(factor) * one, rtol=1e-4, atol=1e-3)

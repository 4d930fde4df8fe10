"""A chip that converts on its own: a loop over conversions as truth; repeats at high rates as law."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from reskin.physics.chip import CONVERSION_S, last_conversions, seen_at

rates_hz = st.floats(50, 5000)
phases_s = st.floats(0, CONVERSION_S)


@given(rates_hz, phases_s)
def test_a_frame_brings_the_last_conversion_that_was_finished(rate_hz, phase_s):
    frame_s = (1 + np.arange(40)) / rate_hz
    age_s, _ = last_conversions(frame_s, np.array([phase_s]))
    ends_s = phase_s + CONVERSION_S * np.arange(-1, int(frame_s[-1] / CONVERSION_S) + 2)
    truth_s = [t - max(end for end in ends_s if end <= t + 1e-12) for t in frame_s]
    # a conversion that ends with the frame may count on either side
    off_s = np.abs(age_s[:, 0] - truth_s)
    assert (np.minimum(off_s, CONVERSION_S - off_s) < 1e-9).all()


def test_at_400_hz_no_frame_repeats_and_at_1000_hz_almost_every_second_one_does():
    for rate_hz, least, most in ((400, 0, 0), (1000, 0.44, 0.48)):  # 1 - 1 / (1.84 ms x 1 kHz) = 0.457
        _, source_i = last_conversions((1 + np.arange(2000)) / rate_hz, np.zeros(1))
        repeated = np.mean(source_i[:, 0] != np.arange(2000))
        assert least <= repeated <= most


def test_chips_of_one_frame_are_not_simultaneous():
    age_s, _ = last_conversions((1 + np.arange(100)) / 400, np.array([0.0, 0.9e-3]))
    assert np.abs(age_s[:, 0] - age_s[:, 1]).max() > 0.5e-3
    assert (age_s >= 0).all()
    assert (age_s < CONVERSION_S).all()


@given(rates_hz)
def test_what_is_seen_of_a_steady_change_is_as_old_as_the_conversion(rate_hz):
    frame_s = (1 + np.arange(30)) / rate_hz
    age_s, _ = last_conversions(frame_s, np.array([0.3e-3]))
    value = np.repeat(frame_s[:, None, None], 3, axis=2)
    seen = seen_at(value, age_s, rate_hz)
    late = frame_s - age_s[:, 0] >= frame_s[0]  # before the first frame nothing is known: that frame's value
    np.testing.assert_allclose(seen[late, 0, 0], (frame_s - age_s[:, 0])[late], atol=1e-9)

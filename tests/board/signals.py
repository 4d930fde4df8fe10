"""Synthetic frames for tests.

The bytes CR LF end a frame. To test that they do not end a frame where they are part of a value, a chosen fraction of
the values contains these bytes.
"""

import numpy as np
from hypothesis import strategies as st

from reskin import seeds
from reskin.board.wire import Frames

# Field values in uT at GAIN_SEL 6 whose bytes in single precision contain CR LF.
CRLF_TEMPERATURE_degC = 34.513275
CRLF_B_uT = (2208.8477, -2208.8477, 8835.308)
WIRES = ("binary", "binary-clock", "text-xyzt", "text-txyz")
BINARY_WIRES = WIRES[:2]
TEXT_WIRES = WIRES[2:]


def make_frames(frames_n: int, chips_n: int, seed: int, *, crlf_share: float = 0.0) -> Frames:
    """Return random readings that are multiples of 0.15 uT.

    The bytes of a fraction `crlf_share` of them contain CR LF.
    """
    rng = seeds.rng_for(seed, "frames")
    b_uT = rng.integers(-20000, 20000, (frames_n, 3 * chips_n)) * 0.15
    temperature_degC = rng.integers(2000, 4000, (frames_n, chips_n)) / 100
    for values, fixtures in ((b_uT, CRLF_B_uT), (temperature_degC, (CRLF_TEMPERATURE_degC,))):
        chosen = rng.random(values.shape) < crlf_share
        values[chosen] = rng.choice(fixtures, int(chosen.sum()))
    return frames_of(b_uT, temperature_degC)


def frames_of(b_uT: np.ndarray, temperature_degC: np.ndarray) -> Frames:
    frames_n = len(b_uT)
    clock_s = (np.arange(frames_n) / 512).astype(np.float64)  # Multiples of 1/512 s are exact in single precision.
    return Frames(b_uT.astype(np.float32), temperature_degC.astype(np.float32), clock_s, np.zeros(frames_n, np.int64))


def frames_strategy(*, min_frames_n: int = 0, max_frames_n: int = 12) -> st.SearchStrategy[Frames]:
    return st.builds(
        make_frames,
        st.integers(min_frames_n, max_frames_n),
        st.integers(1, 6),
        st.integers(0, 2**32),
        crlf_share=st.sampled_from([0.0, 0.05, 0.5, 1.0]),
    )

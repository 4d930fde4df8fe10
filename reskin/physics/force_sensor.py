"""The force and torque sensor behind the tip, ATI Nano17 SI-25-0.25. In: forces in N. Out: what it says, float32.

Its noise (resolution 1/160 N) is the scene's. Refuses to know where the force comes from.
"""

import numpy as np
from jaxtyping import Float, Float32

RANGE_N = (25.0, 25.0, 35.0)  # on x, y and z to either side (data sheet, calibration SI-25-0.25)


def read_force(
    force_N: Float[np.ndarray, "n 3"], *, noise_N: float, rng: np.random.Generator
) -> tuple[Float32[np.ndarray, "n 3"], int]:
    """Read forces with noise of sd `noise_N`; what is past the range is held there, and counted."""
    felt_N = force_N + noise_N * rng.standard_normal(force_N.shape)
    read_N = felt_N.clip(-np.array(RANGE_N), RANGE_N)
    return read_N.astype(np.float32), int(np.count_nonzero(read_N != felt_N))

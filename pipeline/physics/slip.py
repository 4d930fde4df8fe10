"""A skin that lies on its board and can slide there: how one wave of pressure fades towards the base. In: k z, k h.

Stands beside `layer.compliance` and `waves.bonded` of the bonded base: same surface, but below no height changes
and no shear is felt. Refuses to know contacts, and which of the two a skin has.
"""

import numpy as np
from jaxtyping import Float


def compliance(kh: Float[np.ndarray, " w"]) -> Float[np.ndarray, " w"]:
    """Give the sinking of the surface under a wave of pressure, relative to that of a half-space.

    (cosh 2A - 1) / (sinh 2A + 2A), A = kh, with both sides divided by exp(2A) / 2; A / 2 for long waves.
    """
    double = np.minimum(2 * kh, 1e3)
    fade = np.exp(-double)
    long_waves = double < 1e-4
    rest = np.where(long_waves, 1.0, 1 - fade**2 + 2 * double * fade)
    return np.where(long_waves, double / 4, np.expm1(-double) ** 2 / rest)

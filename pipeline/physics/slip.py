"""A skin that lies on its board and can slide there: how one wave of pressure fades towards the base. In: k z, k h.

Stands beside `layer.compliance` and `layer.depth_profile` of the bonded base: same surface, but below no height changes
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


def depth_profile(
    kz: Float[np.ndarray, "s w"], kh: Float[np.ndarray, " w"]
) -> tuple[Float[np.ndarray, "s w"], Float[np.ndarray, "s w"], Float[np.ndarray, "s w"]]:
    """Give g at height z, and its first two derivatives by kz; g(kh) is the surface's `compliance`.

    g = [(sinh A + A cosh A) sinh z' - z' sinh A cosh z'] / (sinh A cosh A + A): the odd solution, for at the base both
    W and W'' + W (the shear) vanish. All of it is multiplied by 4 exp(-2A), so that no exponent is positive inside.
    """
    top, low, base = np.exp(kz - kh), np.exp(-kh - kz), np.exp(-2 * kh)
    size = -np.expm1(-4 * kh) + 4 * kh * base
    odd, even = (top - low) / size, (top + low) / size
    first, second = (1 + kh) - (1 - kh) * base, -np.expm1(-2 * kh)
    g = first * odd - kz * second * even
    slope = (first - second) * even - kz * second * odd
    bend = (first - 2 * second) * odd - kz * second * even
    return g, slope, bend

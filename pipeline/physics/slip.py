"""A skin that lies on its board and can slide there: how one wave of pressure fades towards the base. In: k z, k h.

Stands beside `layer.compliance` and `layer.wave` of the bonded base: same surface, but below no height changes
and no shear is felt. Refuses to know contacts, and which of the two a skin has.
"""

from math import exp, expm1
from typing import no_type_check

import numpy as np
from jaxtyping import Float
from numba import njit


def compliance(kh: Float[np.ndarray, " w"]) -> Float[np.ndarray, " w"]:
    """Give the sinking of the surface under a wave of pressure, relative to that of a half-space.

    (cosh 2A - 1) / (sinh 2A + 2A), A = kh, with both sides divided by exp(2A) / 2; A / 2 for long waves.
    """
    double = np.minimum(2 * kh, 1e3)
    fade = np.exp(-double)
    long_waves = double < 1e-4
    rest = np.where(long_waves, 1.0, 1 - fade**2 + 2 * double * fade)
    return np.where(long_waves, double / 4, np.expm1(-double) ** 2 / rest)


@njit(cache=True, error_model="numpy")
@no_type_check
def whole(kh):
    """Give what `wave` needs of the layer as a whole; it is the same at every height."""
    fade, second = exp(-2 * kh), -expm1(-2 * kh)
    return second * (1 + fade) + 4 * kh * fade, (1 + kh) - (1 - kh) * fade, second


@njit(cache=True, error_model="numpy")
@no_type_check
def wave(kz, kh, of):
    """Give g of one wave at height z, and its first two derivatives by kz; g(kh) is the surface's `compliance`.

    g = [(sinh A + A cosh A) sinh z' - z' sinh A cosh z'] / (sinh A cosh A + A): the odd solution, for at the base both
    W and W'' + W (the shear) vanish. All of it is multiplied by 4 exp(-2A), so that no exponent is positive inside.
    """
    size, first, second = of
    top, low = exp(kz - kh), exp(-kh - kz)
    odd, even = (top - low) / size, (top + low) / size
    g = first * odd - kz * second * even
    slope = (first - second) * even - kz * second * odd
    bend = (first - 2 * second) * odd - kz * second * even
    return g, slope, bend

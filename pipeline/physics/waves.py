"""Waves of pressure on a layer, one by one and summed. In: k z, k h, places, amplitudes. Out: how each fades, sums.

All compiled code of a sum stands in this file: numba keeps what it compiled until this file changes, and looks at no
other. Refuses to know contacts.
"""

from functools import lru_cache
from math import exp, expm1
from typing import no_type_check

import numpy as np
from jaxtyping import Float
from numba import njit
from scipy.special import j0, j1

BESSEL_STEP = 1 / 256  # between tabulated Bessel functions


@njit(cache=True, error_model="numpy")
@no_type_check
def bonded_whole(kh):
    """Give what `bonded` needs of the layer as a whole; it is the same at every height."""
    base = exp(-2 * kh)
    size = (1 + base) ** 2 + 4 * kh * kh * base
    return (1 + base) / size, 2 * kh / size * exp(-kh), 0.0


@njit(cache=True, error_model="numpy")
@no_type_check
def bonded(kz, kh, of):
    """Give g of one wave at height z of a layer that is held at its base, and its first two derivatives by kz.

    g = [cosh A (sinh z' + t cosh z') - A cosh t - A z' sinh t] / (cosh^2 A + A^2), t = A - z': the W of PHYSICS 4 with
    a and b put in. All of it is divided by exp(2A) / 4, so that no exponent is positive inside the layer.
    """
    t = kh - kz
    top, fade = exp(-t), exp(-kz)
    low, high = fade * fade, top * top
    near, far = of[0] * top, of[1] * fade
    g = near * (1 + t - (1 - t) * low) - far * (1 + kz + (1 - kz) * high)
    slope = near * t * (1 - low) + far * kz * (1 + high)
    bend = near * (t * (1 + low) - (1 - low)) + far * (1 + high - kz * (1 - high))
    return g, slope, bend


@njit(cache=True, error_model="numpy")
@no_type_check
def sliding_whole(kh):
    """Give what `sliding` needs of the layer as a whole; it is the same at every height."""
    fade, second = exp(-2 * kh), -expm1(-2 * kh)
    return second * (1 + fade) + 4 * kh * fade, (1 + kh) - (1 - kh) * fade, second


@njit(cache=True, error_model="numpy")
@no_type_check
def sliding(kz, kh, of):
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


@njit(cache=True, error_model="numpy")
@no_type_check
def _between(table, low, share):
    # Cubic Hermite between points BESSEL_STEP apart, with the true slopes: wrong by less than 1e-12.
    j0_a, j1_a, slope_a = table[low, 0], table[low, 1], table[low, 2]
    j0_b, j1_b, slope_b = table[low + 1, 0], table[low + 1, 1], table[low + 1, 2]
    rest = 1 - share
    a, b = rest * rest * (1 + 2 * share), share * share * (3 - 2 * share)
    da, db = BESSEL_STEP * share * rest * rest, -BESSEL_STEP * share * share * rest
    return a * j0_a + b * j0_b - da * j1_a - db * j1_b, a * j1_a + b * j1_b + da * slope_a + db * slope_b


@njit(cache=True, error_model="numpy")
@no_type_check
def sum_waves(r_m, z_m, waves, slipping, table):
    """Sum waves [k, k h, amplitude; w] at places [s] for `layer.displacement`: the rows of the result are its parts."""
    sums = np.zeros((6, len(r_m)))
    for w in range(waves.shape[1]):
        k, kh, amplitude = waves[0, w], waves[1, w], waves[2, w]
        steep, of = amplitude * k, sliding_whole(kh) if slipping else bonded_whole(kh)
        for s in range(len(r_m)):
            g, slope, bend = sliding(k * z_m[s], kh, of) if slipping else bonded(k * z_m[s], kh, of)
            at = k * r_m[s] / BESSEL_STEP
            low = int(at)
            j0_, j1_ = _between(table, low, at - low)
            sums[0, s] += amplitude * slope * j1_
            sums[1, s] += steep * slope / 2
            sums[2, s] -= amplitude * g * j0_
            sums[3, s] += steep * slope * j0_
            sums[4, s] += steep * bend * j1_
            sums[5, s] += steep * g * j1_
    for s in range(len(r_m)):
        if r_m[s] > 0:
            sums[1, s] = sums[0, s] / r_m[s]  # on the axis: its limit
    return sums


def bessel(top: float) -> Float[np.ndarray, "x 3"]:
    """Tabulate J0, J1 and J1' = J0 - J1 / x from 0 to at least `top`."""
    return _bessel_to(1 << max(8, int(np.ceil(top)).bit_length()))


@lru_cache(maxsize=4)
def _bessel_to(top: int) -> Float[np.ndarray, "x 3"]:
    x = BESSEL_STEP * np.arange(round(top / BESSEL_STEP) + 2)
    with np.errstate(invalid="ignore"):
        slope = np.where(x > 0, j0(x) - j1(x) / x, 0.5)
    return np.stack([j0(x), j1(x), slope], axis=1)

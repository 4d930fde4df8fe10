"""Many Gaussians made ready at once: spreads, means -> rows that weigh any reading by one product of matrices.

chi^2 = d'Ad - 2 b'd + c is linear in the products of channels. Single precision; off by less than 0.01 where a reading
is likely. Refuses to know what the Gaussians stand for.
"""

from functools import cache
from typing import no_type_check

import numpy as np
from jaxtyping import Float32
from numba import njit

LANES_N = 64  # Gaussians side by side: a row of vector instructions each


def quadratic(
    mean: Float32[np.ndarray, "h ch"], spread: Float32[np.ndarray, "h ch t"], var: Float32[np.ndarray, " h"],
    shape: Float32[np.ndarray, "ch ch"], noise_var: float,
) -> tuple[Float32[np.ndarray, "h f"], Float32[np.ndarray, " h"]]:  # fmt: skip
    """Give rows for `products`, and log determinants, of covariances spread spread' + var shape + noise_var 1."""
    channels_n = mean.shape[1]
    found = np.empty((len(mean), channels_n * (channels_n + 1) // 2 + channels_n + 2), np.float32)
    _fill(mean, spread, var, shape, np.float32(noise_var), found)
    return found[:, :-1], found[:, -1]


def products(read: Float32[np.ndarray, "n ch"]) -> Float32[np.ndarray, "n f"]:
    """Give the products of channels, the channels and 1: their product with a row of `quadratic` is chi^2."""
    rows, columns = _triangle(read.shape[1])
    return np.concatenate([read[:, rows] * read[:, columns], read, np.ones((len(read), 1), np.float32)], axis=1)


@cache
def _triangle(channels_n: int) -> tuple[np.ndarray, np.ndarray]:
    return np.triu_indices(channels_n)


@njit(cache=True, error_model="numpy", fastmath={"contract"})
@no_type_check
def _fill(mean, spread, var, shape, noise_var, found):
    h, c, t = spread.shape
    m, s = np.empty((c, LANES_N), np.float32), np.empty((c, t, LANES_N), np.float32)
    a, b = np.empty((c, c, LANES_N), np.float32), np.empty((c, c, LANES_N), np.float32)
    size, log_det = np.empty(LANES_N, np.float32), np.empty(LANES_N, np.float32)
    for first in range(0, h, LANES_N):
        n = min(LANES_N, h - first)
        for lane in range(LANES_N):
            k = first + min(lane, n - 1)  # the last one fills up
            size[lane] = var[k]
            for i in range(c):
                m[i, lane] = mean[k, i]
                for p in range(t):
                    s[i, p, lane] = spread[k, i, p]
        _cov(s, size, shape, noise_var, a)
        _root(a, log_det)
        _precision(a, b)
        _write(a, m, log_det, found[first : first + n])


@njit(cache=True, error_model="numpy", fastmath={"contract"})
@no_type_check
def _cov(s, var, shape, noise_var, a):
    # The lower triangle of s s' + var shape + noise_var 1.
    for i in range(len(a)):
        for j in range(i + 1):
            noise = noise_var if i == j else np.float32(0)
            for lane in range(LANES_N):
                a[i, j, lane] = var[lane] * shape[i, j] + noise
            for p in range(s.shape[1]):
                _add(a[i, j], s[i, p], s[j, p])


@njit(cache=True, error_model="numpy", fastmath={"contract"})
@no_type_check
def _root(a, log_det):
    # Cholesky's root L in place of the lower triangle.
    _clear(log_det)
    for j in range(len(a)):
        for p in range(j):
            for i in range(j, len(a)):
                _subtract(a[i, j], a[i, p], a[j, p])
        for lane in range(LANES_N):
            log_det[lane] += np.log(a[j, j, lane])
            a[j, j, lane] = np.sqrt(a[j, j, lane])
        for i in range(j + 1, len(a)):
            _divide(a[i, j], a[j, j])


@njit(cache=True, error_model="numpy", fastmath={"contract"})
@no_type_check
def _precision(a, b):
    # From the root L in `a` the upper triangle of L^-T L^-1 in its place; `b` is room for L^-1.
    c = len(a)
    for j in range(c):
        for i in range(j, c):
            for lane in range(LANES_N):
                b[i, j, lane] = np.float32(1 if i == j else 0)
            for p in range(j, i):
                _subtract(b[i, j], a[i, p], b[p, j])
            _divide(b[i, j], a[i, i])
    for i in range(c):
        for j in range(i, c):
            _clear(a[i, j])
            for p in range(j, c):
                _add(a[i, j], b[p, i], b[p, j])


@njit(cache=True, error_model="numpy", fastmath={"contract"})
@no_type_check
def _write(a, m, log_det, found):
    c, f = len(a), 0
    aimed, square = np.empty(LANES_N, np.float32), np.empty(LANES_N, np.float32)
    for i in range(c):
        for j in range(i, c):
            times = np.float32(1 if i == j else 2)
            for lane in range(len(found)):
                found[lane, f] = times * a[i, j, lane]
            f += 1
    _clear(square)
    for i in range(c):
        _clear(aimed)
        for j in range(c):
            _add(aimed, a[min(i, j), max(i, j)], m[j])
        _add(square, aimed, m[i])
        for lane in range(len(found)):
            found[lane, f + i] = np.float32(-2) * aimed[lane]
    for lane in range(len(found)):
        found[lane, f + c], found[lane, f + c + 1] = square[lane], log_det[lane]


# Loops over lanes are written out: as expressions of arrays they are not turned into vector instructions.
@njit(inline="always")
@no_type_check
def _add(total, one, other):
    for lane in range(LANES_N):
        total[lane] += one[lane] * other[lane]


@njit(inline="always")
@no_type_check
def _subtract(total, one, other):
    for lane in range(LANES_N):
        total[lane] -= one[lane] * other[lane]


@njit(inline="always")
@no_type_check
def _divide(value, by):
    for lane in range(LANES_N):
        value[lane] /= by[lane]


@njit(inline="always")
@no_type_check
def _clear(value):
    for lane in range(LANES_N):
        value[lane] = np.float32(0)

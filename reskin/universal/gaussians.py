"""Many Gaussians made ready at once: means and slopes, numbers -> rows that weigh any reading.

Of each Gaussian the inverse root W of its covariance and W times its mean: chi^2 = |W d - W m|^2. Single precision; off
by less than 0.01 where a reading is likely. Refuses to know what the Gaussians stand for.
"""

from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Float32
from numba import njit

LANES_N = 64  # Gaussians side by side, `l`: a row of vector instructions each


@dataclass(frozen=True)
class Linear:
    """Means that are linear in some numbers, in blocks of Gaussians side by side; the last one fills up its block."""

    mean: Float32[np.ndarray, "k ch l"]
    slope: Float32[np.ndarray, "k ch t l"]


@dataclass(frozen=True)
class Gaussians:
    """Gaussians side by side: of each channel W m and W's row up to it, and the logarithm of the determinant."""

    row: Float32[np.ndarray, "f h"]
    log_det: Float32[np.ndarray, " h"]

    def weigh(self, read: Float32[np.ndarray, "n ch"]) -> tuple[Float32[np.ndarray, "n h"], Float32[np.ndarray, "n h"]]:
        """Give chi^2 of readings, and that and the logarithm of the determinant."""
        chi2 = np.zeros((len(read), len(self.log_det)), np.float32)
        _weigh(self.row, read, chi2)
        return chi2, chi2 + self.log_det


def side_by_side(mean: Float32[np.ndarray, "h ch"], slope: Float32[np.ndarray, "h ch t"]) -> Linear:
    """Lay Gaussians out in blocks."""
    blocks_n = -(-len(mean) // LANES_N)
    of_lane = np.minimum(np.arange(blocks_n * LANES_N), len(mean) - 1).reshape(blocks_n, LANES_N)
    return Linear(*(np.ascontiguousarray(np.moveaxis(part[of_lane], 1, -1)) for part in (mean, slope)))


def whiten(
    of: Linear, numbers: tuple[Float32[np.ndarray, " t"], Float32[np.ndarray, "t t"]],
    missed: Float32[np.ndarray, "h ch"], left: Float32[np.ndarray, " h"], shape: Float32[np.ndarray, "ch ch"],
    noise_var: float,
) -> Gaussians:  # fmt: skip
    """Make Gaussians ready, of numbers with a mean and the lower root C of their covariance.

    With M = mean + slope numbers, a mean is M + |M| missed, its covariance (slope C)(slope C)' + |M|^2 left shape +
    noise_var 1.
    """
    channels_n = len(shape)
    row = np.empty((channels_n * (channels_n + 3) // 2 + 1, len(left)), np.float32)
    _fill((of.mean, of.slope), numbers, (missed, left), shape, np.float32(noise_var), row)
    return Gaussians(row[:-1], row[-1])


@njit(cache=True, error_model="numpy", fastmath={"contract"})
@no_type_check
def _weigh(row, read, chi2):
    y, with_mean = np.empty(row.shape[1], np.float32), np.empty(read.shape[1] + 1, np.float32)
    with_mean[0] = -1
    for r in range(len(read)):
        with_mean[1:] = read[r]
        f = 0
        for i in range(2, len(with_mean) + 1):
            np.dot(with_mean[:i], row[f : f + i], y)
            for h in range(len(y)):
                chi2[r, h] += y[h] * y[h]
            f += i


@njit(cache=True, error_model="numpy", fastmath={"contract"})
@no_type_check
def _fill(of, numbers, errors, shape, noise_var, row):
    (mean, slope), (number, root) = of, numbers
    c, t = slope.shape[1:3]
    m, s = np.empty((c, LANES_N), np.float32), np.empty((c, t, LANES_N), np.float32)
    a, b = np.empty((c, c, LANES_N), np.float32), np.empty((c, c, LANES_N), np.float32)
    var, log_det = np.empty(LANES_N, np.float32), np.empty(LANES_N, np.float32)
    for k in range(len(mean)):
        _expect((mean[k], slope[k]), number, errors, k * LANES_N, m, var)
        _spread(slope[k], root, s)
        _cov(s, var, shape, noise_var, a)
        _root(a, log_det)
        _inverse(a, b)
        _write(b, m, log_det, row[:, k * LANES_N : (k + 1) * LANES_N])


@njit(cache=True, error_model="numpy", fastmath={"contract"})
@no_type_check
def _expect(of, number, errors, first, m, var):
    (mean, slope), (missed, left) = of, errors
    _clear(var)
    for i in range(len(m)):
        m[i] = mean[i]
        for p in range(len(number)):
            _add_times(m[i], number[p], slope[i, p])
        _add(var, m[i], m[i])
    for lane in range(LANES_N):
        h = min(first + lane, len(left) - 1)
        for i in range(len(m)):
            m[i, lane] += np.sqrt(var[lane]) * missed[h, i]
        var[lane] *= left[h]


@njit(cache=True, error_model="numpy", fastmath={"contract"})
@no_type_check
def _spread(slope, root, s):
    for i in range(len(s)):
        for p in range(len(root)):
            _clear(s[i, p])
            for q in range(p, len(root)):
                _add_times(s[i, p], root[q, p], slope[i, q])


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
    # Cholesky's root L in place of the lower triangle, but for its diagonal, which is that of 1/L.
    _clear(log_det)
    for j in range(len(a)):
        for p in range(j):
            for i in range(j, len(a)):
                _subtract(a[i, j], a[i, p], a[j, p])
        for lane in range(LANES_N):
            log_det[lane] += np.log(a[j, j, lane])
            a[j, j, lane] = np.float32(1) / np.sqrt(a[j, j, lane])
        for i in range(j + 1, len(a)):
            _scale(a[i, j], a[j, j])


@njit(cache=True, error_model="numpy", fastmath={"contract"})
@no_type_check
def _inverse(a, b):
    # From the root L in `a` its inverse, lower too.
    for j in range(len(a)):
        b[j, j] = a[j, j]
        for i in range(j + 1, len(a)):
            _clear(b[i, j])
            for p in range(j, i):
                _subtract(b[i, j], a[i, p], b[p, j])
            _scale(b[i, j], a[i, i])


@njit(cache=True, error_model="numpy", fastmath={"contract"})
@no_type_check
def _write(b, m, log_det, row):
    f, n, aimed = 0, row.shape[1], np.empty(LANES_N, np.float32)
    for i in range(len(b)):
        _clear(aimed)
        for j in range(i + 1):
            _add(aimed, b[i, j], m[j])
            row[f + 1 + j] = b[i, j, :n]
        row[f] = aimed[:n]
        f += i + 2
    row[f] = log_det[:n]


# Loops over lanes are written out: as expressions of arrays they are not turned into vector instructions.
@njit(inline="always")
@no_type_check
def _add(total, one, other):
    for lane in range(LANES_N):
        total[lane] += one[lane] * other[lane]


@njit(inline="always")
@no_type_check
def _add_times(total, times, one):
    for lane in range(LANES_N):
        total[lane] += times * one[lane]


@njit(inline="always")
@no_type_check
def _subtract(total, one, other):
    for lane in range(LANES_N):
        total[lane] -= one[lane] * other[lane]


@njit(inline="always")
@no_type_check
def _scale(value, by):
    for lane in range(LANES_N):
        value[lane] *= by[lane]


@njit(inline="always")
@no_type_check
def _clear(value):
    for lane in range(LANES_N):
        value[lane] = np.float32(0)

"""Compiled loops of `reskin.universal.map`, which compute likelihoods of hypotheses and means over hypotheses.

A hypothesis is a pair of a place and a force that a press may have. The hypotheses are ordered by place and then by
force. Under a hypothesis, a reading d has a normal distribution (here called a Gaussian) with a mean m and a covariance
C. A Gaussian is whitened: instead of m and C, this module stores W m and W, where W^T W is the inverse of C. It follows
that chi^2 = (d - m)^T C^-1 (d - m) = |W d - W m|^2, which can be computed fast for many readings.

Likelihoods are computed in single precision. The error of chi^2 is below 0.01 for hypotheses under which a reading is
likely.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Float, Float32, Int64
from numba import njit

# Gaussians are processed in blocks of this number, so that the processor can use vector instructions. The position in
# a block is called a lane (axis `l` of arrays).
LANES_N = 64


@dataclass(frozen=True)
class LinearMeans:
    """Means of Gaussians, given as linear functions of some parameters.

    The mean of a Gaussian is `mean + slope @ parameters`. The Gaussians are arranged in blocks of `LANES_N` (axis `k`).
    The last block is filled up with copies of the last Gaussian.
    """

    mean: Float32[np.ndarray, "k ch l"]
    slope: Float32[np.ndarray, "k ch t l"]


@dataclass(frozen=True)
class Gaussians:
    """Whitened Gaussians: W m and W of each Gaussian, and the logarithm of the determinant of its covariance.

    `row` has one column per Gaussian (axis `h`). Each column contains, for one channel after the other, the element of
    W m and the row of W. A row of W ends at the diagonal, because W is lower triangular.
    """

    row: Float32[np.ndarray, "f h"]
    log_det: Float32[np.ndarray, " h"]

    def evaluate(
        self, read: Float32[np.ndarray, "n ch"]
    ) -> tuple[Float32[np.ndarray, "n h"], Float32[np.ndarray, "n h"]]:
        """Return chi^2 and the deviance of each reading under each Gaussian.

        The deviance is chi^2 plus the logarithm of the determinant. It is -2 log likelihood, up to a constant.
        """
        chi2 = np.zeros((len(read), len(self.log_det)), np.float32)
        _chi2(self.row, read, chi2)
        return chi2, chi2 + self.log_det

    def solve(self, read: Float32[np.ndarray, "n ch"], which: Int64[np.ndarray, " n"]) -> Float32[np.ndarray, "n ch"]:
        """Return C^-1 (d - m) for each reading d.

        For each reading, the mean m and the covariance C belong to the Gaussian whose index is in `which`.
        """
        row, solved, f = self.row[:, which], np.zeros_like(read), 0
        for i in range(read.shape[1]):
            to_mean, white = row[f], row[f + 1 : f + 2 + i].T
            deviation = (white * read[:, : i + 1]).sum(axis=1) - to_mean
            solved[:, : i + 1] += deviation[:, None] * white
            f += i + 2
        return solved


def in_blocks(mean: Float32[np.ndarray, "h ch"], slope: Float32[np.ndarray, "h ch t"]) -> LinearMeans:
    """Arrange the means and slopes of Gaussians in blocks of `LANES_N` Gaussians."""
    blocks_n = -(-len(mean) // LANES_N)
    gaussian_i = np.minimum(np.arange(blocks_n * LANES_N), len(mean) - 1).reshape(blocks_n, LANES_N)
    return LinearMeans(*(np.ascontiguousarray(np.moveaxis(part[gaussian_i], 1, -1)) for part in (mean, slope)))


def whiten(
    means: LinearMeans, parameters: tuple[Float32[np.ndarray, " t"], Float32[np.ndarray, "t t"]],
    residual: Float32[np.ndarray, "h ch"], share: Float32[np.ndarray, " h"], error_cov: Float32[np.ndarray, "ch ch"],
    noise_cov: Float32[np.ndarray, "ch ch"],
) -> Gaussians:  # fmt: skip
    """Compute the Gaussians of all hypotheses, and whiten them.

    The parameters are normally distributed. `parameters` contains their mean and the lower Cholesky factor L of their
    covariance. Let M = mean + slope @ (mean of the parameters) be the expected field change of a hypothesis without the
    error of the law. The Gaussian of this hypothesis has the mean M + |M| residual and the covariance
    (slope L)(slope L)^T + |M|^2 share error_cov + noise_cov. Its three terms are the uncertainty of the parameters, of
    the error of the law, and of the noise. `share` is the fraction of the variance of the error that labels have left.
    """
    channels_n = len(error_cov)
    row = np.empty((channels_n * (channels_n + 3) // 2 + 1, len(share)), np.float32)
    _fill((means.mean, means.slope), parameters, (residual, share), error_cov, noise_cov, row)
    return Gaussians(row[:-1], row[-1])


@njit(cache=True, error_model="numpy", fastmath={"contract"})
@no_type_check
def _chi2(row, read, chi2):
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
def _fill(of, parameters, errors, error_cov, noise_cov, row):
    (mean, slope), (value, root) = of, parameters
    c, t = slope.shape[1:3]
    m, s = np.empty((c, LANES_N), np.float32), np.empty((c, t, LANES_N), np.float32)
    a, b = np.empty((c, c, LANES_N), np.float32), np.empty((c, c, LANES_N), np.float32)
    var, log_det = np.empty(LANES_N, np.float32), np.empty(LANES_N, np.float32)
    for k in range(len(mean)):
        _expect((mean[k], slope[k]), value, errors, k * LANES_N, m, var)
        _spread(slope[k], root, s)
        _cov(s, var, error_cov, noise_cov, a)
        _root(a, log_det)
        _inverse(a, b)
        _write(b, m, log_det, row[:, k * LANES_N : (k + 1) * LANES_N])


@njit(cache=True, error_model="numpy", fastmath={"contract"})
@no_type_check
def _expect(of, value, errors, first, m, var):
    # Compute the means m = M + |M| residual of one block, and var = |M|^2 share. `whiten` defines M.
    (mean, slope), (residual, share) = of, errors
    _clear(var)
    for i in range(len(m)):
        m[i] = mean[i]
        for p in range(len(value)):
            _add_times(m[i], value[p], slope[i, p])
        _add(var, m[i], m[i])
    for lane in range(LANES_N):
        h = min(first + lane, len(share) - 1)
        for i in range(len(m)):
            m[i, lane] += np.sqrt(var[lane]) * residual[h, i]
        var[lane] *= share[h]


@njit(cache=True, error_model="numpy", fastmath={"contract"})
@no_type_check
def _spread(slope, root, s):
    # Compute s = slope L, where L is the Cholesky factor `root`.
    for i in range(len(s)):
        for p in range(len(root)):
            _clear(s[i, p])
            for q in range(p, len(root)):
                _add_times(s[i, p], root[q, p], slope[i, q])


@njit(cache=True, error_model="numpy", fastmath={"contract"})
@no_type_check
def _cov(s, var, error_cov, noise_cov, a):
    # Compute the lower triangle of the covariance s s^T + var error_cov + noise_cov.
    for i in range(len(a)):
        for j in range(i + 1):
            for lane in range(LANES_N):
                a[i, j, lane] = var[lane] * error_cov[i, j] + noise_cov[i, j]
            for p in range(s.shape[1]):
                _add(a[i, j], s[i, p], s[j, p])


@njit(cache=True, error_model="numpy", fastmath={"contract"})
@no_type_check
def _root(a, log_det):
    # Replace the lower triangle of `a` by its Cholesky factor. The diagonal elements are stored as their reciprocals.
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
    # Compute the inverse of the Cholesky factor in `a`. The inverse is also lower triangular.
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
    # Write W m and W (here `b`) of one block to `row`, in the order of `Gaussians.row`, followed by the logarithms of
    # the determinants.
    f, n, white_mean = 0, row.shape[1], np.empty(LANES_N, np.float32)
    for i in range(len(b)):
        _clear(white_mean)
        for j in range(i + 1):
            _add(white_mean, b[i, j], m[j])
            row[f + 1 + j] = b[i, j, :n]
        row[f] = white_mean[:n]
        f += i + 2
    row[f] = log_det[:n]


# The following functions loop over lanes, because Numba does not vectorise the equivalent array expressions.
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


# Smallest standard deviation of an estimated place. It is not 0, because the map does not distinguish positions within
# a cell of its lattice.
CELL_SD_MM = 0.2
TINY = float(np.finfo(np.float32).tiny)  # smallest probability of a place or a force; smaller ones are replaced by it
LEAST = math.log(TINY)
FARTHEST = 200.0  # a log likelihood that is farther below the largest one than this is replaced by this limit


class Lattice(NamedTuple):
    """The places of the hypotheses, and the logarithms of the forces, which are the same at each place."""

    place_mm: Float[np.ndarray, "p 2"]
    log_N: Float[np.ndarray, " q"]


# Normal distributions of x, y and log F for each of n readings. The columns are: mean of x, mean of y, standard
# deviation of x, standard deviation of y, mean of log F, standard deviation of log F.
Normals = Float[np.ndarray, "n 6"]
Moments = tuple[np.ndarray, np.ndarray, np.ndarray]  # places [n 2], their standard deviations [n 2], force in N [n]


def means(
    deviance: Float32[np.ndarray, "n h"], best: Int64[np.ndarray, " n"], lattice: Lattice, power: float
) -> Moments:
    """Return means and standard deviations of place and force over all hypotheses.

    The hypotheses are weighted by their likelihoods, raised to `power`.

    Parameters
    ----------
    deviance : -2 log likelihood of each hypothesis for each reading, up to a constant
    best : index of the most likely hypothesis for each reading
    lattice : places and forces of the hypotheses
    power : likelihood power
    """
    moments = np.empty((len(deviance), 5))
    _means(deviance, best, tuple(lattice), 0.5 * power, moments)
    return moments[:, :2], moments[:, 2:4], moments[:, 4]


def products(
    deviance: Float32[np.ndarray, "n h"], best: Int64[np.ndarray, " n"], lattice: Lattice, normals: Normals,
    map_power: float, power: float, force_power: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Combine the map's probabilities of place and of force with normal distributions of place and of force.

    The probability of a place is the sum over all forces, and the probability of a force is the sum over all places.
    Both are then multiplied by the normal distributions, which come from networks.

    Parameters
    ----------
    deviance : -2 log likelihood of each hypothesis for each reading, up to a constant
    best : index of the most likely hypothesis for each reading
    lattice : places and forces of the hypotheses
    normals : normal distributions of x, y and log F for each reading
    map_power : power of the map's likelihoods
    power : power of the product, which affects only the standard deviations of places
    force_power : power of the map's probabilities of forces, for the fourth result

    Returns
    -------
    The mean places, their standard deviations, the forces, and the mean log forces of the map alone
    """
    moments = np.empty((len(deviance), 6))
    _products(deviance, best, tuple(lattice), normals, (0.5 * map_power, power, force_power), moments)
    return moments[:, :2], moments[:, 2:4], moments[:, 4], moments[:, 5]


@njit(cache=True, error_model="numpy")
@no_type_check
def _means(deviance, best, at, half_power, found):
    place_mm, log_N = at
    likely, forces_n = np.empty(deviance.shape[1]), len(log_N)
    for r in range(len(deviance)):
        _likelihoods(deviance[r], deviance[r, best[r]], half_power, likely)
        sum_, x, y, xx, yy, log_F = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for p in range(len(place_mm)):
            here = 0.0
            for q in range(forces_n):
                here += likely[p * forces_n + q]
                log_F += likely[p * forces_n + q] * log_N[q]
            sum_ += here
            x += here * place_mm[p, 0]
            y += here * place_mm[p, 1]
            xx += here * place_mm[p, 0] ** 2
            yy += here * place_mm[p, 1] ** 2
        x, y = x / sum_, y / sum_
        found[r, 0], found[r, 1], found[r, 4] = x, y, math.exp(log_F / sum_)
        found[r, 2], found[r, 3] = _sd_mm(xx / sum_ - x**2), _sd_mm(yy / sum_ - y**2)


@njit(cache=True, error_model="numpy")
@no_type_check
def _products(deviance, best, at, normals, powers, found):
    place_mm, log_N = at
    likely, of_place, of_force = np.empty(deviance.shape[1]), np.empty(len(place_mm)), np.empty(len(log_N))
    combined = np.empty(len(log_N))
    for r in range(len(deviance)):
        mean_x, mean_y, sd_x, sd_y, mean_log_N, sd_log_N = normals[r]
        _likelihoods(deviance[r], deviance[r, best[r]], powers[0], likely)
        _margins(likely, of_place, of_force)
        for p in range(len(of_place)):
            off_x, off_y = place_mm[p, 0] - mean_x, place_mm[p, 1] - mean_y
            of_place[p] -= 0.5 * ((off_x / sd_x) ** 2 + (off_y / sd_y) ** 2)
        for q in range(len(of_force)):
            combined[q] = of_force[q] - 0.5 * ((log_N[q] - mean_log_N) / sd_log_N) ** 2
            of_force[q] *= powers[2]
        x, y, _, _ = _moments(of_place, place_mm, (0.0, 0.0), 1.0, likely)
        _, _, xx, yy = _moments(of_place, place_mm, (x, y), powers[1], likely)
        found[r, 0], found[r, 1], found[r, 2], found[r, 3] = x, y, _sd_mm(xx), _sd_mm(yy)
        found[r, 4], found[r, 5] = math.exp(_mean(combined, log_N)), _mean(of_force, log_N)


@njit(cache=True, error_model="numpy")
@no_type_check
def _likelihoods(deviance, least, half_power, likely):
    for h in range(len(deviance)):
        likely[h] = _exp(half_power * (least - deviance[h]))


@njit(cache=True, error_model="numpy")
@no_type_check
def _margins(likely, of_place, of_force):
    # Compute the log marginal probabilities of places and of forces.
    forces_n, sum_ = len(of_force), 0.0
    for q in range(forces_n):
        of_force[q] = 0.0
    for p in range(len(of_place)):
        of_place[p] = 0.0
        for q in range(forces_n):
            of_place[p] += likely[p * forces_n + q]
            of_force[q] += likely[p * forces_n + q]
        sum_ += of_place[p]
    for p in range(len(of_place)):
        of_place[p] = _log(of_place[p] / sum_)
    for q in range(forces_n):
        of_force[q] = _log(of_force[q] / sum_)


@njit(cache=True, error_model="numpy")
@no_type_check
def _moments(log, place_mm, about_mm, power, likely):
    # Return the means of x and y, and the mean squares of their distances from `about_mm`. `log` contains the log
    # probability of each place. The weights of places are these probabilities, raised to `power`. `likely` is a work
    # array.
    most, sum_, x, y, xx, yy = _most(log), 0.0, 0.0, 0.0, 0.0, 0.0
    for p in range(len(log)):
        likely[p] = _exp(power * (log[p] - most))
    for p in range(len(log)):
        sum_ += likely[p]
        x += likely[p] * place_mm[p, 0]
        y += likely[p] * place_mm[p, 1]
        xx += likely[p] * (place_mm[p, 0] - about_mm[0]) ** 2
        yy += likely[p] * (place_mm[p, 1] - about_mm[1]) ** 2
    return x / sum_, y / sum_, xx / sum_, yy / sum_


@njit(cache=True, error_model="numpy")
@no_type_check
def _mean(log, values):
    most, sum_, mean = _most(log), 0.0, 0.0
    for q in range(len(log)):
        likely = math.exp(log[q] - most)
        sum_ += likely
        mean += likely * values[q]
    return mean / sum_


@njit(cache=True, error_model="numpy")
@no_type_check
def _most(values):
    most = values[0]
    for i in range(1, len(values)):
        most = values[i] if values[i] > most else most
    return most


@njit(inline="always")
@no_type_check
def _exp(x):
    # Return exp(x) for x <= 0. This is the Taylor series of exp(x / 512), squared nine times. The function `math.exp`
    # is not used, because it is not vectorised. The relative error is at most 1e-9 for x >= -100, and 5e-7 at x = -200.
    p = (-FARTHEST if x < -FARTHEST else x) * (1 / 512)
    y = p * (1 / 24 + p * (1 / 120 + p * (1 / 720 + p * (1 / 5040 + p * (1 / 40320)))))
    y = 1.0 + p * (1.0 + p * (1 / 2 + p * (1 / 6 + y)))
    y *= y
    y *= y
    y *= y
    y *= y
    y *= y
    y *= y
    y *= y
    y *= y
    y *= y
    return y


@njit(inline="always")
@no_type_check
def _log(probability):
    return LEAST if probability < TINY else math.log(probability)


@njit(inline="always")
@no_type_check
def _sd_mm(var_mm2):
    return CELL_SD_MM if var_mm2 < CELL_SD_MM**2 else math.sqrt(var_mm2)

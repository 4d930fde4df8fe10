"""Places and forces of readings: how likely each hypothesis is -> means and spreads; of a map, or of it and a network.

Compiled: one loop over hypotheses, a reading. Forces run within places. Refuses to know where the hypotheses come from.
"""

import math
from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Float, Float32, Int64
from numba import njit

CELL_SD_MM = 0.2  # at least, of a place: where it lies within a cell of the lattice
TINY = float(np.finfo(np.float32).tiny)  # no place is ruled out by a map alone
LEAST = math.log(TINY)
FARTHEST = 200.0  # of log likelihood, below the likeliest: what is farther is taken as so far


class Likelihoods(NamedTuple):
    """Of hypotheses: -2 log likelihoods, and which is likeliest."""

    total: Float32[np.ndarray, "n h"]
    best: Int64[np.ndarray, " n"]


class Lattice(NamedTuple):
    """Places under forces."""

    place_mm: Float[np.ndarray, "p 2"]
    log_N: Float[np.ndarray, " q"]


Normals = Float[np.ndarray, "n 6"]  # x and y of another's answer, their standard deviations; log F and its own
Answer = tuple[np.ndarray, np.ndarray, np.ndarray]  # x and y, their standard deviations [n 2], force in N [n]


def means(of: Likelihoods, at: Lattice, temper: float) -> Answer:
    """Give the means over all hypotheses."""
    found = np.empty((len(of.total), 5))
    _means(*of, tuple(at), 0.5 * temper, found)
    return found[:, :2], found[:, 2:4], found[:, 4]


def products(of: Likelihoods, at: Lattice, normals: Normals, map_temper: float, temper: float) -> Answer:
    """Multiply probabilities of places, and of forces, with normals; spreads are those of a power of the product."""
    found = np.empty((len(of.total), 5))
    _products(*of, tuple(at), normals, (0.5 * map_temper, temper), found)
    return found[:, :2], found[:, 2:4], found[:, 4]


@njit(cache=True, error_model="numpy")
@no_type_check
def _means(total, best, at, half_temper, found):
    place_mm, log_N = at
    likely, forces_n = np.empty(total.shape[1]), len(log_N)
    for r in range(len(total)):
        _believe(total[r], total[r, best[r]], half_temper, likely)
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
def _products(total, best, at, said, tempers, found):
    place_mm, log_N = at
    likely, of_place, of_force = np.empty(total.shape[1]), np.empty(len(place_mm)), np.empty(len(log_N))
    for r in range(len(total)):
        said_x, said_y, sd_x, sd_y, said_log_N, sd_log_N = said[r]
        _believe(total[r], total[r, best[r]], tempers[0], likely)
        _margins(likely, of_place, of_force)
        for p in range(len(of_place)):
            off_x, off_y = place_mm[p, 0] - said_x, place_mm[p, 1] - said_y
            of_place[p] -= 0.5 * ((off_x / sd_x) ** 2 + (off_y / sd_y) ** 2)
        for q in range(len(of_force)):
            of_force[q] -= 0.5 * ((log_N[q] - said_log_N) / sd_log_N) ** 2
        x, y, _, _ = _moments(of_place, place_mm, (0.0, 0.0), 1.0, likely)
        _, _, xx, yy = _moments(of_place, place_mm, (x, y), tempers[1], likely)
        found[r, 0], found[r, 1], found[r, 2], found[r, 3] = x, y, _sd_mm(xx), _sd_mm(yy)
        found[r, 4] = math.exp(_mean(of_force, log_N))


@njit(cache=True, error_model="numpy")
@no_type_check
def _believe(total, least, half_temper, likely):
    for h in range(len(total)):
        likely[h] = _exp(half_temper * (least - total[h]))


@njit(cache=True, error_model="numpy")
@no_type_check
def _margins(likely, of_place, of_force):
    # Logarithms of the probabilities of places, and of forces.
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
def _moments(log, place_mm, about_mm, temper, likely):
    # Means of x and y, and of their squares about a place, of a power of the probabilities; `likely` is room.
    most, sum_, x, y, xx, yy = _most(log), 0.0, 0.0, 0.0, 0.0, 0.0
    for p in range(len(log)):
        likely[p] = _exp(temper * (log[p] - most))
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
    # Of 0 and less, to 1e-9 of itself down to -100, 5e-7 at -200: Taylor's series of a 512th, squared. The library's
    # is no vector instruction.
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

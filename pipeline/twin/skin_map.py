"""A skin as a Gaussian map: tables of a law, and pokes -> what every place and force would read, and how sure that is.

It learns in closed form from a no-load field, from pokes whose places are not known, and from labelled ones; then it
reads places, forces and their uncertainty off a reading by Bayes' rule. Places are in the board's frame, in mm; fields
in its axes, in uT. Refuses to know networks, folds and files.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Float32
from scipy.linalg import solve_triangular

from pipeline.twin.places import inside
from pipeline.twin.residual import Relative, Residual, kernel, no_residual
from pipeline.twin.tables import Tables

LAW_ERROR = 0.35  # of |dB|: rms of how far the law is off, all channels together, before it has learnt
OFFSET_uT = 320.0  # of a chip at rest (200) and of the law's own error there (250)
NOISE_uT = 4.5  # of one reading, a channel
LEFT_MIN = 0.03  # of the law's error that labels never take away
SHARE_OF_UNLABELLED = 0.2  # of a poke's weight: the law's errors at neighbouring places are not independent
LIKELY_N, ROUNDS_N = 40, 3  # hypotheses of an unlabelled poke that count; rounds of finding them again
EVEN_MM = 0.15  # so near to the labels' middle pokes lie in the mean that are spread evenly
CELL_SD_MM = 0.2  # at least, of a place: where it lies within a cell of the lattice


@dataclass(frozen=True)
class Estimate:
    """What readings say: place and its standard deviation, force, and the misfit of the likeliest hypothesis."""

    place_mm: Float[np.ndarray, "n 2"]
    sd_mm: Float[np.ndarray, "n 2"]
    force_N: Float[np.ndarray, " n"]
    misfit: Float[np.ndarray, " n"]  # chi^2 a channel: about 1 for a poke of this skin


@dataclass(frozen=True)
class Labelled:
    """Pokes at known places under known forces, and what the law misses there, solved for."""

    place_mm: Float[np.ndarray, "m 2"]
    log_N: Float[np.ndarray, " m"]
    solved: Float[np.ndarray, "m ch"]
    inverse: Float[np.ndarray, "m m"]


@dataclass(frozen=True)
class SkinMap:
    """The state of what is known of one skin: numbers in spreads about the tables' centre, and the law's errors."""

    tables: Tables
    residual: Residual
    number: Float[np.ndarray, " t"]
    cov: Float[np.ndarray, "t t"]
    labelled: Labelled | None = None
    temper: float = 1.0  # of log likelihoods: below 1, channels tell less than if each erred by itself

    @property
    def error_cov(self) -> Float[np.ndarray, "ch ch"]:
        """Covariance of the law's relative error, between channels."""
        return LAW_ERROR**2 * self.residual.share


def new_map(tables: Tables, residual: Residual | None = None) -> SkinMap:
    """Start from the spreads alone; `residual` is what the law misses on other boards of the rig."""
    t = len(tables.names)
    return SkinMap(tables, residual or no_residual(tables.mean_uT.shape[-1]), np.zeros(t), np.eye(t))


def see_rest(skin: SkinMap, noload_uT: Float[np.ndarray, " ch"]) -> SkinMap:
    """Learn from the field of the untouched skin, which every board gives for free."""
    tables = skin.tables
    return _learn(skin, tables.rest_slope_uT, noload_uT - tables.rest_uT, np.full(len(noload_uT), OFFSET_uT**2))


def see_pokes(skin: SkinMap, db_uT: Float[np.ndarray, "n ch"]) -> SkinMap:
    """Learn from pokes at unknown places: expectation maximisation over where each may have been."""
    found = skin
    for _ in range(ROUNDS_N):
        reader = Reader(found)
        weight, at = reader.likely(db_uT)
        poke, rank = np.nonzero(weight * SHARE_OF_UNLABELLED > 1e-4)
        at, weight = at[poke, rank], weight[poke, rank] * SHARE_OF_UNLABELLED
        mean_uT, slope_uT, missed = reader.mean_uT[at], reader.slope_uT[at], reader.missed[at]
        length_uT = np.linalg.norm(mean_uT, axis=1)
        cov = _with_noise(length_uT[:, None, None] ** 2 * skin.error_cov)
        off_uT = db_uT[poke] - mean_uT - length_uT[:, None] * missed
        white = np.linalg.solve(np.linalg.cholesky(cov), np.concatenate([off_uT[..., None], slope_uT], axis=2))
        var = np.repeat(1 / weight, off_uT.shape[1])
        found = _learn(skin, white[..., 1:].reshape(-1, len(skin.number)), white[..., 0].ravel(), var)
    return found


def see_even(skin: SkinMap, db_uT: Float[np.ndarray, "n ch"]) -> SkinMap:
    """Learn that pokes at unknown places lie evenly over the skin: that their mean is the labels' middle."""
    label = [skin.tables.names.index(name) for name in ("label_x_mm", "label_y_mm")]
    spread_mm = skin.tables.spreads[label]
    row = np.zeros((2, len(skin.number)))
    row[[0, 1], label] = 1.0
    found = skin
    for _ in range(2):
        off_mm = Reader(found).estimate(db_uT).place_mm.mean(axis=0)
        found = _learn(skin, row, found.number[label] + off_mm / spread_mm, (EVEN_MM / spread_mm) ** 2)
    return found


def see_labelled(
    skin: SkinMap,
    place_mm: Float[np.ndarray, "m 2"],
    force_N: Float[np.ndarray, " m"],
    db_uT: Float[np.ndarray, "m ch"],
) -> SkinMap:
    """Learn from labelled pokes: the skin's numbers first, then what the law misses near them (Gaussian process)."""
    if not len(place_mm):
        return skin
    mean_uT, slope_uT, missed = _between(skin, place_mm, force_N)
    length_uT, log_N = np.linalg.norm(mean_uT, axis=1), np.log(force_N)
    k = kernel(place_mm, place_mm, log_N, log_N) + skin.residual.noise * np.eye(len(place_mm))
    root = np.linalg.cholesky(k)
    off = (db_uT - mean_uT) / length_uT[:, None] - missed
    slope = slope_uT / length_uT[:, None, None]
    # Errors are alike between pokes (k) and between channels: white in both.
    white = solve_triangular(root, np.concatenate([off[..., None], slope], axis=2).reshape(len(off), -1), lower=True)
    white = np.linalg.solve(np.linalg.cholesky(skin.error_cov), white.reshape(*off.shape, -1))
    found = _learn(skin, white[..., 1:].reshape(-1, len(skin.number)), white[..., 0].ravel(), np.ones(off.size))
    solved = np.linalg.solve(k, off - slope @ found.number)
    return replace(found, labelled=Labelled(place_mm, log_N, solved, np.linalg.inv(k)))


@dataclass(frozen=True)
class Weighed:
    """Readings against hypotheses: chi^2, and -2 log likelihood less what all share; forces run within places."""

    chi2: Float32[np.ndarray, "n h"]
    total: Float32[np.ndarray, "n h"]
    channels_n: int

    def misfit(self) -> Float[np.ndarray, " n"]:
        """Give chi^2 a channel of each reading's likeliest hypothesis."""
        return self.chi2[np.arange(len(self.chi2)), self.total.argmin(axis=1)] / self.channels_n


class Reader:
    """A map made ready for readings: every hypothesis (place, force) with its mean and whitened covariance."""

    def __init__(self, skin: SkinMap) -> None:
        tables = skin.tables
        place_mm = np.stack(np.meshgrid(tables.axis_mm, tables.axis_mm, indexing="ij"), axis=-1).reshape(-1, 2)
        pressed = inside(place_mm)
        self.place_mm = place_mm[pressed]
        self.log_N = np.log(tables.force_N)
        forces_n, channels_n = len(self.log_N), len(tables.rest_uT)
        self._rows, self._columns = np.triu_indices(channels_n)
        self.mean_uT = tables.mean_uT.reshape(len(pressed), forces_n, channels_n)[pressed].reshape(-1, channels_n)
        self.slope_uT = tables.slope_uT.reshape(len(pressed), forces_n, channels_n, -1)[pressed]
        self.slope_uT = self.slope_uT.reshape(len(self.mean_uT), channels_n, -1)
        place_mm, log_N = np.repeat(self.place_mm, forces_n, axis=0), np.tile(self.log_N, len(self.place_mm))
        self.missed = skin.residual.at(place_mm, log_N)
        self._temper = skin.temper
        self._ready(skin, place_mm, log_N)

    def _ready(self, skin: SkinMap, place_mm: Float[np.ndarray, "h 2"], log_N: Float[np.ndarray, " h"]) -> None:
        expected_uT = self.mean_uT + self.slope_uT @ skin.number
        length_uT = np.linalg.norm(expected_uT, axis=1)
        missed, left = self.missed, np.ones(len(expected_uT))
        if skin.labelled is not None:
            of = skin.labelled
            near = kernel(place_mm, of.place_mm, log_N, of.log_N)
            missed = missed + near @ of.solved
            told = np.einsum("hm,mn,hn->h", near, of.inverse, near, optimize=True)
            left = np.maximum(1 + skin.residual.noise - told, LEFT_MIN)
        spread_uT = self.slope_uT @ np.linalg.cholesky(skin.cov)
        cov = spread_uT @ spread_uT.transpose(0, 2, 1) + (length_uT**2 * left)[:, None, None] * skin.error_cov
        root = np.linalg.cholesky(_with_noise(cov))
        white = np.linalg.inv(root)
        expected_uT = expected_uT + length_uT[:, None] * missed
        # chi^2 = d'Ad - 2 b'd + c is linear in the products of channels: a reading against some 2,500 hypotheses is one
        # product of matrices. In single precision, off by less than 0.01 where a hypothesis is likely.
        precision = white.transpose(0, 2, 1) @ white
        aimed = np.einsum("hij,hj->hi", precision, expected_uT)
        twice = np.where(self._rows == self._columns, 1.0, 2.0)
        parts = precision[:, self._rows, self._columns] * twice, -2 * aimed, (aimed * expected_uT).sum(axis=1)[:, None]
        self._chi2 = np.ascontiguousarray(np.concatenate(parts, axis=1).T, np.float32)
        self._log_det = 2 * np.log(np.einsum("hii->hi", root)).sum(axis=1).astype(np.float32)

    def likely(self, db_uT: Float[np.ndarray, "n ch"]) -> tuple[Float[np.ndarray, "n l"], np.ndarray]:
        """Give the likeliest hypotheses of each reading, and their probabilities, of 1 in sum."""
        probability = believe(self.weigh(db_uT), self._temper)
        at = np.argsort(-probability, axis=1)[:, :LIKELY_N]
        weight = np.take_along_axis(probability, at, axis=1)
        return weight / weight.sum(axis=1, keepdims=True), at

    def estimate(self, db_uT: Float[np.ndarray, "n ch"], block_n: int = 200) -> Estimate:
        """Read places and forces: the mean over all hypotheses."""
        blocks = [self.weigh(db_uT[i : i + block_n]) for i in range(0, len(db_uT), block_n)]
        return joined([self.answer(block, self._temper) for block in blocks])

    def weigh(self, db_uT: Float[np.ndarray, "n ch"]) -> Weighed:
        """Weigh every hypothesis against readings: some 50 us each."""
        read_uT = db_uT.astype(np.float32)
        products = read_uT[:, self._rows] * read_uT[:, self._columns]
        chi2 = np.concatenate([products, read_uT, np.ones((len(read_uT), 1), np.float32)], axis=1) @ self._chi2
        return Weighed(chi2, chi2 + self._log_det, db_uT.shape[1])

    def answer(self, weighed: Weighed, temper: float) -> Estimate:
        """Give places and forces, the means over all hypotheses."""
        by_place = believe(weighed, temper).reshape(len(weighed.chi2), len(self.place_mm), -1)
        of_place, of_force = by_place.sum(axis=2), by_place.sum(axis=1)
        place_mm = of_place @ self.place_mm
        var_mm2 = np.maximum(of_place @ self.place_mm**2 - place_mm**2, CELL_SD_MM**2)
        return Estimate(place_mm, np.sqrt(var_mm2), np.exp(of_force @ self.log_N), weighed.misfit())


def believe(weighed: Weighed, temper: float) -> Float[np.ndarray, "n h"]:
    """Turn log likelihoods, times a temper, into probabilities of 1 in sum."""
    total = weighed.total
    probability = np.exp(-0.5 * temper * (total - total.min(axis=1, keepdims=True)))
    return probability / probability.sum(axis=1, keepdims=True)


def joined(parts: Sequence[Estimate]) -> Estimate:
    """Put estimates one after the other."""
    return Estimate(*(np.concatenate([getattr(part, name) for part in parts]) for name in Estimate.__annotations__))


def _learn(
    skin: SkinMap, row: Float[np.ndarray, "r t"], value: Float[np.ndarray, " r"], var: Float[np.ndarray, " r"]
) -> SkinMap:
    # Linear Gaussian observations: row @ number = value + N(0, var).
    information = np.linalg.inv(skin.cov)
    gained = information + row.T @ (row / var[:, None])
    number = np.linalg.solve(gained, information @ skin.number + row.T @ (value / var))
    return replace(skin, number=number, cov=np.linalg.inv(gained))


def _with_noise(cov_uT2: Float[np.ndarray, "h ch ch"]) -> Float[np.ndarray, "h ch ch"]:
    return cov_uT2 + NOISE_uT**2 * np.eye(cov_uT2.shape[1])


def _between(
    skin: SkinMap, place_mm: Float[np.ndarray, "m 2"], force_N: Float[np.ndarray, " m"]
) -> tuple[Float[np.ndarray, "m ch"], Float[np.ndarray, "m ch t"], Relative]:
    # Linear between the lattice's places and between logarithms of forces; past the ends, the ends.
    tables = skin.tables
    axes = tables.axis_mm, tables.axis_mm, np.log(tables.force_N)
    at = np.column_stack([place_mm, np.log(force_N)])
    low, share = np.empty(at.shape, int), np.empty(at.shape)
    for i, axis in enumerate(axes):
        step = np.clip((at[:, i] - axis[0]) / (axis[1] - axis[0]), 0, len(axis) - 1)
        low[:, i] = np.minimum(step.astype(int), len(axis) - 2)
        share[:, i] = step - low[:, i]
    channels_n, numbers_n = tables.rest_slope_uT.shape
    mean_uT, slope_uT = np.zeros((len(at), channels_n)), np.zeros((len(at), channels_n, numbers_n))
    for corner in np.ndindex(2, 2, 2):
        weight = np.prod(np.where(corner, share, 1 - share), axis=1)
        i, j, k = (low + corner).T
        mean_uT = mean_uT + weight[:, None] * tables.mean_uT[i, j, k]
        slope_uT = slope_uT + weight[:, None, None] * tables.slope_uT[i, j, k]
    return mean_uT, slope_uT, skin.residual.at(place_mm, np.log(force_N))

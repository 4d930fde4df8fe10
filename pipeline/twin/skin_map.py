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

from pipeline.core.errors import SchemaError
from pipeline.twin.answers import Lattice, Likelihoods, means
from pipeline.twin.gaussians import whiten
from pipeline.twin.hypotheses import Hypotheses, NOISE_uT, lattice
from pipeline.twin.residual import Relative, Residual, kernel, no_residual
from pipeline.twin.tables import Tables

OFFSET_uT = 320.0  # of a chip at rest (200) and of the law's own error there (250)
LEFT_MIN = 0.03  # of the law's error that labels never take away
SHARE_OF_UNLABELLED = 0.2  # of a poke's weight: the law's errors at neighbouring places are not independent
ROUNDS_N = 3  # of finding again where unlabelled pokes may have been
EVEN_MM = 0.15  # so near to the labels' middle pokes lie in the mean that are spread evenly
FELT_MIN = 1e-9  # of the weight of the likeliest hypothesis: from less, pokes teach nothing that single precision holds


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
    hypotheses: Hypotheses
    number: Float[np.ndarray, " t"]
    cov: Float[np.ndarray, "t t"]
    labelled: Labelled | None = None
    temper: float = 1.0  # of log likelihoods: below 1, channels tell less than if each erred by itself

    @property
    def error_cov(self) -> Float[np.ndarray, "ch ch"]:
        """Covariance of the law's relative error, between channels."""
        return self.hypotheses.error_cov


def new_map(tables: Tables, residual: Residual | None = None) -> SkinMap:
    """Start from the spreads alone; `residual` is what the law misses on other boards of the rig."""
    t, carried = len(tables.names), residual or no_residual(tables.mean_uT.shape[-1])
    return SkinMap(tables, carried, lattice(tables, carried), np.zeros(t), np.eye(t))


def see_rest(skin: SkinMap, noload_uT: Float[np.ndarray, " ch"]) -> SkinMap:
    """Learn from the field of the untouched skin, which every board gives for free."""
    tables = skin.tables
    return _learn(skin, tables.rest_slope_uT, noload_uT - tables.rest_uT, np.full(len(noload_uT), OFFSET_uT**2))


def see_pokes(
    skin: SkinMap, db_uT: Float[np.ndarray, "n ch"], *, rounds_n: int = ROUNDS_N, reader: "Reader | None" = None
) -> SkinMap:
    """Learn from pokes at unknown places: expectation maximisation over where each may have been.

    `reader` is the skin's, where one is ready: it spares the first round the making of one.
    """
    gains, expected_uT, found = skin.hypotheses.gains, skin.hypotheses.expected_uT, skin
    for _ in range(rounds_n):
        reader = reader or Reader(found)
        weight = SHARE_OF_UNLABELLED * believe(reader.weigh(db_uT), skin.temper)
        of_all = weight.sum(axis=0)
        felt = np.flatnonzero(of_all > FELT_MIN * of_all.max())
        of_each = of_all[felt]
        off_uT = weight[:, felt].T @ db_uT.astype(np.float32) - of_each[:, None] * expected_uT[felt]
        information = (of_each @ gains.information[felt]).reshape(skin.cov.shape)
        vector = off_uT.ravel() @ gains.aim[felt].reshape(-1, len(skin.number))
        found, reader = _gain(skin, information, vector), None
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
    mean_uT, slope_uT, missed = between(skin, place_mm, force_N)
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
    likelihoods: Likelihoods
    channels_n: int

    def misfit(self) -> Float[np.ndarray, " n"]:
        """Give chi^2 a channel of each reading's likeliest hypothesis."""
        return self.chi2[np.arange(len(self.chi2)), self.likelihoods.best] / self.channels_n


class Reader:
    """A map made ready for readings: every hypothesis (place, force) with its mean and covariance, as rows."""

    def __init__(self, skin: SkinMap) -> None:
        self._of, self._temper = skin.hypotheses, skin.temper
        self.at = Lattice(self._of.place_mm, self._of.log_N)
        numbers = skin.number.astype(np.float32), np.linalg.cholesky(skin.cov).astype(np.float32)
        shape = self._of.error_cov.astype(np.float32)
        self._gaussians = whiten(self._of.linear, numbers, *self._labelled(skin), shape, NOISE_uT**2)
        unknown = ~np.isfinite(self._gaussians.log_det)
        if unknown.any():
            rule, got = "positive definite", f"{int(unknown.sum())} that are not"
            remedy = "Take the no-load reading again."
            raise SchemaError("a map of a skin", "covariances of its hypotheses", rule, got, remedy)

    def _labelled(self, skin: SkinMap) -> tuple[Float32[np.ndarray, "h ch"], Float32[np.ndarray, " h"]]:
        # What the law misses everywhere, and the part of its error that labels leave.
        missed, labelled = self._of.missed, skin.labelled
        if labelled is None:
            return missed, np.ones(len(missed), np.float32)
        place_mm, log_N = self._of.at
        near = kernel(place_mm, labelled.place_mm, log_N, labelled.log_N)
        told = ((near @ labelled.inverse) * near).sum(axis=1)
        left = np.maximum(1 + skin.residual.noise - told, LEFT_MIN)
        return (missed + near @ labelled.solved).astype(np.float32), left.astype(np.float32)

    def estimate(self, db_uT: Float[np.ndarray, "n ch"], block_n: int = 200) -> Estimate:
        """Read places and forces: the mean over all hypotheses."""
        starts = range(0, len(db_uT), block_n)
        return joined([self.answer(self.weigh(db_uT[i : i + block_n]), self._temper) for i in starts])

    def weigh(self, db_uT: Float[np.ndarray, "n ch"]) -> Weighed:
        """Weigh every hypothesis against readings."""
        chi2, total = self._gaussians.weigh(db_uT.astype(np.float32))
        return Weighed(chi2, Likelihoods(total, total.argmin(axis=1)), db_uT.shape[1])

    def answer(self, weighed: Weighed, temper: float) -> Estimate:
        """Give places and forces, the means over all hypotheses."""
        return Estimate(*means(weighed.likelihoods, self.at, temper), weighed.misfit())


def believe(weighed: Weighed, temper: float) -> Float[np.ndarray, "n h"]:
    """Turn log likelihoods, times a temper, into probabilities of 1 in sum."""
    total = weighed.likelihoods.total
    probability = np.exp(-0.5 * temper * (total - total.min(axis=1, keepdims=True)))
    return probability / probability.sum(axis=1, keepdims=True)


def joined(parts: Sequence[Estimate]) -> Estimate:
    """Put estimates one after the other."""
    if len(parts) == 1:
        return parts[0]
    return Estimate(*(np.concatenate([getattr(part, name) for part in parts]) for name in Estimate.__annotations__))


def _learn(
    skin: SkinMap, row: Float[np.ndarray, "r t"], value: Float[np.ndarray, " r"], var: Float[np.ndarray, " r"]
) -> SkinMap:
    # Linear Gaussian observations: row @ number = value + N(0, var).
    return _gain(skin, row.T @ (row / var[:, None]), row.T @ (value / var))


def _gain(skin: SkinMap, information: Float[np.ndarray, "t t"], vector: Float[np.ndarray, " t"]) -> SkinMap:
    # Gaussians in the information form: what is known and what is told add up.
    known = np.linalg.inv(skin.cov)
    cov = np.linalg.inv(known + information)
    return replace(skin, number=cov @ (known @ skin.number + vector), cov=(cov + cov.T) / 2)


def between(
    skin: SkinMap, place_mm: Float[np.ndarray, "m 2"], force_N: Float[np.ndarray, " m"]
) -> tuple[Float[np.ndarray, "m ch"], Float[np.ndarray, "m ch t"], Relative]:
    """Give means, slopes and what the law misses, linear between the lattice's places and logarithms of forces."""
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

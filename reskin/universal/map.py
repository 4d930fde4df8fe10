"""A Gaussian map of a skin: the mean and covariance of what every place and force would read, given presses."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float, Float32
from scipy.linalg import solve_triangular

from reskin.errors import SchemaError
from reskin.universal.answers import Lattice, Likelihoods, means
from reskin.universal.gaussians import Linear, side_by_side, whiten
from reskin.universal.law import Law, Setup, at_rest_uT, inside, simulate_uT, with_numbers

PITCH_MM, STEPS_N = 0.8, 22  # of the lattice of places, along x and y
FORCES_N = np.exp(np.linspace(np.log(0.05), np.log(9.5), 9))  # from a light touch to the hardest recorded press
OF_LOG = ("amplitude", "modulus_MPa")  # their spreads are of the logarithm
# Spreads of a skin's numbers about those of boards of the same rig, and about the nominal ones where no board is known.
# Assumed, wider than two recorded boards differ.
OF_RIG = {
    "seat_x_mm": 0.4, "seat_y_mm": 0.4, "rotation_deg": 1.0, "gap_mm": 0.25, "amplitude": 0.2, "label_x_mm": 0.25,
    "label_y_mm": 0.25, "modulus_MPa": 0.2, "away_um_mm": 2.0, "give_x_um": 15.0, "give_y_um": 15.0,
    "lets_go_N": 2.4, "tilt_x_deg": 0.7, "tilt_y_deg": 0.7, "label_rotation_deg": 0.5,
}  # fmt: skip
OF_NOMINAL = OF_RIG | {
    "gap_mm": 0.45, "amplitude": 0.3, "label_x_mm": 0.5, "label_y_mm": 0.5, "modulus_MPa": 0.25, "away_um_mm": 2.5,
    "give_x_um": 40.0, "give_y_um": 40.0,
}  # fmt: skip
# Nothing of a recorded board but the form of the law and the middle of its slide; modulus: Dragon Skin 10 with filler,
# 150 to 230 kPa.
NOMINAL = Law(0.0, 0.0, 0.0, 1.6, 1.4, 0.0, 0.0, 0.19, 7.0, 0.0, 0.0)
STEP = 0.4  # of a spread: over which slopes are taken


@dataclass(frozen=True)
class Tables:
    """Fields of pokes at places (board's frame) under forces: at the centre, and per spread of each number."""

    names: tuple[str, ...]
    spreads: Float[np.ndarray, " t"]
    axis_mm: Float[np.ndarray, " a"]  # of the lattice, along x and along y alike
    force_N: Float[np.ndarray, " q"]
    mean_uT: Float[np.ndarray, "a a q ch"]
    slope_uT: Float[np.ndarray, "a a q ch t"]
    rest_uT: Float[np.ndarray, " ch"]
    rest_slope_uT: Float[np.ndarray, "ch t"]


def lattice_mm() -> Float[np.ndarray, " a"]:
    """Give the places of the lattice along one axis, from the board's middle."""
    return PITCH_MM * (np.arange(STEPS_N) - (STEPS_N - 1) / 2)


def tabulate(
    centre: Law, spreads: Mapping[str, float], setup: Setup, forces_N: Float[np.ndarray, " q"] = FORCES_N
) -> Tables:
    """Simulate every place and force at the centre, and with each number moved: some 50,000 pokes, half a minute."""
    axis_mm = lattice_mm()
    places_mm = np.stack(np.meshgrid(axis_mm, axis_mm, indexing="ij"), axis=-1).reshape(-1, 2)
    place_mm = np.repeat(places_mm, len(forces_N), axis=0)
    force_N = np.tile(forces_N, len(places_mm))

    def fields_uT(law: Law) -> tuple[np.ndarray, np.ndarray]:
        read_uT = simulate_uT(law, setup, place_mm, force_N)
        return read_uT.reshape(len(axis_mm), len(axis_mm), len(forces_N), -1), at_rest_uT(law, setup).ravel()

    mean_uT, rest_uT = fields_uT(centre)
    moved = [fields_uT(spread_by(centre, name, STEP * spread)) for name, spread in spreads.items()]
    return Tables(
        names=tuple(spreads), spreads=np.array(list(spreads.values())), axis_mm=axis_mm, force_N=forces_N,
        mean_uT=mean_uT, slope_uT=np.stack([(each_uT - mean_uT) / STEP for each_uT, _ in moved], axis=-1),
        rest_uT=rest_uT, rest_slope_uT=np.stack([(each_uT - rest_uT) / STEP for _, each_uT in moved], axis=-1),
    )  # fmt: skip


def middle(laws: list[Law]) -> Law:
    """Give the centre for a further board of a rig: means of the fitted laws, its seat and turns as designed."""
    numbers = {name: np.array([asdict(law)[name] for law in laws]) for name in asdict(laws[0])}
    means = {
        name: float(np.exp(np.log(values).mean()) if name in OF_LOG else values.mean())
        for name, values in numbers.items()
    }
    return Law(**(means | {"seat_x_mm": 0.0, "seat_y_mm": 0.0, "rotation_deg": 0.0}))


def spread_by(centre: Law, name: str, by: float) -> Law:
    """Move one number of a law, in its unit or in the logarithm of it, as its spread is."""
    value = asdict(centre)[name]
    return with_numbers(centre, (name,), np.array([value * np.exp(by) if name in OF_LOG else value + by]))


Relative = Float[np.ndarray, "n ch"]  # of |dB|
LENGTH_MM, LENGTH_LOG_N = 3.0, 1.2  # over which errors are alike: their correlation is 0.74 at 2 mm and 0.2 at 6 mm
NOISE = 0.1  # of the variance, between pokes at one place
SHARED = 0.55  # of the variance, between boards
EVEN = 0.5  # of the covariance between channels is taken as the same for all: the errors of a few boards are few


@dataclass(frozen=True)
class Residual:
    """Relative errors of the law that a further board is expected to have, from those of known boards."""

    place_mm: Float[np.ndarray, "m 2"]
    log_N: Float[np.ndarray, " m"]
    solved: Float[np.ndarray, "m ch"]
    share: Float[np.ndarray, "ch ch"]  # of the errors' covariance between channels; a trace of 1
    noise: float

    def at(self, place_mm: Float[np.ndarray, "n 2"], log_N: Float[np.ndarray, " n"]) -> Relative:
        """Give the errors expected at places under forces."""
        return SHARED * kernel(place_mm, self.place_mm, log_N, self.log_N) @ self.solved


def no_residual(channels_n: int) -> Residual:
    """Expect no error anywhere, and as much uncertainty in every channel."""
    none = np.empty((0, 2)), np.empty(0), np.empty((0, channels_n))
    return Residual(*none, np.eye(channels_n) / channels_n, noise=NOISE / 2)


def carry(
    place_mm: Sequence[Float[np.ndarray, "b 2"]],
    force_N: Sequence[Float[np.ndarray, " b"]],
    missed: Sequence[Float[np.ndarray, "b ch"]],
) -> Residual:
    """Split the errors of boards into what they share and each one's own; carry what they share.

    A Gaussian process: of one board, it expects `SHARED` of that board's errors; of many, nearly their mean.
    """
    board_i = np.repeat(np.arange(len(missed)), [len(one) for one in missed])
    at_mm, log_N, off = np.concatenate(place_mm), np.log(np.concatenate(force_N)), np.concatenate(missed)
    alike = np.where(board_i[:, None] == board_i, 1.0, SHARED)
    cov = alike * kernel(at_mm, at_mm, log_N, log_N) + NOISE * np.eye(len(off))
    between, channels_n = off.T @ off, off.shape[1]
    even = np.eye(channels_n) / channels_n
    share = EVEN * even + (1 - EVEN) * between / np.trace(between)
    return Residual(at_mm, log_N, np.linalg.solve(cov, off), share, noise=NOISE / 2)


def kernel(
    a_mm: Float[np.ndarray, "n 2"], b_mm: Float[np.ndarray, "m 2"], a_log_N: Float[np.ndarray, " n"],
    b_log_N: Float[np.ndarray, " m"],
) -> Float[np.ndarray, "n m"]:  # fmt: skip
    """Give how alike errors are: squared exponential over place and logarithm of force."""
    apart_mm2 = ((a_mm[:, None] - b_mm[None]) ** 2).sum(axis=2)
    apart_log2 = (a_log_N[:, None] - b_log_N[None]) ** 2
    return np.exp(-apart_mm2 / (2 * LENGTH_MM**2) - apart_log2 / (2 * LENGTH_LOG_N**2))


LAW_ERROR = 0.35  # of |dB|: rms of how far the law is off, all channels together, before it has learnt
NOISE_uT = 4.5  # of one reading, a channel


@dataclass(frozen=True)
class Gains:
    """What an unlabelled poke tells of a skin's numbers, by the hypothesis it is believed to be."""

    information: Float32[np.ndarray, "h tt"]
    aim: Float32[np.ndarray, "h ch t"]  # times how far it is off, channel by channel


@dataclass(frozen=True)
class Hypotheses:
    """Places of a lattice under some forces; forces run within places. In single precision what readings meet."""

    place_mm: Float[np.ndarray, "p 2"]
    log_N: Float[np.ndarray, " q"]
    mean_uT: Float32[np.ndarray, "h ch"]
    slope_uT: Float32[np.ndarray, "h ch t"]
    missed: Float32[np.ndarray, "h ch"]
    error_cov: Float[np.ndarray, "ch ch"]

    @property
    def at(self) -> tuple[Float[np.ndarray, "h 2"], Float[np.ndarray, " h"]]:
        """Give the place and the logarithm of the force of each hypothesis."""
        return np.repeat(self.place_mm, len(self.log_N), axis=0), np.tile(self.log_N, len(self.place_mm))

    @cached_property
    def linear(self) -> Linear:
        """Lay means and slopes out as they are made ready for readings."""
        return side_by_side(self.mean_uT, self.slope_uT)

    @cached_property
    def gains(self) -> Gains:
        """Weigh what a poke tells of the numbers by how far the law may be off before it has learnt."""
        slope_uT, h = self.slope_uT.astype(float), len(self.mean_uT)
        length2_uT2 = (self.mean_uT.astype(float) ** 2).sum(axis=1)
        cov = with_noise(length2_uT2[:, None, None] * self.error_cov)
        aim = np.linalg.solve(cov, slope_uT)
        information = (aim.transpose(0, 2, 1) @ slope_uT).reshape(h, -1)
        return Gains(information.astype(np.float32), aim.astype(np.float32))

    @cached_property
    def expected_uT(self) -> Float32[np.ndarray, "h ch"]:
        """Give what is expected before anything is learnt, with what the law misses on known boards."""
        return self.mean_uT + np.linalg.norm(self.mean_uT, axis=1, keepdims=True) * self.missed


def lattice(tables: Tables, residual: Residual) -> Hypotheses:
    """Lay out the tables' places that can be pressed."""
    place_mm = np.stack(np.meshgrid(tables.axis_mm, tables.axis_mm, indexing="ij"), axis=-1).reshape(-1, 2)
    taken = inside(place_mm)
    log_N, channels_n = np.log(tables.force_N), len(tables.rest_uT)
    mean_uT = tables.mean_uT.reshape(len(place_mm), len(log_N), -1)[taken].reshape(-1, channels_n)
    slope_uT = tables.slope_uT.reshape(len(place_mm), len(log_N), -1)[taken].reshape(*mean_uT.shape, -1)
    taken_mm = place_mm[taken]
    missed = residual.at(np.repeat(taken_mm, len(log_N), axis=0), np.tile(log_N, len(taken_mm)))
    mean_uT, slope_uT, missed = (part.astype(np.float32) for part in (mean_uT, slope_uT, missed))
    return Hypotheses(taken_mm, log_N, mean_uT, slope_uT, missed, LAW_ERROR**2 * residual.share)


def with_noise(cov_uT2: Float[np.ndarray, "h ch ch"]) -> Float[np.ndarray, "h ch ch"]:
    """Add a reading's noise to covariances."""
    return cov_uT2 + NOISE_uT**2 * np.eye(cov_uT2.shape[1])


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

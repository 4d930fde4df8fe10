"""The map: a Gaussian model of the readings of one skin for every place and force, conditioned on the skin's data.

Its prior consists of tables of simulated fields, linear in the skin's parameters, and of a Gaussian process for the
error of the law.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float, Float32, Int64
from scipy.linalg import solve_triangular

from reskin.display import one_line
from reskin.errors import SchemaError
from reskin.universal.kernels import Lattice, LinearMeans, in_blocks, means, whiten
from reskin.universal.law import Law, Setup, at_rest_uT, inside, simulate_uT, with_parameters

PITCH_MM, STEPS_N = 0.8, 22  # pitch and number of places of the lattice, along x and y
FORCES_N = np.exp(np.linspace(np.log(0.05), np.log(9.5), 9))  # from a light touch to the hardest recorded press
LOGARITHMIC = ("amplitude", "modulus_MPa")  # parameters whose spreads are those of the logarithm
# Standard deviations of a skin's parameters: about those of boards of the same rig, or about the nominal ones if no
# board is known. Assumed, and larger than the difference of two recorded boards.
RIG_SPREADS = {
    "seat_x_mm": 0.4, "seat_y_mm": 0.4, "rotation_deg": 1.0, "gap_mm": 0.25, "amplitude": 0.2, "label_x_mm": 0.25,
    "label_y_mm": 0.25, "modulus_MPa": 0.2, "away_um_mm": 2.0, "give_x_um": 15.0, "give_y_um": 15.0,
    "lets_go_N": 2.4, "tilt_x_deg": 0.7, "tilt_y_deg": 0.7, "label_rotation_deg": 0.5,
}  # fmt: skip
NOMINAL_SPREADS = RIG_SPREADS | {
    "gap_mm": 0.45, "amplitude": 0.3, "label_x_mm": 0.5, "label_y_mm": 0.5, "modulus_MPa": 0.25, "away_um_mm": 2.5,
    "give_x_um": 40.0, "give_y_um": 40.0,
}  # fmt: skip
# Only the form of the law and the mean of its slide come from recorded boards. The modulus is that of Dragon Skin 10
# with filler, 150 to 230 kPa.
NOMINAL = Law(0.0, 0.0, 0.0, 1.6, 1.4, 0.0, 0.0, 0.19, 7.0, 0.0, 0.0)
STEP = 0.4  # step of the finite differences for slopes, in spreads


@dataclass(frozen=True)
class Tables:
    """Fields of presses by place (board's frame) and force, for the central law, and their slopes by parameter."""

    names: tuple[str, ...]
    spreads: Float[np.ndarray, " t"]
    axis_mm: Float[np.ndarray, " a"]  # places of the lattice along x, and along y
    force_N: Float[np.ndarray, " q"]
    mean_uT: Float[np.ndarray, "a a q ch"]
    slope_uT: Float[np.ndarray, "a a q ch t"]
    rest_uT: Float[np.ndarray, " ch"]
    rest_slope_uT: Float[np.ndarray, "ch t"]

    __repr__ = one_line


def lattice_mm() -> Float[np.ndarray, " a"]:
    """Return the places of the lattice along one axis, relative to the board's centre."""
    return PITCH_MM * (np.arange(STEPS_N) - (STEPS_N - 1) / 2)


def tabulate(
    centre: Law, spreads: Mapping[str, float], setup: Setup, forces_N: Float[np.ndarray, " q"] = FORCES_N
) -> Tables:
    """Simulate every place and force for a central law, and with each parameter changed: 50,000 presses, 30 s."""
    axis_mm = lattice_mm()
    places_mm = np.stack(np.meshgrid(axis_mm, axis_mm, indexing="ij"), axis=-1).reshape(-1, 2)
    place_mm = np.repeat(places_mm, len(forces_N), axis=0)
    force_N = np.tile(forces_N, len(places_mm))

    def fields_uT(law: Law) -> tuple[np.ndarray, np.ndarray]:
        read_uT = simulate_uT(law, setup, place_mm, force_N)
        return read_uT.reshape(len(axis_mm), len(axis_mm), len(forces_N), -1), at_rest_uT(law, setup).ravel()

    mean_uT, rest_uT = fields_uT(centre)
    moved = [fields_uT(perturb(centre, name, STEP * spread)) for name, spread in spreads.items()]
    return Tables(
        names=tuple(spreads), spreads=np.array(list(spreads.values())), axis_mm=axis_mm, force_N=forces_N,
        mean_uT=mean_uT, slope_uT=np.stack([(each_uT - mean_uT) / STEP for each_uT, _ in moved], axis=-1),
        rest_uT=rest_uT, rest_slope_uT=np.stack([(each_uT - rest_uT) / STEP for _, each_uT in moved], axis=-1),
    )  # fmt: skip


def mean_law(laws: list[Law]) -> Law:
    """Return the prior mean for a further board of a rig: means of the fitted laws, nominal seat and rotation."""
    by_name = {name: np.array([asdict(law)[name] for law in laws]) for name in asdict(laws[0])}
    means = {
        name: float(np.exp(np.log(values).mean()) if name in LOGARITHMIC else values.mean())
        for name, values in by_name.items()
    }
    return Law(**(means | {"seat_x_mm": 0.0, "seat_y_mm": 0.0, "rotation_deg": 0.0}))


def perturb(centre: Law, name: str, by: float) -> Law:
    """Add to one parameter of a law, or to its logarithm if its spread is that of the logarithm."""
    value = asdict(centre)[name]
    return with_parameters(centre, (name,), np.array([value * np.exp(by) if name in LOGARITHMIC else value + by]))


Relative = Float[np.ndarray, "n ch"]  # relative to |dB|
LENGTH_MM, LENGTH_LOG_N = 3.0, 1.2  # length scales of the errors: a correlation of 0.74 at 2 mm and 0.2 at 6 mm
NOISE = 0.1  # part of the variance that differs between presses at one place
SHARED = 0.55  # part of the variance that boards have in common
EVEN = 0.5  # weight of a covariance that is equal for all channels, as few boards do not determine the covariance


@dataclass(frozen=True)
class Residual:
    """Relative errors of the law that are expected on a further board, from known boards (a Gaussian process)."""

    place_mm: Float[np.ndarray, "m 2"]
    log_N: Float[np.ndarray, " m"]
    solved: Float[np.ndarray, "m ch"]
    share: Float[np.ndarray, "ch ch"]  # covariance between channels, with a trace of 1
    noise: float

    def at(self, place_mm: Float[np.ndarray, "n 2"], log_N: Float[np.ndarray, " n"]) -> Relative:
        """Return the errors expected for these places and forces."""
        return SHARED * kernel(place_mm, self.place_mm, log_N, self.log_N) @ self.solved


def no_residual(channels_n: int) -> Residual:
    """Return the residual without known boards: zero, and equally uncertain in every channel."""
    none = np.empty((0, 2)), np.empty(0), np.empty((0, channels_n))
    return Residual(*none, np.eye(channels_n) / channels_n, noise=NOISE / 2)


def fit_residual(
    place_mm: Sequence[Float[np.ndarray, "b 2"]],
    force_N: Sequence[Float[np.ndarray, " b"]],
    errors: Sequence[Float[np.ndarray, "b ch"]],
) -> Residual:
    """Fit a Gaussian process to the law's relative errors on known boards, with a common part and a part per board.

    From one board, it expects `SHARED` of that board's errors on a further board; from many boards, nearly their mean.
    """
    board_i = np.repeat(np.arange(len(errors)), [len(one) for one in errors])
    at_mm, log_N, off = np.concatenate(place_mm), np.log(np.concatenate(force_N)), np.concatenate(errors)
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
    """Return correlations of errors: squared exponential in place and logarithm of force."""
    apart_mm2 = ((a_mm[:, None] - b_mm[None]) ** 2).sum(axis=2)
    apart_log2 = (a_log_N[:, None] - b_log_N[None]) ** 2
    return np.exp(-apart_mm2 / (2 * LENGTH_MM**2) - apart_log2 / (2 * LENGTH_LOG_N**2))


LAW_ERROR = 0.35  # rms error of the law relative to |dB|, over all channels, before conditioning
NOISE_uT = 4.5  # standard deviation of a reading, per channel


@dataclass(frozen=True)
class Information:
    """The information about the parameters that an unlabelled press adds under each hypothesis."""

    matrix: Float32[np.ndarray, "h tt"]
    per_uT: Float32[np.ndarray, "h ch t"]  # information vector per deviation of a channel


@dataclass(frozen=True)
class Hypotheses:
    """Places of the lattice with the tabulated forces (the force index varies fastest), and their expected fields."""

    place_mm: Float[np.ndarray, "p 2"]
    log_N: Float[np.ndarray, " q"]
    mean_uT: Float32[np.ndarray, "h ch"]
    slope_uT: Float32[np.ndarray, "h ch t"]
    residual: Float32[np.ndarray, "h ch"]
    error_cov: Float[np.ndarray, "ch ch"]

    __repr__ = one_line

    @property
    def at(self) -> tuple[Float[np.ndarray, "h 2"], Float[np.ndarray, " h"]]:
        """Place and logarithm of the force of each hypothesis."""
        return np.repeat(self.place_mm, len(self.log_N), axis=0), np.tile(self.log_N, len(self.place_mm))

    @cached_property
    def linear(self) -> LinearMeans:
        """Means and slopes, arranged for the compiled loops."""
        return in_blocks(self.mean_uT, self.slope_uT)

    @cached_property
    def information(self) -> Information:
        """Information of an unlabelled press, with the law's error before conditioning as noise."""
        slope_uT, h = self.slope_uT.astype(float), len(self.mean_uT)
        length2_uT2 = (self.mean_uT.astype(float) ** 2).sum(axis=1)
        cov = with_noise(length2_uT2[:, None, None] * self.error_cov)
        per_uT = np.linalg.solve(cov, slope_uT)
        matrix = (per_uT.transpose(0, 2, 1) @ slope_uT).reshape(h, -1)
        return Information(matrix.astype(np.float32), per_uT.astype(np.float32))

    @cached_property
    def expected_uT(self) -> Float32[np.ndarray, "h ch"]:
        """Fields expected before conditioning, including the residual from known boards."""
        return self.mean_uT + np.linalg.norm(self.mean_uT, axis=1, keepdims=True) * self.residual


def lattice(tables: Tables, residual: Residual) -> Hypotheses:
    """Return the hypotheses: the places of the tables that can be pressed, with each force."""
    place_mm = np.stack(np.meshgrid(tables.axis_mm, tables.axis_mm, indexing="ij"), axis=-1).reshape(-1, 2)
    taken = inside(place_mm)
    log_N, channels_n = np.log(tables.force_N), len(tables.rest_uT)
    mean_uT = tables.mean_uT.reshape(len(place_mm), len(log_N), -1)[taken].reshape(-1, channels_n)
    slope_uT = tables.slope_uT.reshape(len(place_mm), len(log_N), -1)[taken].reshape(*mean_uT.shape, -1)
    taken_mm = place_mm[taken]
    expected = residual.at(np.repeat(taken_mm, len(log_N), axis=0), np.tile(log_N, len(taken_mm)))
    mean_uT, slope_uT, expected = (part.astype(np.float32) for part in (mean_uT, slope_uT, expected))
    return Hypotheses(taken_mm, log_N, mean_uT, slope_uT, expected, LAW_ERROR**2 * residual.share)


def with_noise(cov_uT2: Float[np.ndarray, "h ch ch"]) -> Float[np.ndarray, "h ch ch"]:
    """Add the noise of a reading to covariances."""
    return cov_uT2 + NOISE_uT**2 * np.eye(cov_uT2.shape[1])


OFFSET_uT = 320.0  # standard deviation of the no-load field: a chip's offset (200) and the law's own error (250)
SHARE_MIN = 0.03  # share of the law's variance that remains with any number of labels
PRESS_WEIGHT = 0.2  # weight of an unlabelled press, as the law's errors at neighbouring places are not independent
ROUNDS_N = 3  # rounds of expectation maximisation
EVEN_MM = 0.15  # standard deviation of the mean place of evenly spread presses about the labels' centre
WEIGHT_MIN = 1e-9  # relative to the largest weight; hypotheses below this are lost in single precision


@dataclass(frozen=True)
class Estimate:
    """Estimates for readings: place and standard deviation, force, and the misfit of the most likely hypothesis."""

    place_mm: Float[np.ndarray, "n 2"]
    sd_mm: Float[np.ndarray, "n 2"]
    force_N: Float[np.ndarray, " n"]
    misfit: Float[np.ndarray, " n"]  # chi^2 per channel: about 1 for a press of this skin


def concatenate(parts: Sequence[Estimate]) -> Estimate:
    """Concatenate estimates."""
    if len(parts) == 1:
        return parts[0]
    return Estimate(*(np.concatenate([getattr(part, name) for part in parts]) for name in Estimate.__annotations__))


@dataclass(frozen=True)
class Likelihoods:
    """Likelihoods of hypotheses given readings."""

    chi2: Float32[np.ndarray, "n h"]
    deviance: Float32[np.ndarray, "n h"]  # -2 log likelihood, up to a constant
    best: Int64[np.ndarray, " n"]  # the most likely hypothesis
    channels_n: int

    def misfit(self) -> Float[np.ndarray, " n"]:
        """Return chi^2 per channel of each reading's most likely hypothesis."""
        return self.chi2[np.arange(len(self.chi2)), self.best] / self.channels_n

    def probabilities(self) -> Float[np.ndarray, "n h"]:
        """Return the posterior probability of each hypothesis."""
        likelihood = np.exp(-0.5 * (self.deviance - self.deviance.min(axis=1, keepdims=True)))
        return likelihood / likelihood.sum(axis=1, keepdims=True)


@dataclass(frozen=True)
class Labelled:
    """Presses with known places and forces, and the solved Gaussian process of the law's errors there."""

    place_mm: Float[np.ndarray, "m 2"]
    log_N: Float[np.ndarray, " m"]
    solved: Float[np.ndarray, "m ch"]
    inverse: Float[np.ndarray, "m m"]


@dataclass(frozen=True)
class SkinMap:
    """Posterior of one skin: its parameters, as deviations from the central law in spreads, and the law's errors."""

    tables: Tables
    residual: Residual
    hypotheses: Hypotheses
    mean: Float[np.ndarray, " t"]
    cov: Float[np.ndarray, "t t"]
    labelled: Labelled | None = None

    __repr__ = one_line

    @property
    def error_cov(self) -> Float[np.ndarray, "ch ch"]:
        """Covariance of the law's relative error between channels."""
        return self.hypotheses.error_cov

    @cached_property
    def evaluator(self) -> "MapEvaluator":
        """The map, prepared for readings."""
        return MapEvaluator(self)


class MapEvaluator:
    """A map prepared for readings: the whitened Gaussian of every hypothesis."""

    def __init__(self, skin: SkinMap) -> None:
        self._hypotheses = skin.hypotheses
        self.lattice = Lattice(skin.hypotheses.place_mm, skin.hypotheses.log_N)
        parameters = skin.mean.astype(np.float32), np.linalg.cholesky(skin.cov).astype(np.float32)
        error_cov = skin.error_cov.astype(np.float32)
        self._gaussians = whiten(skin.hypotheses.linear, parameters, *self._errors(skin), error_cov, NOISE_uT**2)
        unknown = ~np.isfinite(self._gaussians.log_det)
        if unknown.any():
            what = f"{int(unknown.sum())} covariances of its hypotheses are not positive definite"
            raise SchemaError(f"a map of a skin: {what}. Take the no-load reading again.")

    def _errors(self, skin: SkinMap) -> tuple[Float32[np.ndarray, "h ch"], Float32[np.ndarray, " h"]]:
        """Return the law's expected errors, and the share of their variance that remains given the labels."""
        expected, labelled = skin.hypotheses.residual, skin.labelled
        if labelled is None:
            return expected, np.ones(len(expected), np.float32)
        place_mm, log_N = skin.hypotheses.at
        near = kernel(place_mm, labelled.place_mm, log_N, labelled.log_N)
        explained = ((near @ labelled.inverse) * near).sum(axis=1)
        share = np.maximum(1 + skin.residual.noise - explained, SHARE_MIN)
        return (expected + near @ labelled.solved).astype(np.float32), share.astype(np.float32)

    def evaluate(self, db_uT: Float[np.ndarray, "n ch"]) -> Likelihoods:
        """Return the likelihood of every hypothesis given readings."""
        chi2, deviance = self._gaussians.evaluate(db_uT.astype(np.float32))
        return Likelihoods(chi2, deviance, deviance.argmin(axis=1), db_uT.shape[1])

    def mean(self, of: Likelihoods, power: float) -> Estimate:
        """Estimate places and forces as means over all hypotheses, for a power of their likelihoods."""
        return Estimate(*means(of.deviance, of.best, self.lattice, power), of.misfit())

    def estimate(self, db_uT: Float[np.ndarray, "n ch"], block_n: int = 200) -> Estimate:
        """Estimate places and forces of readings as means over all hypotheses."""
        starts = range(0, len(db_uT), block_n)
        return concatenate([self.mean(self.evaluate(db_uT[i : i + block_n]), 1.0) for i in starts])


def new_map(tables: Tables, residual: Residual | None = None) -> SkinMap:
    """Return the prior map; `residual` is the error of the law from other boards of the rig."""
    t, expected = len(tables.names), residual or no_residual(tables.mean_uT.shape[-1])
    return SkinMap(tables, expected, lattice(tables, expected), np.zeros(t), np.eye(t))


def condition_on_noload(skin: SkinMap, noload_uT: Float[np.ndarray, " ch"]) -> SkinMap:
    """Condition on the no-load field."""
    tables = skin.tables
    return _condition(skin, tables.rest_slope_uT, noload_uT - tables.rest_uT, np.full(len(noload_uT), OFFSET_uT**2))


def condition_on_presses(skin: SkinMap, db_uT: Float[np.ndarray, "n ch"], rounds_n: int = ROUNDS_N) -> SkinMap:
    """Condition on presses at unknown places, by expectation maximisation over their places and forces."""
    information, expected_uT, found = skin.hypotheses.information, skin.hypotheses.expected_uT, skin
    for _ in range(rounds_n):
        weight = PRESS_WEIGHT * found.evaluator.evaluate(db_uT).probabilities()
        of_all = weight.sum(axis=0)
        kept = np.flatnonzero(of_all > WEIGHT_MIN * of_all.max())
        of_each = of_all[kept]
        off_uT = weight[:, kept].T @ db_uT.astype(np.float32) - of_each[:, None] * expected_uT[kept]
        matrix = (of_each @ information.matrix[kept]).reshape(skin.cov.shape)
        vector = off_uT.ravel() @ information.per_uT[kept].reshape(-1, len(skin.mean))
        found = _add_information(skin, matrix, vector)
    return found


def condition_on_even_presses(skin: SkinMap, db_uT: Float[np.ndarray, "n ch"]) -> SkinMap:
    """Condition on presses that are evenly spread over the skin, whose mean place is the labels' centre."""
    label = [skin.tables.names.index(name) for name in ("label_x_mm", "label_y_mm")]
    spread_mm = skin.tables.spreads[label]
    row = np.zeros((2, len(skin.mean)))
    row[[0, 1], label] = 1.0
    found = skin
    for _ in range(2):
        off_mm = found.evaluator.estimate(db_uT).place_mm.mean(axis=0)
        found = _condition(skin, row, found.mean[label] + off_mm / spread_mm, (EVEN_MM / spread_mm) ** 2)
    return found


def condition_on_labels(
    skin: SkinMap,
    place_mm: Float[np.ndarray, "m 2"],
    force_N: Float[np.ndarray, " m"],
    db_uT: Float[np.ndarray, "m ch"],
) -> SkinMap:
    """Condition on presses at known places: the parameters first, then the law's errors near them."""
    if not len(place_mm):
        return skin
    mean_uT, slope_uT, expected = interpolate(skin, place_mm, force_N)
    length_uT, log_N = np.linalg.norm(mean_uT, axis=1), np.log(force_N)
    k = kernel(place_mm, place_mm, log_N, log_N) + skin.residual.noise * np.eye(len(place_mm))
    root = np.linalg.cholesky(k)
    off = (db_uT - mean_uT) / length_uT[:, None] - expected
    slope = slope_uT / length_uT[:, None, None]
    # Errors are correlated between presses (k) and between channels (error_cov): whiten both.
    white = solve_triangular(root, np.concatenate([off[..., None], slope], axis=2).reshape(len(off), -1), lower=True)
    white = np.linalg.solve(np.linalg.cholesky(skin.error_cov), white.reshape(*off.shape, -1))
    found = _condition(skin, white[..., 1:].reshape(-1, len(skin.mean)), white[..., 0].ravel(), np.ones(off.size))
    solved = np.linalg.solve(k, off - slope @ found.mean)
    return replace(found, labelled=Labelled(place_mm, log_N, solved, np.linalg.inv(k)))


def _condition(
    skin: SkinMap, row: Float[np.ndarray, "r t"], value: Float[np.ndarray, " r"], var: Float[np.ndarray, " r"]
) -> SkinMap:
    """Condition on linear observations: row @ parameters = value + N(0, var)."""
    return _add_information(skin, row.T @ (row / var[:, None]), row.T @ (value / var))


def _add_information(skin: SkinMap, matrix: Float[np.ndarray, "t t"], vector: Float[np.ndarray, " t"]) -> SkinMap:
    """Add observations to the parameters' Gaussian, in information form."""
    known = np.linalg.inv(skin.cov)
    cov = np.linalg.inv(known + matrix)
    return replace(skin, mean=cov @ (known @ skin.mean + vector), cov=(cov + cov.T) / 2)


def interpolate(
    skin: SkinMap, place_mm: Float[np.ndarray, "m 2"], force_N: Float[np.ndarray, " m"]
) -> tuple[Float[np.ndarray, "m ch"], Float[np.ndarray, "m ch t"], Relative]:
    """Interpolate means, slopes and residuals linearly between the lattice's places and logarithms of forces."""
    tables = skin.tables
    axes = tables.axis_mm, tables.axis_mm, np.log(tables.force_N)
    at = np.column_stack([place_mm, np.log(force_N)])
    low, share = np.empty(at.shape, int), np.empty(at.shape)
    for i, axis in enumerate(axes):
        step = np.clip((at[:, i] - axis[0]) / (axis[1] - axis[0]), 0, len(axis) - 1)
        low[:, i] = np.minimum(step.astype(int), len(axis) - 2)
        share[:, i] = step - low[:, i]
    channels_n, parameters_n = tables.rest_slope_uT.shape
    mean_uT, slope_uT = np.zeros((len(at), channels_n)), np.zeros((len(at), channels_n, parameters_n))
    for corner in np.ndindex(2, 2, 2):
        weight = np.prod(np.where(corner, share, 1 - share), axis=1)
        i, j, k = (low + corner).T
        mean_uT = mean_uT + weight[:, None] * tables.mean_uT[i, j, k]
        slope_uT = slope_uT + weight[:, None, None] * tables.slope_uT[i, j, k]
    return mean_uT, slope_uT, skin.residual.at(place_mm, np.log(force_N))


def expected_gain(
    skin: SkinMap, place_mm: Float[np.ndarray, "c 2"], force_N: Float[np.ndarray, " c"]
) -> Float[np.ndarray, " c"]:
    """Return how much a labelled press at each place is expected to reduce the variance of fields over the skin.

    The variance is relative to |dB|, summed over channels, and averaged over places at the median of the map's forces.
    It is conditional on earlier labels.
    """
    hypotheses, error_cov, gains = skin.hypotheses, skin.error_cov, []
    every = slice(len(hypotheses.log_N) // 2, None, len(hypotheses.log_N))
    mean_uT, slope_uT = (part[every].astype(float) for part in (hypotheses.mean_uT, hypotheses.slope_uT))
    of_all = slope_uT / np.linalg.norm(mean_uT, axis=1)[:, None, None] @ skin.cov
    all_mm, all_log_N = (part[every] for part in hypotheses.at)
    press_uT, press_slope_uT, _ = interpolate(skin, place_mm, force_N)
    log_N = np.log(force_N)
    shared = _remaining_errors(skin, all_mm, all_log_N, place_mm, log_N)
    for i, length_uT in enumerate(np.linalg.norm(press_uT, axis=1)):
        slope, one = press_slope_uT[i] / length_uT, slice(i, i + 1)
        own = _remaining_errors(skin, place_mm[one], log_N[one], place_mm[one], log_N[one])[0, 0]
        cov = slope @ skin.cov @ slope.T + (own + skin.residual.noise) * error_cov
        cov += (NOISE_uT / length_uT) ** 2 * np.eye(len(cov))
        with_all = (of_all @ slope.T + shared[:, i, None, None] * error_cov).reshape(-1, len(cov))
        gains.append(float(((with_all @ np.linalg.inv(cov)) * with_all).sum() / len(all_mm)))
    return np.array(gains)


def _remaining_errors(
    skin: SkinMap, a_mm: Float[np.ndarray, "n 2"], a_log_N: Float[np.ndarray, " n"], b_mm: Float[np.ndarray, "m 2"],
    b_log_N: Float[np.ndarray, " m"],
) -> Float[np.ndarray, "n m"]:  # fmt: skip
    """Return the covariance between the law's errors at two sets of presses, given the labels."""
    prior, labelled = kernel(a_mm, b_mm, a_log_N, b_log_N), skin.labelled
    if labelled is None:
        return prior
    to_a = kernel(a_mm, labelled.place_mm, a_log_N, labelled.log_N)
    to_b = kernel(b_mm, labelled.place_mm, b_log_N, labelled.log_N)
    return prior - to_a @ labelled.inverse @ to_b.T

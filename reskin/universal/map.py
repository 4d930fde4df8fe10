"""The map: a probabilistic model of one skin.

For each place and force of a press, the map gives a normal distribution of the reading. To estimate the place and the
force of a reading, Bayes' rule turns these distributions into the probability of each place and force.

This module uses the following terms:

- The law (`reskin.universal.law`) is a simulation that gives the field change of a press at any place with any force.
  Its parameters, such as the gap between skin and chips, differ from skin to skin. The central law has the mean
  parameters.
- The error of the law is the difference between the field change of a skin and the field change that the law gives.
  It is given relative to the size of the field change, |dB|. A Gaussian process describes how this error varies with
  place and force.
- A hypothesis is a pair of a place and a force that a press may have.
- The map is conditioned on data of a skin: each datum (no-load field, press at an unknown place, labelled press)
  changes the distribution of the skin's parameters and of the error of the law.

Before conditioning, the parameters are normally distributed about those of the central law. A standard deviation of
this distribution is called the spread of a parameter. Tables contain the field changes of the central law and their
derivatives with respect to the parameters, so that the field change for other parameters can be computed
by linear extrapolation.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from math import ceil

import numpy as np
from jaxtyping import Float, Float32, Int64
from scipy.linalg import solve_triangular
from scipy.ndimage import gaussian_filter, map_coordinates

from reskin.display import one_line
from reskin.errors import SchemaError
from reskin.universal.kernels import Lattice, LinearMeans, in_blocks, means, whiten
from reskin.universal.law import (
    MARGIN_MM,
    PAPER_AREA,
    Area,
    Law,
    Setup,
    at_rest_uT,
    inside,
    simulate_uT,
    with_parameters,
)

PITCH_MM, STEPS_MAX_N = 0.8, 28  # lattice of places: pitch, and largest number of places along each axis
FORCES_N = np.exp(np.linspace(np.log(0.05), np.log(9.5), 9))  # from a light touch to the hardest recorded press
LOGARITHMIC = ("amplitude", "modulus_MPa")  # the spread of these parameters is the standard deviation of the logarithm
# Spreads of the parameters. If other boards of the same rig are known, a skin's parameters differ from the mean of
# these boards by `RIG_SPREADS`. If no board is known, they differ from the nominal parameters by `NOMINAL_SPREADS`. All
# values are assumed.
RIG_SPREADS = {
    "seat_x_mm": 0.4, "seat_y_mm": 0.4, "rotation_deg": 1.0, "gap_mm": 0.25, "amplitude": 0.2, "label_x_mm": 0.25,
    "label_y_mm": 0.25, "modulus_MPa": 0.2, "away_um_mm": 2.0, "give_x_um": 15.0, "give_y_um": 15.0,
    "lets_go_N": 2.4, "tilt_x_deg": 0.7, "tilt_y_deg": 0.7, "label_rotation_deg": 0.5,
}  # fmt: skip
NOMINAL_SPREADS = RIG_SPREADS | {
    "gap_mm": 0.45, "amplitude": 0.3, "label_x_mm": 0.5, "label_y_mm": 0.5, "modulus_MPa": 0.25, "away_um_mm": 2.5,
    "give_x_um": 40.0, "give_y_um": 40.0,
}  # fmt: skip
# Nominal parameters. The form of the law and the parameters gap, amplitude, `away_um_mm` and `lets_go_N` come from the
# recorded boards of scene lab. Many other pairs of gap and amplitude fit a board about equally well. The modulus
# belongs to the stiffening of `Law`; simulated scenes have another pair (nominal.yaml: 330 kPa, no stiffening). See
# `Law` for the meaning of each parameter.
NOMINAL = Law(0.0, 0.0, 0.0, 1.6, 1.5, 0.0, 0.0, 0.19, 7.0, 0.0, 0.0)
# To compute a derivative by finite differences, each parameter is changed by this value times its spread.
STEP = 0.4


@dataclass(frozen=True)
class Tables:
    """Field changes and no-load field of the central law, and their derivatives with respect to the parameters.

    Field changes are tabulated by place (in the board's frame) and force. A derivative is the change that is caused by
    changing a parameter by its spread, which is its standard deviation over skins.
    """

    names: tuple[str, ...]
    spreads: Float[np.ndarray, " t"]
    axis_mm: Float[np.ndarray, " a"]  # coordinates of the lattice's places, for x and for y
    force_N: Float[np.ndarray, " q"]
    mean_uT: Float[np.ndarray, "a a q ch"]
    slope_uT: Float[np.ndarray, "a a q ch t"]
    rest_uT: Float[np.ndarray, " ch"]
    rest_slope_uT: Float[np.ndarray, "ch t"]
    area: Area = PAPER_AREA  # only places within this area are hypotheses

    __repr__ = one_line


def lattice_mm(area: Area = PAPER_AREA) -> Float[np.ndarray, " a"]:
    """Return the coordinates of the lattice's places along one axis, relative to the board's centre.

    The pitch is `PITCH_MM` or slightly less. It is larger only for areas wider than 20.8 mm, which have `STEPS_MAX_N`
    places along each axis, so that the time for the simulation is limited.
    """
    width_mm = 2 * (float(area.half_mm.max()) + MARGIN_MM)
    steps_n = min(ceil(width_mm / PITCH_MM - 1e-9) + 1, STEPS_MAX_N)
    return width_mm / (steps_n - 1) * (np.arange(steps_n) - (steps_n - 1) / 2)


def tabulate(
    centre: Law, spreads: Mapping[str, float], setup: Setup, forces_N: Float[np.ndarray, " q"] = FORCES_N
) -> Tables:
    """Make the tables: simulate presses at all places and with all forces.

    The presses are simulated for the central law, and for each parameter with a law in which this parameter is slightly
    changed. With the default forces, there are 4,356 presses for each law and 70,000 in total. This takes about 30 s.
    """
    axis_mm = lattice_mm(setup.area)
    places_mm = np.stack(np.meshgrid(axis_mm, axis_mm, indexing="ij"), axis=-1).reshape(-1, 2)
    place_mm = np.repeat(places_mm, len(forces_N), axis=0)
    force_N = np.tile(forces_N, len(places_mm))

    def fields_uT(law: Law) -> tuple[np.ndarray, np.ndarray]:
        change_uT = simulate_uT(law, setup, place_mm, force_N)
        return change_uT.reshape(len(axis_mm), len(axis_mm), len(forces_N), -1), at_rest_uT(law, setup).ravel()

    mean_uT, rest_uT = fields_uT(centre)
    perturbed = [fields_uT(perturb(centre, name, STEP * spread)) for name, spread in spreads.items()]
    return Tables(
        names=tuple(spreads), spreads=np.array(list(spreads.values())), axis_mm=axis_mm, force_N=forces_N,
        mean_uT=mean_uT, slope_uT=np.stack([(db_uT - mean_uT) / STEP for db_uT, _ in perturbed], axis=-1),
        rest_uT=rest_uT, rest_slope_uT=np.stack([(noload_uT - rest_uT) / STEP for _, noload_uT in perturbed], axis=-1),
        area=setup.area,
    )  # fmt: skip


def mean_law(laws: list[Law]) -> Law:
    """Return the central law for a new board of a rig, from the laws that were fitted to known boards of this rig.

    Each parameter is the mean over the known boards, except the position (seat) and the rotation of the skin on the
    board, which are 0.
    """
    by_name = {name: np.array([asdict(law)[name] for law in laws]) for name in asdict(laws[0])}
    means = {
        name: float(np.exp(np.log(values).mean()) if name in LOGARITHMIC else values.mean())
        for name, values in by_name.items()
    }
    return Law(**(means | {"seat_x_mm": 0.0, "seat_y_mm": 0.0, "rotation_deg": 0.0}))


def perturb(centre: Law, name: str, by: float) -> Law:
    """Add `by` to one parameter of a law, or to its logarithm if it is in `LOGARITHMIC`."""
    value = asdict(centre)[name]
    return with_parameters(centre, (name,), np.array([value * np.exp(by) if name in LOGARITHMIC else value + by]))


Relative = Float[np.ndarray, "n ch"]  # errors of the law divided by |dB|
# Distances in place and in log force over which the errors of the law are similar (length scales of `kernel`). The
# errors at places that are 2 mm apart have a correlation of 0.8. For places that are 6 mm apart, it is 0.14.
LENGTH_MM, LENGTH_LOG_N = 3.0, 1.2
# The error of the law has a part that differs between two presses, even if both presses are at the same place. This is
# the fraction of the variance of the error that belongs to this part.
NOISE = 0.1
SHARED = 0.55  # fraction of the variance of the law's error that is the same on all boards
# A few known boards are not enough to determine the covariance of the errors between channels. Therefore, a weighted
# mean of two matrices is used: the covariance of the errors on the known boards, and an isotropic matrix (equal
# variances, no correlation). This is the weight of the isotropic matrix.
EVEN = 0.5


@dataclass(frozen=True)
class Residual:
    """Gaussian process that predicts the law's relative errors on a new board from its errors on known boards.

    The known errors are the errors of the law for m presses on boards with known parameters.
    """

    place_mm: Float[np.ndarray, "m 2"]
    log_N: Float[np.ndarray, " m"]
    solved: Float[np.ndarray, "m ch"]  # inverse of the covariance matrix of the known errors, times these errors
    channel_cov: Float[np.ndarray, "ch ch"]  # covariance between channels, with a trace of 1
    noise: float  # fraction of the variance of the error that differs between presses at the same place

    def at(self, place_mm: Float[np.ndarray, "n 2"], log_N: Float[np.ndarray, " n"]) -> Relative:
        """Return the law's expected relative errors for presses at these places with these log forces."""
        return SHARED * kernel(place_mm, self.place_mm, log_N, self.log_N) @ self.solved


def no_residual(channels_n: int) -> Residual:
    """Return the residual if no board is known: its mean is zero, and its variance is the same in all channels."""
    empty = np.empty((0, 2)), np.empty(0), np.empty((0, channels_n))
    return Residual(*empty, np.eye(channels_n) / channels_n, noise=NOISE / 2)


def fit_residual(
    place_mm: Sequence[Float[np.ndarray, "b 2"]],
    force_N: Sequence[Float[np.ndarray, " b"]],
    errors: Sequence[Float[np.ndarray, "b ch"]],
) -> Residual:
    """Fit a Gaussian process to the law's relative errors on known boards.

    The errors on a board are the sum of a part that all boards have in common and a part that differs between boards.
    If there is only one known board, the prediction for a new board is `SHARED` times the errors on the known board. If
    there are many, it is close to the mean of their errors.
    """
    board_i = np.repeat(np.arange(len(errors)), [len(board) for board in errors])
    at_mm, log_N, error = np.concatenate(place_mm), np.log(np.concatenate(force_N)), np.concatenate(errors)
    board_cov = np.where(board_i[:, None] == board_i, 1.0, SHARED)
    cov = board_cov * kernel(at_mm, at_mm, log_N, log_N) + NOISE * np.eye(len(error))
    between, channels_n = error.T @ error, error.shape[1]
    isotropic = np.eye(channels_n) / channels_n
    channel_cov = EVEN * isotropic + (1 - EVEN) * between / np.trace(between)
    return Residual(at_mm, log_N, np.linalg.solve(cov, error), channel_cov, noise=NOISE / 2)


def kernel(
    a_mm: Float[np.ndarray, "n 2"], b_mm: Float[np.ndarray, "m 2"], a_log_N: Float[np.ndarray, " n"],
    b_log_N: Float[np.ndarray, " m"],
) -> Float[np.ndarray, "n m"]:  # fmt: skip
    """Return the correlation of the law's error between each press of one set and each press of another set.

    The correlation decreases with the distance between the places and between the logarithms of the forces (squared
    exponential function).
    """
    distance_mm2 = ((a_mm[:, None] - b_mm[None]) ** 2).sum(axis=2)
    distance_log2 = (a_log_N[:, None] - b_log_N[None]) ** 2
    return np.exp(-distance_mm2 / (2 * LENGTH_MM**2) - distance_log2 / (2 * LENGTH_LOG_N**2))


LAW_ERROR = 0.35  # rms error of the law before conditioning: length of the error vector over channels, divided by |dB|
NOISE_uT = 4.5  # standard deviation of a reading's noise, per channel


@dataclass(frozen=True)
class Information:
    """What one unlabelled press tells about the parameters of the law, if a hypothesis about this press is true.

    The inverse of the information matrix is the covariance of the parameters that this press alone would determine.
    """

    matrix: Float32[np.ndarray, "h tt"]  # information matrix of each hypothesis, flattened
    # Contribution of each channel to the information vector, if the channel deviates by 1 uT from its expected value.
    per_uT: Float32[np.ndarray, "h ch t"]


@dataclass(frozen=True)
class Hypotheses:
    """Hypotheses about a press: all pairs of a place and a force, each with its expected field change.

    The hypotheses are ordered by place and then by force. `mean_uT` and `slope_uT` are the field change of the central
    law and its derivatives. `residual` is the expected relative error of the law, and `error_cov` the covariance of
    this error between channels. `external_cov` is the covariance of an external field (for example the earth's field
    on a moving robot) in a reading, or None if there is no such field.
    """

    place_mm: Float[np.ndarray, "p 2"]
    log_N: Float[np.ndarray, " q"]
    mean_uT: Float32[np.ndarray, "h ch"]
    slope_uT: Float32[np.ndarray, "h ch t"]
    residual: Float32[np.ndarray, "h ch"]
    error_cov: Float[np.ndarray, "ch ch"]
    external_cov: Float[np.ndarray, "ch ch"] | None = None

    __repr__ = one_line

    @cached_property
    def noise_cov(self) -> Float[np.ndarray, "ch ch"]:
        """Covariance of the part of a reading that the skin does not cause.

        This part is noise and, if there is one, the external field.
        """
        noise = NOISE_uT**2 * np.eye(len(self.error_cov))
        return noise if self.external_cov is None else noise + self.external_cov

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
        """What an unlabelled press tells about the parameters under each hypothesis.

        The error of the law is treated like noise, with the covariance that it has before conditioning.
        """
        slope_uT, h = self.slope_uT.astype(float), len(self.mean_uT)
        squared_uT2 = (self.mean_uT.astype(float) ** 2).sum(axis=1)
        cov = squared_uT2[:, None, None] * self.error_cov + self.noise_cov
        per_uT = np.linalg.solve(cov, slope_uT)
        matrix = (per_uT.transpose(0, 2, 1) @ slope_uT).reshape(h, -1)
        return Information(matrix.astype(np.float32), per_uT.astype(np.float32))

    @cached_property
    def expected_uT(self) -> Float32[np.ndarray, "h ch"]:
        """Expected field change of each hypothesis before conditioning.

        This is the field change of the central law, plus the error of the law that is expected from known boards.
        """
        return self.mean_uT + np.linalg.norm(self.mean_uT, axis=1, keepdims=True) * self.residual


def lattice(tables: Tables, residual: Residual, external_cov: Float[np.ndarray, "ch ch"] | None = None) -> Hypotheses:
    """Return the hypotheses: all tabulated places that are on the skin, each with all tabulated forces."""
    place_mm = np.stack(np.meshgrid(tables.axis_mm, tables.axis_mm, indexing="ij"), axis=-1).reshape(-1, 2)
    on_skin = inside(place_mm, tables.area)
    log_N, channels_n = np.log(tables.force_N), len(tables.rest_uT)
    mean_uT = tables.mean_uT.reshape(len(place_mm), len(log_N), -1)[on_skin].reshape(-1, channels_n)
    slope_uT = tables.slope_uT.reshape(len(place_mm), len(log_N), -1)[on_skin].reshape(*mean_uT.shape, -1)
    place_mm = place_mm[on_skin]
    expected = residual.at(np.repeat(place_mm, len(log_N), axis=0), np.tile(log_N, len(place_mm)))
    mean_uT, slope_uT, expected = (part.astype(np.float32) for part in (mean_uT, slope_uT, expected))
    error_cov = LAW_ERROR**2 * residual.channel_cov
    return Hypotheses(place_mm, log_N, mean_uT, slope_uT, expected, error_cov, external_cov)


# How a skin slides under a press can change from one day to the next. SLIDE lists the parameters that describe the
# slide; all other parameters stay the same. If the slide has changed, SLIDE_CORRELATION is the correlation of each of
# these parameters between the two days, and ERROR_CORRELATION is the correlation of the law's errors. Both values were
# chosen on simulated skins (tests/benchmarks/test_days_benchmark.py).
SLIDE = ("away_um_mm", "give_x_um", "give_y_um", "lets_go_N")
SLIDE_CORRELATION, ERROR_CORRELATION = 0.0, 0.7
# Standard deviation of the difference between the no-load field of a skin and the no-load field of the law. It combines
# the offsets of the chips (200 uT) and the error of the law (250 uT).
OFFSET_uT = 320.0
SHARE_MIN = 0.03  # however many labels there are, this fraction of the variance of the law's error always remains
# Weight of an unlabelled press. It is below 1 because the law's errors at nearby places are correlated, so that many
# presses contain less information than the same number of independent ones.
PRESS_WEIGHT = 0.2
ROUNDS_N = 3  # rounds of expectation maximisation in `condition_on_presses`, unless the caller passes another number
LABEL_OFFSETS = ("label_x_mm", "label_y_mm")
# `shift_onto_area` computes the density of presses on a lattice of places. The lattice extends beyond the area by the
# first value, and its step is the second value. The third value is the largest shift.
AREA_BEYOND_MM, AREA_STEP_MM, SHIFT_MAX_MM = 4.0, 0.2, 2.0
# Density of presses far outside the area, relative to the density inside. It is above 0, so that a few places outside
# are possible.
DENSITY_MIN = 1e-3
# The mean place of evenly spread presses is close to the centre of the labels' frame, with this standard deviation.
EVEN_MM = 0.15
# Hypotheses are left out if their weight is below this fraction of the largest weight, because they would not change a
# sum in single precision.
WEIGHT_MIN = 1e-9


@dataclass(frozen=True)
class Estimate:
    """Estimates for n readings: places and forces, each with its standard deviation, and the misfit.

    The misfit shows how well the most likely hypothesis explains a reading. `sd_log_N` is the standard deviation of the
    logarithm of the force; it is NaN if forces are not calibrated.
    """

    place_mm: Float[np.ndarray, "n 2"]
    sd_mm: Float[np.ndarray, "n 2"]
    force_N: Float[np.ndarray, " n"]
    misfit: Float[np.ndarray, " n"]  # chi^2 per channel, which is about 1 if the map describes the skin well
    sd_log_N: Float[np.ndarray, " n"]


def concatenate(parts: Sequence[Estimate]) -> Estimate:
    """Concatenate estimates."""
    if len(parts) == 1:
        return parts[0]
    return Estimate(*(np.concatenate([getattr(part, name) for part in parts]) for name in Estimate.__annotations__))


@dataclass(frozen=True)
class Likelihoods:
    """Likelihood of each of h hypotheses for each of n readings.

    `chi2` is the squared deviation of a reading from a hypothesis, relative to its covariance, summed over channels.
    """

    chi2: Float32[np.ndarray, "n h"]
    deviance: Float32[np.ndarray, "n h"]  # -2 log likelihood, up to a constant
    best: Int64[np.ndarray, " n"]  # index of the most likely hypothesis
    channels_n: int

    def misfit(self) -> Float[np.ndarray, " n"]:
        """Return the misfit of each reading.

        The misfit is chi^2 of the most likely hypothesis, divided by the number of channels.
        """
        return self.chi2[np.arange(len(self.chi2)), self.best] / self.channels_n

    def probabilities(self) -> Float[np.ndarray, "n h"]:
        """Return the posterior probability of each hypothesis."""
        likelihood = np.exp(-0.5 * (self.deviance - self.deviance.min(axis=1, keepdims=True)))
        return likelihood / likelihood.sum(axis=1, keepdims=True)


@dataclass(frozen=True)
class LabelledErrors:
    """Presses with known places and forces, and what they tell about the law's errors at other places and forces."""

    place_mm: Float[np.ndarray, "m 2"]
    log_N: Float[np.ndarray, " m"]
    solved: Float[np.ndarray, "m ch"]  # `inverse` times the errors at these presses
    inverse: Float[np.ndarray, "m m"]  # inverse of the correlation matrix of the law's errors at these m presses
    by_day: Float[np.ndarray, " m"]  # correlation of the errors between the day of a press and the current day


@dataclass(frozen=True)
class SkinMap:
    """The map of one skin: the distribution of its parameters and of the law's errors on this skin.

    `mean` and `cov` are the mean and the covariance of the parameters, given as deviations from the central law in
    units of their spreads. The parameters of the current day come first. They are followed by the parameters of the
    slide on earlier days, beginning with the latest day (see `begin_day`).
    """

    tables: Tables
    residual: Residual
    hypotheses: Hypotheses
    mean: Float[np.ndarray, " p"]
    cov: Float[np.ndarray, "p p"]
    labelled: LabelledErrors | None = None

    __repr__ = one_line

    @property
    def error_cov(self) -> Float[np.ndarray, "ch ch"]:
        """Covariance of the law's relative error between channels, before conditioning on labels."""
        return self.hypotheses.error_cov

    @property
    def current(self) -> tuple[Float[np.ndarray, " t"], Float[np.ndarray, "t t"]]:
        """Mean and covariance of the parameters on the current day."""
        t = len(self.tables.names)
        return self.mean[:t], self.cov[:t, :t]

    @cached_property
    def evaluator(self) -> "MapEvaluator":
        """The map, prepared for the evaluation of readings."""
        return MapEvaluator(self)


class MapEvaluator:
    """A map that is prepared for the evaluation of readings.

    It stores the normal distributions of all hypotheses in a form in which the likelihood of a reading is a product of
    matrices (`reskin.universal.kernels`).
    """

    def __init__(self, skin: SkinMap) -> None:
        self._hypotheses = skin.hypotheses
        self.lattice = Lattice(skin.hypotheses.place_mm, skin.hypotheses.log_N)
        mean, cov = skin.current
        parameters = mean.astype(np.float32), np.linalg.cholesky(cov).astype(np.float32)
        error_cov = skin.error_cov.astype(np.float32)
        noise_cov = skin.hypotheses.noise_cov.astype(np.float32)
        self.gaussians = whiten(skin.hypotheses.linear, parameters, *self._errors(skin), error_cov, noise_cov)
        invalid = ~np.isfinite(self.gaussians.log_det)
        if invalid.any():
            what = f"the covariances of {int(invalid.sum())} hypotheses (places and forces) are not positive definite"
            raise SchemaError(f"map of a skin: {what}. Take the no-load reading again: call zero.")

    def _errors(self, skin: SkinMap) -> tuple[Float32[np.ndarray, "h ch"], Float32[np.ndarray, " h"]]:
        """Return, for each hypothesis, the expected relative error of the law and how uncertain it still is.

        The uncertainty is the fraction of the variance of the error that remains after conditioning on the labels.
        Without labels, it is 1.
        """
        expected, labelled = skin.hypotheses.residual, skin.labelled
        if labelled is None:
            return expected, np.ones(len(expected), np.float32)
        place_mm, log_N = skin.hypotheses.at
        k = kernel(place_mm, labelled.place_mm, log_N, labelled.log_N) * labelled.by_day
        explained = ((k @ labelled.inverse) * k).sum(axis=1)
        share = np.maximum(1 + skin.residual.noise - explained, SHARE_MIN)
        return (expected + k @ labelled.solved).astype(np.float32), share.astype(np.float32)

    def evaluate(self, db_uT: Float[np.ndarray, "n ch"]) -> Likelihoods:
        """Compute the likelihood of every hypothesis for each reading."""
        chi2, deviance = self.gaussians.evaluate(db_uT.astype(np.float32))
        return Likelihoods(chi2, deviance, deviance.argmin(axis=1), db_uT.shape[1])

    def without_external(self, db_uT: Float[np.ndarray, "n ch"], likelihoods: Likelihoods) -> Float[np.ndarray, "n ch"]:
        """Subtract the external field from readings.

        The external field of a reading is not known. What is subtracted is its expected value under the hypothesis that
        is most likely for this reading.
        """
        external_cov = self._hypotheses.external_cov
        if external_cov is None:
            return db_uT
        return db_uT - self.gaussians.solve(db_uT.astype(np.float32), likelihoods.best) @ external_cov

    def mean(self, likelihoods: Likelihoods, power: float) -> Estimate:
        """Estimate places and forces as weighted means over all hypotheses.

        The weights are the likelihoods of the hypotheses, raised to the given power.
        """
        moments = means(likelihoods.deviance, likelihoods.best, self.lattice, power)
        return Estimate(*moments, likelihoods.misfit(), np.full(len(likelihoods.best), np.nan))

    def estimate(self, db_uT: Float[np.ndarray, "n ch"], block_n: int = 200) -> Estimate:
        """Estimate the places and forces of readings as means over all hypotheses, weighted by their likelihoods.

        The readings are processed in blocks of `block_n`, which limits the memory.
        """
        starts = range(0, len(db_uT), block_n)
        return concatenate([self.mean(self.evaluate(db_uT[i : i + block_n]), 1.0) for i in starts])


def new_map(
    tables: Tables, residual: Residual | None = None, external_cov: Float[np.ndarray, "ch ch"] | None = None
) -> SkinMap:
    """Return the map of a skin about which nothing is known yet.

    If a `residual` is given, it predicts the law's errors from its errors on other boards of the rig. `external_cov` is
    the covariance of an unknown external field that each reading may contain. If it is None, readings are assumed to
    contain only the field change of the press and noise.
    """
    t, expected = len(tables.names), residual or no_residual(tables.mean_uT.shape[-1])
    return SkinMap(tables, expected, lattice(tables, expected, external_cov), np.zeros(t), np.eye(t))


def condition_on_noload(skin: SkinMap, noload_uT: Float[np.ndarray, " ch"]) -> SkinMap:
    """Condition the map on a skin's no-load field."""
    tables = skin.tables
    return _condition(skin, tables.rest_slope_uT, noload_uT - tables.rest_uT, np.full(len(noload_uT), OFFSET_uT**2))


def condition_on_presses(skin: SkinMap, db_uT: Float[np.ndarray, "n ch"], rounds_n: int = ROUNDS_N) -> SkinMap:
    """Condition the map on presses at unknown places with unknown forces, by expectation maximisation.

    Each round first computes the probabilities of all hypotheses for each press. It then conditions the parameters on
    the presses, with each hypothesis weighted by its probability.
    """
    information, expected_uT, posterior = skin.hypotheses.information, skin.hypotheses.expected_uT, skin
    for _ in range(rounds_n):
        weight = PRESS_WEIGHT * posterior.evaluator.evaluate(db_uT).probabilities()
        total = weight.sum(axis=0)  # weight of each hypothesis, summed over presses
        kept = np.flatnonzero(total > WEIGHT_MIN * total.max())
        off_uT = weight[:, kept].T @ db_uT.astype(np.float32) - total[kept][:, None] * expected_uT[kept]
        t = len(skin.tables.names)
        matrix = (total[kept] @ information.matrix[kept]).reshape(t, t)
        vector = off_uT.ravel() @ information.per_uT[kept].reshape(-1, t)
        posterior = _add_information(skin, matrix, vector)
    return posterior


def condition_on_even_presses(skin: SkinMap, db_uT: Float[np.ndarray, "n ch"]) -> SkinMap:
    """Condition the map on presses that are evenly spread over the skin.

    The mean of their places is assumed to be the centre of the labels' frame. This determines the offset between the
    labels' frame and the board.
    """
    label_i = [skin.tables.names.index(name) for name in LABEL_OFFSETS]
    spread_mm = skin.tables.spreads[label_i]
    row = np.zeros((2, len(skin.tables.names)))
    row[[0, 1], label_i] = 1.0
    posterior = skin
    for _ in range(2):
        off_mm = posterior.evaluator.estimate(db_uT).place_mm.mean(axis=0)
        posterior = _condition(skin, row, posterior.mean[label_i] + off_mm / spread_mm, (EVEN_MM / spread_mm) ** 2)
    return posterior


def move_places(skin: SkinMap, by_mm: Float[np.ndarray, "2"]) -> SkinMap:
    """Move all places that the map estimates.

    The offset of the labels' frame is a parameter of the map. Its mean is changed so that the estimates move.
    """
    label_i = [skin.tables.names.index(name) for name in LABEL_OFFSETS]
    mean = skin.mean.copy()
    mean[label_i] -= by_mm / skin.tables.spreads[label_i]
    return replace(skin, mean=mean)


def shift_onto_area(estimate: Estimate, sd_mm: float, area: Area = PAPER_AREA) -> Float[np.ndarray, "2"]:
    """Return the shift that moves the estimated places of presses onto the area where the skin was pressed.

    The true places are assumed to be uniformly distributed over the area. The prior of the shift is a normal
    distribution with mean zero and standard deviation `sd_mm`. The result is the mean of the posterior.
    """
    reach_mm = float(area.half_mm.max()) + AREA_BEYOND_MM
    axis_mm = np.arange(-reach_mm, reach_mm + AREA_STEP_MM / 2, AREA_STEP_MM)
    place_mm = np.stack(np.meshgrid(axis_mm, axis_mm, indexing="ij"), axis=-1)
    pressed = inside(place_mm.reshape(-1, 2), area).reshape(place_mm.shape[:2]).astype(float)
    density = gaussian_filter(pressed, float(estimate.sd_mm.mean()) / AREA_STEP_MM) + DENSITY_MIN
    steps_mm = np.arange(-SHIFT_MAX_MM, SHIFT_MAX_MM + AREA_STEP_MM / 2, AREA_STEP_MM)
    shift_mm = np.stack(np.meshgrid(steps_mm, steps_mm, indexing="ij"), axis=-1).reshape(-1, 2)
    at = (estimate.place_mm[:, None] + shift_mm + reach_mm) / AREA_STEP_MM
    log_density = np.log(map_coordinates(density, at.reshape(-1, 2).T, order=1, mode="nearest"))
    log_p = log_density.reshape(len(at), -1).sum(axis=0) - (shift_mm**2).sum(axis=1) / (2 * sd_mm**2)
    p = np.exp(log_p - log_p.max())
    return p @ shift_mm / p.sum()


def condition_on_labels(
    skin: SkinMap,
    place_mm: Float[np.ndarray, "m 2"],
    force_N: Float[np.ndarray, " m"],
    db_uT: Float[np.ndarray, "m ch"],
    days_ago: Int64[np.ndarray, " m"] | None = None,
) -> SkinMap:
    """Condition the map on labelled presses.

    First, the parameters of the skin are conditioned on the presses. Then, the law's errors are conditioned on the
    deviations that remain at these presses.

    `days_ago` is the number of calls of `begin_day` since each press was made. By default, all presses are of the
    current day.
    """
    if not len(place_mm):
        return skin
    mean_uT, slope_uT, expected = interpolate(skin, place_mm, force_N)
    magnitude_uT, log_N = np.linalg.norm(mean_uT, axis=1), np.log(force_N)
    days_ago = np.zeros(len(place_mm), int) if days_ago is None else days_ago
    by_day = ERROR_CORRELATION ** np.abs(days_ago[:, None] - days_ago)
    k = kernel(place_mm, place_mm, log_N, log_N) * by_day + skin.residual.noise * np.eye(len(place_mm))
    root = np.linalg.cholesky(k)
    deviation = (db_uT - mean_uT) / magnitude_uT[:, None] - expected
    slope = _slopes_by_day(skin, slope_uT / magnitude_uT[:, None, None], days_ago)
    # The law's errors are correlated between presses (`k`) and between channels (`error_cov`). Both correlations are
    # removed, so that `_condition` can treat all elements as independent.
    white = solve_triangular(
        root, np.concatenate([deviation[..., None], slope], axis=2).reshape(len(deviation), -1), lower=True
    )
    white = np.linalg.solve(np.linalg.cholesky(skin.error_cov), white.reshape(*deviation.shape, -1))
    posterior = _condition(
        skin, white[..., 1:].reshape(-1, len(skin.mean)), white[..., 0].ravel(), np.ones(deviation.size)
    )
    solved = np.linalg.solve(k, deviation - slope @ posterior.mean)
    errors = LabelledErrors(place_mm, log_N, solved, np.linalg.inv(k), ERROR_CORRELATION**days_ago)
    return replace(posterior, labelled=errors)


def begin_day(skin: SkinMap) -> SkinMap:
    """Return the map for a new day on which the skin slides differently than on the days before.

    The parameters of the slide have new values on the new day. Their correlation with the values of the day before is
    `SLIDE_CORRELATION`, and their prior is the same on all days. The values of the days before are appended to the
    parameters of the map, because the labelled presses of a day depend on the slide of this day. The map `skin` must
    not be conditioned on labels.
    """
    slide_i, t, p = _slide_indices(skin), len(skin.tables.names), len(skin.mean)
    transition = np.zeros((p + len(slide_i), p))
    transition[:t, :t] = np.eye(t)
    transition[slide_i, slide_i] = SLIDE_CORRELATION
    transition[range(t, t + len(slide_i)), slide_i] = 1.0
    transition[t + len(slide_i) :, t:] = np.eye(p - t)
    cov = transition @ skin.cov @ transition.T
    cov[slide_i, slide_i] += 1 - SLIDE_CORRELATION**2
    return replace(skin, mean=transition @ skin.mean, cov=cov)


def _slide_indices(skin: SkinMap) -> list[int]:
    return [i for i, name in enumerate(skin.tables.names) if name in SLIDE]


def _slopes_by_day(
    skin: SkinMap, slope: Float[np.ndarray, "m ch t"], days_ago: Int64[np.ndarray, " m"]
) -> Float[np.ndarray, "m ch p"]:
    """Return the derivatives of field changes with respect to all parameters of a map, including earlier days.

    A press depends on the slide of its own day only. Its derivatives with respect to the slide of other days are 0.
    """
    t, slide_i = slope.shape[2], _slide_indices(skin)
    if len(skin.mean) == t:
        return slope
    by_day = np.zeros((*slope.shape[:2], len(skin.mean)))
    by_day[..., :t] = slope
    for press in np.flatnonzero(days_ago):
        first = t + len(slide_i) * (days_ago[press] - 1)
        by_day[press, :, first : first + len(slide_i)] = slope[press][:, slide_i]
        by_day[press][:, slide_i] = 0.0
    return by_day


def _condition(
    skin: SkinMap, row: Float[np.ndarray, "r t"], value: Float[np.ndarray, " r"], var: Float[np.ndarray, " r"]
) -> SkinMap:
    """Condition the parameters on linear observations.

    Each observation states that `row @ parameters` equals `value`, with a normally distributed error of variance `var`.
    """
    return _add_information(skin, row.T @ (row / var[:, None]), row.T @ (value / var))


def _add_information(skin: SkinMap, matrix: Float[np.ndarray, "t t"], vector: Float[np.ndarray, " t"]) -> SkinMap:
    """Condition the parameters on observations that are given as information matrix and information vector.

    Both may be shorter than the number of parameters of the map. The observations then contain no information about the
    last parameters.
    """
    if more_n := len(skin.mean) - len(vector):
        matrix, vector = np.pad(matrix, (0, more_n)), np.pad(vector, (0, more_n))
    prior = np.linalg.inv(skin.cov)
    cov = np.linalg.inv(prior + matrix)
    return replace(skin, mean=cov @ (prior @ skin.mean + vector), cov=(cov + cov.T) / 2)


def interpolate(
    skin: SkinMap, place_mm: Float[np.ndarray, "m 2"], force_N: Float[np.ndarray, " m"]
) -> tuple[Float[np.ndarray, "m ch"], Float[np.ndarray, "m ch t"], Relative]:
    """Interpolate the tables at the places and forces of presses.

    Returns the field changes of the central law, their derivatives with respect to the parameters, and the expected
    relative errors of the law. The interpolation is linear in place and in the logarithm of the force.
    """
    tables = skin.tables
    axes = tables.axis_mm, tables.axis_mm, np.log(tables.force_N)
    points = np.column_stack([place_mm, np.log(force_N)])
    low, share = np.empty(points.shape, int), np.empty(points.shape)
    for i, axis in enumerate(axes):
        step = np.clip((points[:, i] - axis[0]) / (axis[1] - axis[0]), 0, len(axis) - 1)
        low[:, i] = np.minimum(step.astype(int), len(axis) - 2)
        share[:, i] = step - low[:, i]
    channels_n, parameters_n = tables.rest_slope_uT.shape
    mean_uT, slope_uT = np.zeros((len(points), channels_n)), np.zeros((len(points), channels_n, parameters_n))
    for corner in np.ndindex(2, 2, 2):
        weight = np.prod(np.where(corner, share, 1 - share), axis=1)
        i, j, k = (low + corner).T
        mean_uT = mean_uT + weight[:, None] * tables.mean_uT[i, j, k]
        slope_uT = slope_uT + weight[:, None, None] * tables.slope_uT[i, j, k]
    return mean_uT, slope_uT, skin.residual.at(place_mm, np.log(force_N))


def expected_gain(
    skin: SkinMap, place_mm: Float[np.ndarray, "c 2"], force_N: Float[np.ndarray, " c"]
) -> Float[np.ndarray, " c"]:
    """Return how much one more labelled press at each place would reduce the uncertainty about the whole skin.

    The uncertainty is the variance of the relative field changes that remains with the labels so far. It is summed over
    channels and averaged over all places of the map, for presses with the median of the tabulated forces.
    """
    hypotheses, error_cov, gains = skin.hypotheses, skin.error_cov, []
    median_force = slice(len(hypotheses.log_N) // 2, None, len(hypotheses.log_N))
    mean_uT, slope_uT = (part[median_force].astype(float) for part in (hypotheses.mean_uT, hypotheses.slope_uT))
    all_slopes = slope_uT / np.linalg.norm(mean_uT, axis=1)[:, None, None] @ skin.current[1]
    all_mm, all_log_N = (part[median_force] for part in hypotheses.at)
    press_uT, press_slope_uT, _ = interpolate(skin, place_mm, force_N)
    log_N = np.log(force_N)
    shared = _remaining_errors(skin, all_mm, all_log_N, place_mm, log_N)
    for i, magnitude_uT in enumerate(np.linalg.norm(press_uT, axis=1)):
        slope, press = press_slope_uT[i] / magnitude_uT, slice(i, i + 1)
        own = _remaining_errors(skin, place_mm[press], log_N[press], place_mm[press], log_N[press])[0, 0]
        cov = slope @ skin.current[1] @ slope.T + (own + skin.residual.noise) * error_cov
        cov += (NOISE_uT / magnitude_uT) ** 2 * np.eye(len(cov))
        with_all = (all_slopes @ slope.T + shared[:, i, None, None] * error_cov).reshape(-1, len(cov))
        gains.append(float(((with_all @ np.linalg.inv(cov)) * with_all).sum() / len(all_mm)))
    return np.array(gains)


def _remaining_errors(
    skin: SkinMap, a_mm: Float[np.ndarray, "n 2"], a_log_N: Float[np.ndarray, " n"], b_mm: Float[np.ndarray, "m 2"],
    b_log_N: Float[np.ndarray, " m"],
) -> Float[np.ndarray, "n m"]:  # fmt: skip
    """Return the covariance of the law's errors between two sets of presses that remains after conditioning on labels.

    It is relative to the variance of an error before conditioning, so without labels it is the correlation of `kernel`.
    """
    prior, labelled = kernel(a_mm, b_mm, a_log_N, b_log_N), skin.labelled
    if labelled is None:
        return prior
    to_a = kernel(a_mm, labelled.place_mm, a_log_N, labelled.log_N) * labelled.by_day
    to_b = kernel(b_mm, labelled.place_mm, b_log_N, labelled.log_N) * labelled.by_day
    return prior - to_a @ labelled.inverse @ to_b.T

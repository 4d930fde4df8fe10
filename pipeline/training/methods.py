"""Methods that estimate places and forces on a new board, from its no-load field and a few presses on it.

Each method is called with a `Case`, and returns a `Prediction`. Models are used through their public interface.
"""

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int64

import reskin
from reskin.metrics import coverage_pct, median_error_mm, score
from reskin.models.trained import Network
from reskin.universal.force import NORMAL_90

# Weight of the new board's labels in kernel ridge regression, relative to presses of other boards; assumed.
OWN_WEIGHT = 10.0


@dataclass(frozen=True)
class Samples:
    """Presses or readings: places and forces in the coordinates of the labels, and fields along the chips' axes."""

    place_mm: Float[np.ndarray, "m 2"]
    force_N: Float[np.ndarray, " m"]  # NaN if unknown
    b_uT: Float[np.ndarray, "m ch"]

    def __len__(self) -> int:
        return len(self.force_N)

    def __getitem__(self, chosen: Int64[np.ndarray, " k"]) -> "Samples":
        return Samples(self.place_mm[chosen], self.force_N[chosen], self.b_uT[chosen])

    @property
    def target(self) -> Float[np.ndarray, "m 3"]:
        """Columns x_mm, y_mm and F_N."""
        return np.column_stack([self.place_mm, self.force_N])


@dataclass(frozen=True)
class Case:
    """What a method knows about a new board, and the readings that it must estimate.

    - noload_uT: no-load field; presses_uT: unlabelled presses; labels: labelled presses.
    - others: presses of the other boards, as changes of field.
    - tested_uT: the readings.
    """

    noload_uT: Float[np.ndarray, " ch"]
    presses_uT: Float[np.ndarray, "n ch"]
    labels: Samples
    others: Samples
    tested_uT: Float[np.ndarray, "t ch"]


@dataclass(frozen=True)
class Prediction:
    """Predicted x_mm, y_mm and F_N of each reading and, if the method states them, ends of 90 % intervals."""

    target: Float[np.ndarray, "t 3"]
    low: Float[np.ndarray, "t 3"] | None = None
    high: Float[np.ndarray, "t 3"] | None = None


Method = Callable[[Case], Prediction]


@dataclass(frozen=True)
class InContext:
    """The in-context model in a file. If `mirrored`, y of the scene's labels is opposite to y of the model."""

    file: Path
    mirrored: bool
    middle_mm: tuple[float, float]

    def __call__(self, case: Case) -> Prediction:
        model = reskin.load_universal(file=self.file)
        sign, origin_mm = np.array([1, -1 if self.mirrored else 1]), np.array(model.layout.centre_mm)
        model.zero(case.noload_uT).see(case.presses_uT)
        if len(case.labels):
            force_N = np.clip(case.labels.force_N, *model.layout.force_N)
            place_mm = (case.labels.place_mm - self.middle_mm) * sign + origin_mm
            model.label(place_mm, force_N, case.labels.b_uT)
        found = model.estimate(case.tested_uT)
        place_mm = (found.place_mm - origin_mm) * sign + self.middle_mm
        half_mm, half_N = NORMAL_90 * found.sd_mm, NORMAL_90 * found.sd_N
        low = np.column_stack([place_mm - half_mm, found.force_N - half_N])
        high = np.column_stack([place_mm + half_mm, found.force_N + half_N])
        return Prediction(np.column_stack([place_mm, found.force_N]), low, high)


@dataclass(frozen=True)
class PaperNetwork:
    """The paper's network, trained on other boards; it uses nothing of the new board but its no-load field."""

    network: Network

    def __call__(self, case: Case) -> Prediction:
        return Prediction(self.network((case.tested_uT - case.noload_uT).astype(np.float32)).astype(float))


@dataclass(frozen=True)
class Registered:
    """A method whose places are rotated and shifted so that they fit the labels best (rigid registration)."""

    base: Method

    def __call__(self, case: Case) -> Prediction:
        known, tested = (self.base(replace(case, tested_uT=b_uT)).target for b_uT in (case.labels.b_uT, case.tested_uT))
        from_mm, to_mm = known[:, :2].mean(axis=0), case.labels.place_mm.mean(axis=0)
        u, _, vt = np.linalg.svd((known[:, :2] - from_mm).T @ (case.labels.place_mm - to_mm))
        rotation = u @ np.diag([1, np.linalg.det(u @ vt)]) @ vt
        return Prediction(np.column_stack([(tested[:, :2] - from_mm) @ rotation + to_mm, tested[:, 2]]))


def features(change_uT: Float[np.ndarray, "n ch"]) -> Float[np.ndarray, "n c"]:
    """Return the direction of each change of field, and the logarithm of its length."""
    length_uT = np.linalg.norm(change_uT, axis=1, keepdims=True)
    return np.hstack([change_uT / length_uT, np.log(length_uT)])


def gaussian_process(case: Case) -> Prediction:
    """Fit Gaussian processes for place and for force, in newtons, to the board's own labels."""
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

    known, tested = (features(b_uT - case.noload_uT) for b_uT in (case.labels.b_uT, case.tested_uT))
    target, sd = np.full((2, len(tested), 3), np.nan)  # unknown forces are not estimated
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # a hyperparameter at its bound
        for columns in ([0, 1], [2]):
            labels = case.labels.target[:, columns]
            if not np.isnan(labels).any():
                kernel = ConstantKernel(1.0) * RBF(1.0) + WhiteKernel(0.1)
                model = GaussianProcessRegressor(kernel, normalize_y=True, random_state=0).fit(known, labels)
                found = model.predict(tested, return_std=True)
                target[:, columns], sd[:, columns] = (part.reshape(len(tested), -1) for part in found)
    return Prediction(target, target - NORMAL_90 * sd, target + NORMAL_90 * sd)


def kernel_ridge(case: Case) -> Prediction:
    """Fit kernel ridge regression to the presses of the other boards and to the labels."""
    from sklearn.kernel_ridge import KernelRidge
    from sklearn.preprocessing import StandardScaler

    own, tested = (features(b_uT - case.noload_uT) for b_uT in (case.labels.b_uT, case.tested_uT))
    inputs = np.vstack([features(case.others.b_uT), own])
    scaler = StandardScaler().fit(inputs)
    weight = np.repeat([1.0, OWN_WEIGHT], [len(case.others), len(own)])
    target = np.vstack([case.others.target, case.labels.target])
    shift, columns = target.mean(axis=0), ~np.isnan(target).any(axis=0)
    predicted = np.full((len(tested), 3), np.nan)
    model = KernelRidge(kernel="rbf", alpha=0.1, gamma=0.1)
    model.fit(scaler.transform(inputs), (target - shift)[:, columns], sample_weight=weight)
    predicted[:, columns] = model.predict(scaler.transform(tested)) + shift[columns]
    return Prediction(predicted)


def constant(case: Case) -> Prediction:
    """Predict the mean place and the mean force of the labels."""
    return Prediction(np.tile(case.labels.target.mean(axis=0), (len(case.tested_uT), 1)))


def score_prediction(readings: Samples, prediction: Prediction) -> dict[str, float]:
    """Score a prediction of readings; intervals are scored by the percentage of true values that they contain."""
    true, found = readings.target, prediction
    scores = score(true, found.target) | {"median_mm": median_error_mm(true[:, :2], found.target[:, :2])}
    if found.low is not None and found.high is not None:
        scores["coverage_pct"] = coverage_pct(true[:, :2], found.low[:, :2], found.high[:, :2])
        if not np.isnan(true[:, 2]).any():
            scores["coverage_f_pct"] = coverage_pct(true[:, 2], found.low[:, 2], found.high[:, 2])
    return scores

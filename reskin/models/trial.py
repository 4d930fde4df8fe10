"""One training: a recipe on one fold with one seed, or a trained network fine-tuned on a new skin. In: rows, settings.

Out: a `Trial`, and a key that names its result by all that decides it. Refuses to know files, processes and scores.
"""

import hashlib
import importlib.metadata
import json
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from time import perf_counter

import numpy as np
from jaxtyping import Float32, Int64, Shaped

from reskin.code import digest
from reskin.data.lines import Lines
from reskin.models.inputs import Scaler
from reskin.models.recipe import FineTuning, Labelling, Recipe, Schedule
from reskin.numerics import device, signature

COLLAPSED = 0.05  # of a target's variance over a network's own training rows; sound ones explain more than 0.9
# The modules whose code decides what a training results in (tests/models/test_trial.py compares with imports).
DECIDING = (
    "reskin.seeds",
    *(f"reskin.models.{name}" for name in ("inputs", "losses", "network", "reproducible", "train", "trial")),
)
LIBRARIES = ("torch", "numpy", "scipy")

Weights = Mapping[str, np.ndarray]


@dataclass(frozen=True)
class Terms:
    """Weights of the terms beside the L2 loss: triplets of labelled rows, of unlabelled pokes, L2 of a few labels."""

    triplet: float
    unlabelled: float = 0.0
    few_labels: float = 0.0


@dataclass(frozen=True)
class Measured:
    """What trainings read: changes of field, targets (x, y, F or x, y, Fx, Fy, Fz), each row's skin (for triplets)."""

    db_uT: Float32[np.ndarray, "f ch"]
    target: Float32[np.ndarray, "f t"]
    skin: Shaped[np.ndarray, " f"]


@dataclass(frozen=True)
class Trained:
    """A finished training: weights by name, scaler, loss a block of steps, predictions for the test rows.

    Predictions are in mm, mm and N. `stopped_step` is set if its loss stopped being finite; the weights are then the
    last finite ones.
    """

    key: str
    weights: Weights
    scaler: Scaler
    curve: list[float]
    predicted: Float32[np.ndarray, "b t"]
    stopped_step: int | None
    explained_min: float | None  # the least part of a target's variance over its training rows; None: too short to tell
    seconds: float  # of its training, its part of the stack's
    one_reading_s: float  # median time of a prediction for a single reading
    reused: bool = False  # finished by an earlier run
    collapsed_before_n: int = 0  # trainings of the same trial before this one, that collapsed

    @property
    def collapsed(self) -> bool:
        """Whether the network predicts nearly the same for any input: its loss never fell, at least for one target."""
        return self.explained_min is not None and self.explained_min < COLLAPSED


@dataclass(frozen=True)
class Start:
    """The trained network that fine-tuning starts from, and its key."""

    key: str
    weights: Weights
    scaler: Scaler


@dataclass(frozen=True)
class Adapting:
    """Fine-tuning to a new skin by its unlabelled pokes: of the rows of `lines` it sees the field only."""

    start: Start
    settings: FineTuning
    lines: Lines


@dataclass(frozen=True)
class FewLabels:
    """Fine-tuning to a new skin by a few labelled pokes; `row` are their row numbers."""

    start: Start
    settings: Labelling
    row: Int64[np.ndarray, " o"]


@dataclass(frozen=True)
class Trial:
    """One training. `train` and `test` are row numbers; `skin` is the one adapted to, `what` a part of its name."""

    experiment: str
    recipe_name: str
    recipe: Recipe
    fold: str
    seed: int
    seed_i: int
    train: Int64[np.ndarray, " a"]
    test: Int64[np.ndarray, " b"]
    tuning: Adapting | FewLabels | None = None
    skin: str = ""
    what: str = ""
    attempt_i: int = 0  # trainings of it that collapsed before

    @property
    def name(self) -> str:
        """A name for files and for people, unique within a stage."""
        parts = [self.experiment, self.recipe_name, self.fold, self.skin, self.what, f"seed{self.seed_i}"]
        return ".".join(part for part in parts if part)

    @property
    def schedule(self) -> Schedule:
        return self.recipe if self.tuning is None else self.tuning.settings

    @property
    def terms(self) -> Terms:
        match self.tuning:
            case Adapting(settings=settings):
                return Terms(self.recipe.triplet_weight, unlabelled=settings.unlabelled_weight)
            case FewLabels(settings=settings):
                return Terms(self.recipe.triplet_weight, few_labels=settings.own_weight)
        return Terms(self.recipe.triplet_weight)


class Keys:
    """Names trials by all that decides their results: rows, recipe, seed, start, code, torch; keeps what it hashed."""

    def __init__(self, rows: Measured) -> None:
        self.rows = rows
        self.known: dict[int, tuple[np.ndarray, str]] = {}

    def key(self, trial: Trial) -> str:
        decisive = [
            device(), *signature(), trial.fold, trial.skin, trial.recipe.model_dump_json(), trial.seed, trial.seed_i,
            trial.attempt_i,
            self._labelled(trial.train), _digest(self.rows.db_uT[trial.test]),
            *map(digest, DECIDING), *map(importlib.metadata.version, LIBRARIES), sys.platform,
        ]  # fmt: skip
        if trial.tuning is not None:
            decisive += [trial.tuning.start.key, trial.tuning.settings.model_dump_json()]
        match trial.tuning:
            case Adapting(lines=lines):
                decisive += [_digest(self.rows.db_uT[lines.row], lines.line_i, lines.order_i)]
            case FewLabels(row=row):
                decisive += [_digest(self.rows.db_uT[row], self.rows.target[row])]
        return hashlib.sha256(json.dumps(decisive).encode()).hexdigest()[:32]

    def rows_digest(self) -> str:
        return _digest(self.rows.db_uT, self.rows.target)

    def _labelled(self, train: np.ndarray) -> str:
        if id(train) not in self.known:  # the array is kept, so that its id is not reused
            skin = np.unique(self.rows.skin[train], return_inverse=True)[1]
            self.known[id(train)] = (train, _digest(self.rows.db_uT[train], self.rows.target[train], skin))
        return self.known[id(train)][1]


def _digest(*arrays: np.ndarray) -> str:
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(f"{array.dtype}{array.shape}".encode())
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()[:32]


REPEATS_N = 25


def median_s(call: Callable[[], object]) -> float:
    """Time a call `REPEATS_N` times in s, after one that warms the caches."""
    call()
    times_s = []
    for _ in range(REPEATS_N):
        start_s = perf_counter()
        call()
        times_s.append(perf_counter() - start_s)
    return float(np.median(times_s))

"""Training jobs: training with a recipe on one fold with one seed, or fine-tuning of a trained network on a new skin.

`JobKeys` computes the cache key of a job: a digest of everything on which the job's result depends.
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
from reskin.models.recipe import AdaptationRecipe, FineTuningRecipe, Recipe, Schedule
from reskin.numerics import device, signature

# A network has collapsed if, for any target, its explained variance (R2) on training rows is below this limit. Usually,
# R2 is above 0.9.
COLLAPSED = 0.05
# The modules on whose code the result of training depends (tests/models/test_job.py compares them with the imports).
CODE_MODULES = (
    "reskin.seeds",
    *(f"reskin.models.{name}" for name in ("batches", "inputs", "job", "losses", "network", "reproducible", "train")),
)
LIBRARIES = ("torch", "numpy", "scipy")
REPEATS_N = 25
CURVE_POINTS_N = 50  # number of points of a loss curve; a training run with fewer steps has one point per step

Weights = Mapping[str, np.ndarray]


@dataclass(frozen=True)
class LossWeights:
    """Weights of the loss terms that are added to the squared error on labelled rows.

    triplet: weight of the triplet loss on labelled rows. unlabelled: weight of the triplet loss on unlabelled pokes of
    the new skin. few_labels: weight of the squared error on labelled pokes of the new skin.
    """

    triplet: float
    unlabelled: float = 0.0
    few_labels: float = 0.0


@dataclass(frozen=True)
class TrainingData:
    """Rows for training and test: field changes, targets (x, y, F or x, y, Fx, Fy, Fz), and the name of the skin.

    The three rows of a triplet are from the same skin.
    """

    db_uT: Float32[np.ndarray, "f ch"]
    target: Float32[np.ndarray, "f t"]
    skin: Shaped[np.ndarray, " f"]


@dataclass(frozen=True)
class TrainingResult:
    """The result of a training run.

    key: name of the result in the cache. curve: mean squared error in scaled units; point i is the mean over the steps
    between entries i - 1 and i of `curve_steps`. predicted: x, y in mm and F in N for the test rows. stopped_step: step
    at which training diverged, or None. If training diverged, `weights` are those before the divergence, and the curve
    ends there. explained_min: smallest explained variance (R2) of a target on training rows; None for a short training
    run.
    seconds: training time of the stack, divided by its number of networks. started_s: Unix time at which the training
    of the stack started. one_reading_s: median time of a prediction for one reading. reused: whether the result is
    from the cache. collapsed_before_n: number of earlier training runs of this job, all of which collapsed.
    """

    key: str
    weights: Weights
    scaler: Scaler
    curve: list[float]
    predicted: Float32[np.ndarray, "b t"]
    stopped_step: int | None
    explained_min: float | None
    seconds: float
    started_s: float
    one_reading_s: float
    reused: bool = False
    collapsed_before_n: int = 0

    @property
    def collapsed(self) -> bool:
        """Whether the network predicts nearly the same value of at least one target for all inputs."""
        return self.explained_min is not None and self.explained_min < COLLAPSED


@dataclass(frozen=True)
class Pretrained:
    """A trained network from which adaptation or fine-tuning starts; `key` is its name in the cache."""

    key: str
    weights: Weights
    scaler: Scaler


@dataclass(frozen=True)
class Adaptation:
    """Self-supervised fine-tuning on unlabelled pokes of a new skin (paper section 5).

    From the new skin, only the field changes of the rows in `lines` and the order of these rows are used.
    """

    start: Pretrained
    settings: AdaptationRecipe
    lines: Lines


@dataclass(frozen=True)
class FineTuning:
    """Fine-tuning on a few labelled pokes of a new skin; `row` contains their row numbers."""

    start: Pretrained
    settings: FineTuningRecipe
    row: Int64[np.ndarray, " o"]


@dataclass(frozen=True)
class TrainingJob:
    """One training run.

    experiment: the experiment that uses the result, such as `lobo` (leave one board out). train, test: row numbers.
    tuning: None for training from random weights. skin: name of the skin to adapt to. what: additional text in the name
    of the job. attempt_i: number of earlier training runs of this job, all of which collapsed.
    """

    experiment: str
    recipe_name: str
    recipe: Recipe
    fold: str
    seed: int
    seed_i: int
    train: Int64[np.ndarray, " a"]
    test: Int64[np.ndarray, " b"]
    tuning: Adaptation | FineTuning | None = None
    skin: str = ""
    what: str = ""
    attempt_i: int = 0

    @property
    def name(self) -> str:
        """File name of the model, which is unique within a stage."""
        parts = [self.experiment, self.recipe_name, self.fold, self.skin, self.what, f"seed{self.seed_i}"]
        return ".".join(part for part in parts if part)

    @property
    def schedule(self) -> Schedule:
        return self.recipe if self.tuning is None else self.tuning.settings

    @property
    def loss_weights(self) -> LossWeights:
        tuning = self.tuning
        return LossWeights(
            triplet=self.recipe.triplet_weight,
            unlabelled=tuning.settings.unlabelled_weight if isinstance(tuning, Adaptation) else 0.0,
            few_labels=tuning.settings.own_weight if isinstance(tuning, FineTuning) else 0.0,
        )


class JobKeys:
    """Computes cache keys for jobs on the same data.

    A key is a digest of a job's rows, recipe, seed and initial weights, of the code, and of the versions of libraries.
    """

    def __init__(self, data: TrainingData) -> None:
        self.data = data
        self._train_digests: dict[int, tuple[np.ndarray, str]] = {}

    def key(self, job: TrainingJob) -> str:
        decisive = [
            device(), *signature(), job.fold, job.skin, job.recipe.model_dump_json(), job.seed, job.seed_i,
            job.attempt_i, self._train_digest(job.train), _digest(self.data.db_uT[job.test]),
            *map(digest, CODE_MODULES), *map(importlib.metadata.version, LIBRARIES), sys.platform,
        ]  # fmt: skip
        if job.tuning is not None:
            decisive += [job.tuning.start.key, job.tuning.settings.model_dump_json()]
        match job.tuning:
            case Adaptation(lines=lines):
                decisive += [_digest(self.data.db_uT[lines.row], lines.line_i, lines.order_i)]
            case FineTuning(row=row):
                decisive += [_digest(self.data.db_uT[row], self.data.target[row])]
        return hashlib.sha256(json.dumps(decisive).encode()).hexdigest()[:32]

    def data_digest(self) -> str:
        """Return a digest of all rows: fields, targets, and the grouping of rows by skin."""
        return _digest(self.data.db_uT, self.data.target, np.unique(self.data.skin, return_inverse=True)[1])

    def _train_digest(self, train: np.ndarray) -> str:
        if id(train) not in self._train_digests:  # the array is stored below, so no other array gets its id
            skin = np.unique(self.data.skin[train], return_inverse=True)[1]
            content = _digest(self.data.db_uT[train], self.data.target[train], skin)
            self._train_digests[id(train)] = (train, content)
        return self._train_digests[id(train)][1]


def _digest(*arrays: np.ndarray) -> str:
    found = hashlib.sha256()
    for array in arrays:
        found.update(f"{array.dtype}{array.shape}".encode())
        found.update(np.ascontiguousarray(array).data)
    return found.hexdigest()[:32]


def curve_steps(steps_n: int) -> list[int]:
    """Return for each point of a loss curve the last step that it covers, in a training run of `steps_n` steps.

    >>> curve_steps(3), curve_steps(800)[:3], len(curve_steps(800))
    ([1, 2, 3], [16, 32, 48], 50)
    """
    points_n = min(CURVE_POINTS_N, steps_n)
    return [round(steps_n * (i + 1) / points_n) for i in range(points_n)]


def median_call_s(call: Callable[[], object]) -> float:
    """Return the median time in s of `REPEATS_N` calls, after one call to warm the caches."""
    call()
    times_s = []
    for _ in range(REPEATS_N):
        start_s = perf_counter()
        call()
        times_s.append(perf_counter() - start_s)
    return float(np.median(times_s))

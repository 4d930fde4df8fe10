"""Training jobs, their results, and the keys under which results are cached.

A training job either trains a network from random weights, on one fold with one recipe and one seed, or it adapts or
fine-tunes a trained network to a new skin. `JobKeys` computes the cache key of a job, which is a digest of everything
on which the result of the job depends.
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

# A network has collapsed if it predicts nearly the same value of a target for all inputs. This is detected by the
# explained variance (R2) of each target on training rows, which is usually above 0.9. The network has collapsed if the
# R2 of any target is below this limit.
COLLAPSED = 0.05
# The modules on whose code the result of a training run depends. A test (tests/models/test_job.py) compares this list
# with the modules that are imported.
CODE_MODULES = (
    "reskin.seeds",
    *(
        f"reskin.models.{name}"
        for name in ("batches", "inputs", "job", "losses", "network", "optimiser", "reproducible", "train")
    ),
)
LIBRARIES = ("torch", "numpy", "scipy")
REPEATS_N = 25
# Number of points of a loss curve. If a training run has fewer steps, its curve has one point for each step.
CURVE_POINTS_N = 50

Weights = Mapping[str, np.ndarray]


@dataclass(frozen=True)
class LossWeights:
    """The weights of the loss terms that are added to the squared error on the training rows.

    triplet: weight of the triplet loss on the training rows.
    unlabelled: weight of the triplet loss on unlabelled pokes of the new skin.
    few_labels: weight of the squared error on labelled pokes of the new skin.
    """

    triplet: float
    unlabelled: float = 0.0
    few_labels: float = 0.0


@dataclass(frozen=True)
class TrainingData:
    """The rows of all skins. A training job selects its training rows and test rows from them by number.

    db_uT: the field changes.
    target: the targets, which are either x, y, F or, with shear forces, x, y, Fx, Fy, Fz.
    skin: the name of each row's skin. It is needed because the three rows of a triplet must be from the same skin.
    """

    db_uT: Float32[np.ndarray, "f ch"]
    target: Float32[np.ndarray, "f t"]
    skin: Shaped[np.ndarray, " f"]


@dataclass(frozen=True)
class TrainingResult:
    """The result of a training run.

    Networks with equal settings are trained together as a stack (see `reskin.models.network`). Therefore, the times
    are the times of the whole stack.

    key: the name of the result in the cache.
    weights, scaler: the trained network. If training diverged, the weights are those before the divergence.
    curve: the loss curve, which is the mean squared error in scaled units. Point i is the mean over the steps between
        entries i - 1 and i of `curve_steps`. If training diverged, the curve ends before the divergence.
    predicted: x and y in mm and forces in N, for the test rows.
    stopped_step: the step at which training diverged, or None.
    explained_min: the smallest explained variance (R2) of a target on training rows. It is None after a short run.
    seconds: the training time of the stack, divided by the number of its networks.
    started_s: the Unix time at which the training of the stack started.
    one_reading_s: the median time that a prediction for one reading takes.
    reused: whether the result was read from the cache.
    collapsed_before_n: the number of earlier training runs of this job, all of which collapsed.
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
    """A trained network from which adaptation or fine-tuning starts. `key` is the name of its result in the cache."""

    key: str
    weights: Weights
    scaler: Scaler


@dataclass(frozen=True)
class Adaptation:
    """An adaptation: self-supervised training of a trained network on unlabelled pokes of a new skin (paper section 5).

    Of the data of the new skin, only the field changes of the rows in `lines` and the order of these rows are used.
    """

    start: Pretrained
    settings: AdaptationRecipe
    lines: Lines


@dataclass(frozen=True)
class FineTuning:
    """A fine-tuning of a trained network on a few labelled pokes of a new skin. `row` contains their row numbers."""

    start: Pretrained
    settings: FineTuningRecipe
    row: Int64[np.ndarray, " o"]


@dataclass(frozen=True)
class TrainingJob:
    """The description of one training run.

    experiment: the experiment that uses the result, such as `lobo` (leave one board out).
    recipe_name, recipe: the settings of the training.
    fold: the name of the fold.
    seed, seed_i: the seed of the scene, and the index of this training run among the runs with different random draws.
    train, test: the numbers of the training rows and of the test rows.
    tuning: the adaptation or fine-tuning, or None for training from random weights.
    skin: the name of the skin to which the network is adapted.
    what: additional text in the name of the job.
    attempt_i: the number of earlier training runs of this job, all of which collapsed.
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
        """The name of the job, which is also the name of the model's file. It is unique within a stage."""
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
    """Computes the cache keys of jobs on the same data.

    A key is a digest of the rows, the recipe and the seed of a job. For adaptation and fine-tuning, the digest also
    includes the network from which the job starts. The code of the training and the versions of libraries are included,
    too.
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
        # The array is stored with its digest, so that no other array can get the same id.
        if id(train) not in self._train_digests:
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
    """Return the last step that each point of a loss curve covers, for a training run of `steps_n` steps.

    >>> curve_steps(3), curve_steps(800)[:3], len(curve_steps(800))
    ([1, 2, 3], [16, 32, 48], 50)
    """
    points_n = min(CURVE_POINTS_N, steps_n)
    return [round(steps_n * (i + 1) / points_n) for i in range(points_n)]


def median_call_s(call: Callable[[], object]) -> float:
    """Return the median time of `REPEATS_N` calls in s. One earlier call, which is not timed, warms the caches."""
    call()
    times_s = []
    for _ in range(REPEATS_N):
        start_s = perf_counter()
        call()
        times_s.append(perf_counter() - start_s)
    return float(np.median(times_s))

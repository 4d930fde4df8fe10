"""One training: a recipe on one fold with one seed, or a trained network fine-tuned on a new skin. In: rows, settings.

Out: what the loop needs (a `Job`), and a key that names the result by all that decides it. Refuses to know files,
processes and scores.
"""

import ast
import hashlib
import importlib.metadata
import json
import sys
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Int64, Shaped

from pipeline.core import seeds
from pipeline.core.numerics import signature
from pipeline.dataset import lines as lines_module
from pipeline.dataset.lines import Lines
from pipeline.learning.architecture import LAYERS, Weights, draw_weights
from pipeline.learning.augment import virtual_boards
from pipeline.learning.executors import device
from pipeline.learning.inputs import VIEW
from pipeline.learning.job import Job, Labelled, Terms, Unlabelled
from pipeline.learning.recipe import AugmentedRecipe, FineTuning, Labelling, Recipe, Schedule
from pipeline.learning.standardise import FIT, Scaler
from pipeline.learning.triplets import make_points

COLLAPSED = 0.05  # of a target's variance over a network's own training rows; sound ones explain more than 0.9
# The modules whose code decides what a training results in; recipes decide by their values.
DECIDING = (
    "architecture", "augment", "trial", "feed", "inputs", "job", "losses", "model", "stack", "standardise", "train",
    "triplets",
)  # fmt: skip


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
    one_reading_s: float  # median, to answer for a single reading
    reused: bool = False  # finished by an earlier run
    collapsed_before_n: int = 0  # trainings of the same trial before this one, that collapsed

    @property
    def collapsed(self) -> bool:
        """Whether it answers nearly the same to any input: its loss never fell, at least for one target."""
        return self.explained_min is not None and self.explained_min < COLLAPSED


@dataclass(frozen=True)
class Start:
    """The trained network that fine-tuning starts from, and its key."""

    key: str
    weights: Weights
    scaler: Scaler


@dataclass(frozen=True)
class Adapting:
    """Fine-tuning to a new skin by its unlabelled pokes: lines name rows, and nothing else of them is looked at."""

    start: Start
    settings: FineTuning
    lines: Lines


@dataclass(frozen=True)
class FewLabels:
    """Fine-tuning to a new skin by a few labelled pokes, whose rows `own` names."""

    start: Start
    settings: Labelling
    own: Int64[np.ndarray, " o"]


@dataclass(frozen=True)
class Trial:
    """One training. `train` and `test` are row numbers; `skin` is the one adapted to, `what` tells its name apart."""

    question: str
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
        parts = [self.question, self.recipe_name, self.fold, self.skin, self.what, f"seed{self.seed_i}"]
        return ".".join(part for part in parts if part)

    @property
    def schedule(self) -> Schedule:
        """How long and how fast it is trained."""
        return self.recipe if self.tuning is None else self.tuning.settings

    @property
    def terms(self) -> Terms:
        """The weights of the loss."""
        match self.tuning:
            case Adapting(settings=settings):
                return Terms(self.recipe.triplet_weight, unlabelled=settings.unlabelled_weight)
            case FewLabels(settings=settings):
                return Terms(self.recipe.triplet_weight, own=settings.own_weight)
        return Terms(self.recipe.triplet_weight)


def make_job(trial: Trial, rows: Measured) -> tuple[Job, Scaler]:
    """Scale what a trial learns from: by a scaler fitted on its training rows, or by that of its first network.

    Of a new skin's unlabelled pokes only the change of field and the order along lines is taken.
    """
    view = VIEW[trial.recipe.inputs](rows.db_uT[trial.train])
    target = rows.target[trial.train]
    # Without the recipe in its name: recipes are compared from equal starts on equal batches.
    again = ("again", trial.attempt_i) if trial.attempt_i else ()
    rng = seeds.rng_for(trial.seed, "train", trial.fold, trial.skin, trial.seed_i, *again)
    if trial.tuning is None:
        scaler = FIT[trial.recipe.scaling](view, target)
        layers = LAYERS[trial.recipe.architecture](view.shape[1], target.shape[1])
        # A ReLU on the output (the released network) begins dead for some target in about every third network if its
        # bias is drawn too, and what is dead never learns.
        start: Weights = draw_weights(layers, rng) | {f"layer{len(layers)}.bias": _mean_answer(scaler, target)}
    else:
        scaler, start = trial.tuning.start.scaler, trial.tuning.start.weights
    labelled = _labelled(trial, rows, scaler)
    unlabelled = _unlabelled(trial, rows, scaler) if trial.terms.unlabelled else None
    own = _own(trial, rows, scaler) if trial.terms.own else None
    return Job(start, rng, labelled, unlabelled, own), scaler


def _mean_answer(scaler: Scaler, target: np.ndarray) -> Float32[np.ndarray, " t"]:
    """Give the mean of every scaled target; 0 for one that is not known."""
    known = ~np.isnan(target).all(axis=0)
    mean = np.zeros(target.shape[1], np.float32)
    mean[known] = np.nanmean(scaler.encode_target(target)[:, known], axis=0, dtype=np.float64)
    return mean


def _labelled(trial: Trial, rows: Measured, scaler: Scaler) -> Labelled:
    db_uT, target, skin = (values[trial.train] for values in (rows.db_uT, rows.target, rows.skin))
    if isinstance(trial.recipe, AugmentedRecipe):
        rng = seeds.rng_for(trial.seed, "augment", trial.fold, trial.seed_i)
        copies_uT, copied = virtual_boards(db_uT, skin, trial.recipe.augmentation, rng)
        own = np.unique(skin, return_inverse=True)[1]
        skin = np.concatenate([own, copied + own.max() + 1])
        db_uT = np.concatenate([db_uT, copies_uT])
        target = np.tile(target, (1 + trial.recipe.augmentation.copies_n, 1))
    points = make_points(target[:, :2], skin) if trial.recipe.triplet_weight else None
    return Labelled(scaler.encode(VIEW[trial.recipe.inputs](db_uT)), scaler.encode_target(target), points)


def _unlabelled(trial: Trial, rows: Measured, scaler: Scaler) -> Unlabelled:
    assert isinstance(trial.tuning, Adapting)
    lines = trial.tuning.lines
    row, point_row = np.unique(lines.row, return_inverse=True)
    view = VIEW[trial.recipe.inputs](rows.db_uT[row])
    points = make_points(lines.order_i[:, None].astype(np.float64), lines.line_i)
    return Unlabelled(scaler.encode(view), points, point_row.astype(np.int64))


def _own(trial: Trial, rows: Measured, scaler: Scaler) -> Labelled:
    assert isinstance(trial.tuning, FewLabels)
    own = trial.tuning.own
    view = VIEW[trial.recipe.inputs](rows.db_uT[own])
    return Labelled(scaler.encode(view), scaler.encode_target(rows.target[own]), None)


class Keys:
    """Names trials by all that decides their results: rows, recipe, seed, start, code, torch; keeps what it hashed."""

    def __init__(self, rows: Measured) -> None:
        self.rows = rows
        self.known: dict[int, tuple[np.ndarray, str]] = {}

    def key(self, trial: Trial) -> str:
        """Name a trial."""
        words = [
            device(), *signature(), trial.fold, trial.skin, trial.recipe.model_dump_json(), trial.seed, trial.seed_i,
            trial.attempt_i,
            self._labelled(trial.train), _digest(self.rows.db_uT[trial.test]),
            _code_digest(), importlib.metadata.version("torch"), importlib.metadata.version("numpy"), sys.platform,
        ]  # fmt: skip
        if trial.tuning is not None:
            words += [trial.tuning.start.key, trial.tuning.settings.model_dump_json()]
        match trial.tuning:
            case Adapting(lines=lines):
                words += [_digest(self.rows.db_uT[lines.row], lines.line_i, lines.order_i)]
            case FewLabels(own=own):
                words += [_digest(self.rows.db_uT[own], self.rows.target[own])]
        return hashlib.sha256(json.dumps(words).encode()).hexdigest()[:32]

    def rows_digest(self) -> str:
        """Name all rows."""
        return _digest(self.rows.db_uT, self.rows.target)

    def _labelled(self, train: np.ndarray) -> str:
        if id(train) not in self.known:  # the array is kept, so that its id stays its own
            skin = np.unique(self.rows.skin[train], return_inverse=True)[1]
            self.known[id(train)] = (train, _digest(self.rows.db_uT[train], self.rows.target[train], skin))
        return self.known[id(train)][1]


def _digest(*arrays: np.ndarray) -> str:
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(f"{array.dtype}{array.shape}".encode())
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()[:32]


@lru_cache(maxsize=1)
def _code_digest() -> str:
    digest = hashlib.sha256()
    folder = Path(__file__).parent
    for source in [*(folder / f"{name}.py" for name in DECIDING), Path(seeds.__file__), Path(lines_module.__file__)]:
        digest.update(code_of(source.read_text(encoding="utf-8")).encode())
    return digest.hexdigest()


def code_of(source: str) -> str:
    """Give a module's code without comments and docstrings: what its words say changes no result.

    >>> code_of("x = 1  # metres\\n\\ndef twice(y):\\n    'Double it.'\\n    return 2 * y").split("\\n")
    ['x = 1', '', 'def twice(y):', '    return 2 * y']
    """
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(node, clean=False):
            node.body = node.body[1:] or [ast.Pass()]
    return ast.unparse(tree)

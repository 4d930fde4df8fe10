"""What a few labels of a new board are tried on. In: rows, folds, settings. Out: networks, adapted and labelled ones.

Refuses to know how they are run and scored.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int64

from pipeline.core.errors import ParamsError
from pipeline.core.seeds import rng_for
from pipeline.dataset.lines import grid_lines
from pipeline.dataset.rows import Rows
from pipeline.dataset.splits import Fold
from pipeline.learning.baselines import Task
from pipeline.learning.comparison import FewLabels as Settings
from pipeline.learning.trial import Adapting, FewLabels, Start, Trained, Trial

QUESTION = "labels"


@dataclass(frozen=True)
class Study:
    """Rows, the folds of the question, the scene's seed, and what is asked."""

    rows: Rows
    folds: Sequence[Fold]
    seed: int
    asked: Settings


@dataclass(frozen=True)
class Tried:
    """One entry of the table: a method on a fold with so many labels."""

    method: str
    inputs: str
    labels_n: int
    fold: Fold


Done = tuple[Tried, Trial, Trained]


def networks(at: Study, done: Sequence[Done]) -> list[tuple[Tried, Trial]]:
    """Train every recipe on every fold."""
    return [
        (
            Tried(name, recipe.inputs, 0, fold),
            Trial(QUESTION, name, recipe, fold.name, at.seed, 0, fold.train, fold.test),
        )
        for fold in at.folds
        for name, recipe in at.asked.recipes.items()
    ]


def adapted(at: Study, done: Sequence[Done]) -> list[tuple[Tried, Trial]]:
    """Adapt the named recipes by all pokes of the pool, unlabelled."""
    return [
        (
            Tried(f"{tried.method}, adapted", tried.inputs, 0, tried.fold),
            _tuned(
                at, trial, Adapting(_start(one), at.asked.adapting, grid_lines(at.rows, tried.fold.pool)), "adapted"
            ),
        )
        for tried, trial, one in done
        if trial.recipe_name in at.asked.adapted
    ]


def labelled(at: Study, done: Sequence[Done]) -> list[tuple[Tried, Trial]]:
    """Fine-tune every network on every number of labelled pokes."""
    return [
        (
            Tried(tried.method, tried.inputs, labels_n, tried.fold),
            _tuned(at, trial, FewLabels(_start(one), at.asked.labelling, own), f"{trial.what}{labels_n}labels"),
        )
        for tried, trial, one in done
        for labels_n, own in _own(at, tried.fold).items()
        if labels_n
    ]


def classical(at: Study) -> list[tuple[Tried, Task]]:
    """Fit every classical method with every number of labelled pokes."""
    return [
        (
            Tried(one.words, one.inputs, labels_n, fold),
            Task(f"{name}.{fold.name}.{labels_n}", one, fold.train, fold.test, own, at.asked.rows_max_n, at.seed),
        )
        for fold in at.folds
        for name, one in at.asked.methods.items()
        for labels_n, own in _own(at, fold).items()
    ]


def _own(at: Study, fold: Fold) -> Mapping[int, Int64[np.ndarray, " o"]]:
    """Choose the labelled pokes of the pool at random, the fewer among the more; give their rows."""
    indentations = np.unique(at.rows.indentation[fold.pool])
    if max(at.asked.labels_n) > len(indentations):
        raise ParamsError(
                f"fold labels/{fold.name}", "few_labels.labels_n", f"at most the {len(indentations)} pokes of its pool",
                max(at.asked.labels_n), "Ask for fewer, or raise split.labels_pool_n.",
            )  # fmt: skip
    order = rng_for(at.seed, "labelled", fold.name).permutation(indentations)
    return {n: fold.pool[np.isin(at.rows.indentation[fold.pool], order[:n])] for n in at.asked.labels_n}


def _start(one: Trained) -> Start:
    return Start(one.key, one.weights, one.scaler)


def _tuned(at: Study, trial: Trial, tuning: Adapting | FewLabels, what: str) -> Trial:
    return Trial(
        QUESTION, trial.recipe_name, trial.recipe, trial.fold, at.seed, trial.seed_i, trial.train, trial.test, tuning,
        trial.fold.rsplit("-draw", 1)[0], what,
    )  # fmt: skip

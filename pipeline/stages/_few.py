"""What stage few_labels tries: folds and settings -> networks, adapted and labelled ones. Knows no argv."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int64

from pipeline.dataset.lines import grid_lines
from pipeline.dataset.splits import Fold
from pipeline.learning.baselines import Task
from pipeline.learning.cell import Adapting, Cell, FewLabels, Start, Trained
from pipeline.learning.comparison import FewLabels as Asked
from pipeline.seeds import rng_for
from pipeline.stages._train import Scenery

QUESTION = "labels"


@dataclass(frozen=True)
class Tried:
    """One entry of the table: a method on a fold with so many labels."""

    method: str
    inputs: str
    labels_n: int
    fold: Fold


Done = tuple[Tried, Cell, Trained]


def networks(at: Scenery, asked: Asked, done: Sequence[Done]) -> list[tuple[Tried, Cell]]:
    """Train every recipe on every fold."""
    return [
        (
            Tried(name, recipe.inputs, 0, fold),
            Cell(QUESTION, name, recipe, fold.name, at.asked.seed, 0, fold.train, fold.test),
        )
        for fold in at.of(QUESTION)
        for name, recipe in asked.recipes.items()
    ]


def adapted(at: Scenery, asked: Asked, done: Sequence[Done]) -> list[tuple[Tried, Cell]]:
    """Adapt the named recipes by all pokes of the pool, unlabelled."""
    return [
        (
            Tried(f"{tried.method}, adapted", tried.inputs, 0, tried.fold),
            _tuned(at, cell, Adapting(_start(one), asked.adapting, grid_lines(at.rows, tried.fold.pool)), "adapted"),
        )
        for tried, cell, one in done
        if cell.recipe_name in asked.adapted
    ]


def labelled(at: Scenery, asked: Asked, done: Sequence[Done]) -> list[tuple[Tried, Cell]]:
    """Fine-tune every network on every number of labelled pokes."""
    return [
        (
            Tried(tried.method, tried.inputs, labels_n, tried.fold),
            _tuned(at, cell, FewLabels(_start(one), asked.labelling, own), f"{cell.what}{labels_n}labels"),
        )
        for tried, cell, one in done
        for labels_n, own in _own(at, asked, tried.fold).items()
        if labels_n
    ]


def classical(at: Scenery, asked: Asked) -> list[tuple[Tried, Task]]:
    """Fit every classical method with every number of labelled pokes."""
    return [
        (
            Tried(one.words, one.inputs, labels_n, fold),
            Task(f"{name}.{fold.name}.{labels_n}", one, fold.train, fold.test, own, asked.rows_max_n, at.asked.seed),
        )
        for fold in at.of(QUESTION)
        for name, one in asked.methods.items()
        for labels_n, own in _own(at, asked, fold).items()
    ]


def _own(at: Scenery, asked: Asked, fold: Fold) -> Mapping[int, Int64[np.ndarray, " o"]]:
    """Choose the labelled pokes of the pool at random, the fewer among the more; give their rows."""
    indentations = np.unique(at.rows.indentation[fold.pool])
    order = rng_for(at.asked.seed, "labelled", fold.name).permutation(indentations)
    return {n: fold.pool[np.isin(at.rows.indentation[fold.pool], order[:n])] for n in asked.labels_n}


def _start(one: Trained) -> Start:
    return Start(one.key, one.weights, one.scaler)


def _tuned(at: Scenery, cell: Cell, tuning: Adapting | FewLabels, what: str) -> Cell:
    return Cell(
        QUESTION, cell.recipe_name, cell.recipe, cell.fold, at.asked.seed, cell.seed_i, cell.train, cell.test, tuning,
        cell.skin, what,
    )  # fmt: skip

"""Experiment `labels`: methods that receive different numbers of labelled indentations of a held-out board.

Networks are trained, adapted with unlabelled indentations, and fine-tuned on labelled ones. Classical methods are
fitted to the training rows and the labelled indentations. This module lists the training jobs;
`pipeline.stages.universal` runs and scores them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from jaxtyping import Int64
from pydantic import Field, model_validator

from pipeline.settings import Row, SectionWithRows, Settings, take
from reskin.data.lines import grid_lines
from reskin.data.rows import Rows
from reskin.data.splits import Fold, labelling_order
from reskin.errors import ParamsError
from reskin.models.classical import Classical, ClassicalJob
from reskin.models.job import Adaptation, FineTuning, Pretrained, TrainingJob, TrainingResult
from reskin.models.recipe import AdaptationRecipe, AugmentedRecipe, FineTuningRecipe, Name, Recipe

EXPERIMENT = "labels"
Labels = Annotated[tuple[Annotated[int, Field(ge=0)], ...], Field(min_length=1)]


class FewLabels(SectionWithRows):
    """Settings section `few_labels`.

    - labels_n: numbers of labelled indentations of the held-out board.
    - recipes: recipes of the networks that are trained.
    - adapted: recipes whose networks are also adapted with unlabelled indentations.
    - adapting: settings of these adaptations.
    - labelling: settings of the fine-tuning on labelled indentations.
    - rows_max_n: largest number of training rows to which a classical method is fitted.
    - methods: classical methods.
    """

    labels_n: Labels
    recipes: dict[Name, Recipe | AugmentedRecipe]
    adapted: tuple[Name, ...]
    adapting: AdaptationRecipe
    labelling: FineTuningRecipe
    rows_max_n: Annotated[int, Field(ge=1)]
    methods: dict[Name, Classical]

    @classmethod
    def expand(cls, section: Row, settings: Settings, where: str) -> Row:
        base = settings.row("recipes", section, "recipe", where) | {"steps_n": take(section, "steps_n", where)}
        adapting, labelling = dict(take(section, "adapting", where)), dict(take(section, "labelling", where))
        return section | {
            "recipes": {name: base | changes for name, changes in take(section, "recipes", where).items()},
            "adapting": settings.row("adaptations", adapting, "adaptation", f"{where}.adapting") | adapting,
            "labelling": settings.row("labellings", labelling, "labelling", f"{where}.labelling") | labelling,
            "methods": settings.row("methods", section, "methods", where),
        }

    @model_validator(mode="after")
    def _check_adapted_recipes(self) -> "FewLabels":
        if unknown := set(self.adapted) - set(self.recipes):
            raise ValueError(f"adapted must name recipes of few_labels, not {sorted(unknown)}")
        return self


@dataclass(frozen=True)
class Study:
    """Inputs of the experiment: the scene's rows, the experiment's folds, the seed and the settings."""

    rows: Rows
    folds: Sequence[Fold]
    seed: int
    settings: FewLabels


@dataclass(frozen=True)
class Entry:
    """Identifies one result of the experiment by the method, the method's inputs, the number of labels and the fold."""

    method: str
    inputs: str
    labels_n: int
    fold: Fold


TrainedEntry = tuple[Entry, TrainingJob, TrainingResult]


def network_jobs(study: Study, trained_entries: Sequence[TrainedEntry]) -> list[tuple[Entry, TrainingJob]]:
    """List the jobs that train every recipe on every fold."""
    return [
        (
            Entry(name, recipe.inputs, 0, fold),
            TrainingJob(EXPERIMENT, name, recipe, fold.name, study.seed, 0, fold.train, fold.test),
        )
        for fold in study.folds
        for name, recipe in study.settings.recipes.items()
    ]


def adaptation_jobs(study: Study, trained_entries: Sequence[TrainedEntry]) -> list[tuple[Entry, TrainingJob]]:
    """List the jobs that adapt networks of recipes `adapted` with all indentations of the fold's pool, without labels.

    The pool is the set of indentations of the held-out board that are reserved for calibration and not tested.
    """
    pairs = []
    for entry, job, trained in trained_entries:
        if job.recipe_name in study.settings.adapted:
            lines = grid_lines(study.rows, entry.fold.pool)
            tuning = Adaptation(_to_pretrained(trained), study.settings.adapting, lines)
            adapted = Entry(f"{entry.method}, adapted", entry.inputs, 0, entry.fold)
            pairs.append((adapted, replace(job, tuning=tuning, skin=entry.fold.board, what="adapted")))
    return pairs


def fine_tuning_jobs(study: Study, trained_entries: Sequence[TrainedEntry]) -> list[tuple[Entry, TrainingJob]]:
    """List the jobs that fine-tune every trained or adapted network on each number of labelled indentations."""
    pairs = []
    for entry, job, trained in trained_entries:
        for labels_n, row in _labelled_rows(study, entry.fold).items():
            if labels_n:
                tuning = FineTuning(_to_pretrained(trained), study.settings.labelling, row)
                labelled = Entry(entry.method, entry.inputs, labels_n, entry.fold)
                what = f"{job.what}{labels_n}labels"
                pairs.append((labelled, replace(job, tuning=tuning, skin=entry.fold.board, what=what)))
    return pairs


def classical_jobs(study: Study) -> list[tuple[Entry, ClassicalJob]]:
    """List the jobs that fit every classical method with each number of labelled indentations."""
    rows_max_n = study.settings.rows_max_n
    return [
        (
            Entry(method.title, method.inputs, labels_n, fold),
            ClassicalJob(f"{name}.{fold.name}.{labels_n}", method, fold.train, fold.test, row, rows_max_n, study.seed),
        )
        for fold in study.folds
        for name, method in study.settings.methods.items()
        for labels_n, row in _labelled_rows(study, fold).items()
    ]


def _labelled_rows(study: Study, fold: Fold) -> Mapping[int, Int64[np.ndarray, " o"]]:
    """Draw labelled indentations from the fold's pool (see `adaptation_jobs`); return their rows by number of labels.

    The indentations for a smaller number of labels are also among those for every larger number.
    """
    indentation, labels_n = study.rows.indentation[fold.pool], study.settings.labels_n
    order = labelling_order(study.rows, fold, study.seed)
    if max(labels_n) > len(order):
        rule = f"at most the {len(order)} indentations for calibration"
        remedy = "Reduce few_labels.labels_n, or increase split.labels_pool_n."
        raise ParamsError(f"fold labels/{fold.name}", "few_labels.labels_n", rule, max(labels_n), remedy)
    return {n: fold.pool[np.isin(indentation, order[:n])] for n in labels_n}


def _to_pretrained(trained: TrainingResult) -> Pretrained:
    return Pretrained(trained.key, trained.weights, trained.scaler)

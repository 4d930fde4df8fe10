"""Stages that train on the folds of a scene: train_single, train_multi, train_triplet, adapt, train_classical."""

from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from pipeline.executors import make_executor
from pipeline.settings import Adaptations, Settings, Training, take
from pipeline.stage import say
from pipeline.training.before_contact import BY_TIME, score_before_touch
from pipeline.training.trainings import (
    adaptations,
    measured,
    note_seconds,
    prepare_training,
    read_data,
    read_starts,
    score_test,
    train_all,
    trials_of,
    write_models,
)
from reskin import io
from reskin.config import Strict, parse
from reskin.data.rows import SCORED
from reskin.data.splits import ONE_SKIN
from reskin.models.classical import Classical, Task, run_tasks
from reskin.models.recipe import Name
from reskin.models.trained import networks_by_fold

NO_LABELS = np.zeros(0, np.int64)


def read_train_single(settings: Settings) -> Training:
    """Parse section train_single."""
    return settings.training("train_single")


def train_single(settings: Settings, indentations: Path, folds: Path, models: Path) -> None:
    """Train on one skin at a time: same-sensor splits, and one skin on others (paper sections 4 and 5.1).

    Also scores how well a place is known before its contact, on the folds within one skin.
    """
    prepare_training()
    data = read_data(settings, indentations, folds)
    own = [fold for fold in data.folds if fold.experiment in ONE_SKIN]
    trials = trials_of(data, read_train_single(settings), own)
    write_models(models, data, trials, train_all(data, trials, "train_single"), "train_single")
    told = score_before_touch(data, indentations, io.read_json(folds)["captures"], networks_by_fold(models, BY_TIME))
    io.write_table(models / SCORED, told)


def read_train_multi(settings: Settings) -> Training:
    """Parse section train_multi."""
    return settings.training("train_multi")


def train_multi(settings: Settings, indentations: Path, folds: Path, models: Path) -> None:
    """Train on the skins of all boards but one (paper section 5.1)."""
    prepare_training()
    data = read_data(settings, indentations, folds)
    trials = trials_of(data, read_train_multi(settings), data.folds_of("lobo"))
    write_models(models, data, trials, train_all(data, trials, "train_multi"), "train_multi")


def read_train_triplet(settings: Settings) -> Training:
    """Parse section train_triplet."""
    return settings.training("train_triplet")


def train_triplet(settings: Settings, indentations: Path, folds: Path, models: Path) -> None:
    """Train on the skins of all boards but one, with the triplet loss (paper section 5)."""
    prepare_training()
    data = read_data(settings, indentations, folds)
    trials = trials_of(data, read_train_triplet(settings), data.folds_of("lobo"), experiment="triplet")
    write_models(models, data, trials, train_all(data, trials, "train_triplet"), "train_triplet")


def read_adapt(settings: Settings) -> Adaptations:
    """Parse section adapt."""
    return settings.adaptations()


def adapt(settings: Settings, indentations: Path, folds: Path, started: Path, models: Path) -> None:
    """Adapt the networks with triplet loss to each held-out skin by its unlabelled indentations (paper section 5)."""
    prepare_training()
    data, starts, section = read_data(settings, indentations, folds), read_starts(started), read_adapt(settings)
    trials = [
        trial
        for fold in data.folds_of("lobo")
        for named in section.recipes.items()
        for trial in adaptations(data, fold, named, starts, experiment="adapt", pokes_n=section.pokes_n)
    ]
    write_models(models, data, trials, train_all(data, trials, "adapt"), "adapt")


class ClassicalMethods(Strict):
    """Section train_classical: classical methods, each on at most `rows_max_n` training rows."""

    rows_max_n: Annotated[int, Field(ge=1)]
    methods: dict[Name, Classical]


def read_train_classical(settings: Settings) -> ClassicalMethods:
    """Parse section train_classical, with the set of methods that it names."""
    section, where = dict(settings["train_classical"]), f"{settings.where}: train_classical"
    methods = settings.row("methods", take(section, "methods", where))
    return parse(ClassicalMethods, section | {"methods": methods}, where)


def train_classical(settings: Settings, indentations: Path, folds: Path, scores: Path) -> None:
    """Fit classical methods on the folds of train_multi."""
    data, section = read_data(settings, indentations, folds), read_train_classical(settings)
    pairs = [(fold, name, method) for fold in data.folds_of("lobo") for name, method in section.methods.items()]
    tasks = [
        Task(f"{name}.{fold.name}", method, fold.train, fold.test, NO_LABELS, section.rows_max_n, settings.seed)
        for fold, name, method in pairs
    ]
    with make_executor(imports="reskin.models.classical") as executor:
        fitted = run_tasks(tasks, measured(data), executor, lambda line: say(f"{settings.scene} classical: {line}"))
    points = [
        {"name": name, "method": method.title, "inputs": method.inputs, "fold": fold.name, "seed_i": 0}
        | {"rows_n": answer.rows_n, "scores": score_test(data, fold.test, answer.predicted)}
        for (fold, name, method), answer in zip(pairs, fitted, strict=True)
    ]
    io.write_json(scores, points)
    note_seconds(settings.scene, "train_classical", tasks, fitted)

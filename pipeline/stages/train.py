"""Stages that train models on the folds of a scene.

They train networks on one skin or on many skins, adapt networks to new skins, and fit classical methods.
"""

from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from pipeline.executors import make_executor
from pipeline.settings import Adaptations, Row, SectionWithRows, Settings, Training
from pipeline.stage import say
from pipeline.training import BEFORE_CONTACT_FILE
from pipeline.training.before_contact import BY_TIME, score_before_contact
from pipeline.training.final import train_final
from pipeline.training.jobs import (
    adaptation_jobs,
    code_of,
    make_jobs,
    preload_training,
    read_data,
    read_pretrained,
    score_test,
    train_jobs,
    training_data,
    write_models,
    write_timings,
)
from reskin import io
from reskin.data.splits import ONE_SKIN
from reskin.models.classical import Classical, ClassicalJob, run_classical_jobs
from reskin.models.recipe import Name
from reskin.models.trained import networks_by_fold

NO_LABELS = np.zeros(0, np.int64)


def train_single(settings: Settings, section: Training, indentations: Path, folds: Path, models: Path) -> None:
    """Train networks on one skin each, and test them on the same skin or on other skins (paper sections 4 and 5.1).

    If training rows and test rows are from the same skin, the stage also runs the control experiments of
    `pipeline.training.before_contact`. They predict places from readings before the contact.
    """
    preload_training()
    data = read_data(settings, indentations, folds)
    folds_of_one_skin = [fold for fold in data.folds if fold.experiment in ONE_SKIN]
    jobs = make_jobs(data, section, folds_of_one_skin)
    write_models(models, data, jobs, train_jobs(data, jobs, "train_single"), "train_single")
    captures, networks = io.read_json(folds)["captures"], networks_by_fold(models, BY_TIME)
    io.write_table(models / BEFORE_CONTACT_FILE, score_before_contact(data, indentations, captures, networks))


def train_multi(
    settings: Settings, section: Training, indentations: Path, folds: Path, models: Path, final: Path
) -> None:
    """Train networks on the skins of all boards except one, and test them on this board (paper section 5.1).

    Each board is held out in turn. After that, the final model is trained on all boards.
    """
    preload_training()
    data = read_data(settings, indentations, folds)
    jobs = make_jobs(data, section, data.folds_of("lobo"))
    cards = write_models(models, data, jobs, train_jobs(data, jobs, "train_multi"), "train_multi")
    train_final(final, data, section, cards, code_of("train_multi"))


def train_triplet(settings: Settings, section: Training, indentations: Path, folds: Path, models: Path) -> None:
    """Train networks as in `train_multi`, but with the triplet loss (paper section 5); there is no final model."""
    preload_training()
    data = read_data(settings, indentations, folds)
    jobs = make_jobs(data, section, data.folds_of("lobo"), experiment="triplet")
    write_models(models, data, jobs, train_jobs(data, jobs, "train_triplet"), "train_triplet")


def adapt(
    settings: Settings, section: Adaptations, indentations: Path, folds: Path, pretrained: Path, models: Path
) -> None:
    """Adapt the networks of stage train_triplet to each held-out skin (paper section 5).

    The adaptation to a skin uses unlabelled indentations of this skin.
    """
    preload_training()
    data = read_data(settings, indentations, folds)
    networks = read_pretrained(pretrained)
    jobs = [
        job
        for fold in data.folds_of("lobo")
        for named_recipe in section.recipes.items()
        for job in adaptation_jobs(data, fold, named_recipe, networks, experiment="adapt", pokes_n=section.pokes_n)
    ]
    write_models(models, data, jobs, train_jobs(data, jobs, "adapt"), "adapt")


class ClassicalMethods(SectionWithRows):
    """Settings of stage train_classical: section `train_classical` of a scene's file.

    rows_max_n: largest number of training rows to which a method is fitted.
    methods: settings of the classical methods, by name.
    """

    rows_max_n: Annotated[int, Field(ge=1)]
    methods: dict[Name, Classical]

    @classmethod
    def expand(cls, section: Row, settings: Settings, where: str) -> Row:
        return section | {"methods": settings.row("methods", section, "methods", where)}


def train_classical(
    settings: Settings, section: ClassicalMethods, indentations: Path, folds: Path, scores: Path
) -> None:
    """Fit classical methods on the same folds on which stage train_multi trains networks, and score them."""
    data = read_data(settings, indentations, folds)
    pairs = [(fold, name, method) for fold in data.folds_of("lobo") for name, method in section.methods.items()]
    jobs = [
        ClassicalJob(f"{name}.{fold.name}", method, fold.train, fold.test, NO_LABELS, section.rows_max_n, settings.seed)
        for fold, name, method in pairs
    ]
    with make_executor(imports="sklearn.ensemble") as executor:
        results = run_classical_jobs(
            jobs, training_data(data), executor, lambda line: say(f"{settings.scene} classical: {line}")
        )
    points = [
        {"name": name, "method": method.title, "inputs": method.inputs, "fold": fold.name, "seed_i": 0}
        | {"rows_n": result.rows_n, "scores": score_test(data, fold.test, result.predicted)}
        for (fold, name, method), result in zip(pairs, results, strict=True)
    ]
    io.write_json(scores, points)
    write_timings(settings.scene, "train_classical", jobs, results)

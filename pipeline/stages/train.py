"""Stages that train models on the folds of a scene.

They train networks on one skin or on many skins, and adapt networks to new skins.
"""

from pathlib import Path

from pipeline.settings import Adaptations, Settings, Training
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
    train_jobs,
    write_models,
)
from reskin import io
from reskin.data.splits import ONE_SKIN
from reskin.models.trained import networks_by_fold


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

"""Stages that train models on the folds of a scene.

They train networks on one skin or on many skins, and adapt networks to new skins.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from pipeline.scores import join, make_table, rows_of_cards, write_scores
from pipeline.settings import Adaptations, Settings, Training
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
from reskin.models.recipe import HEADLINE
from reskin.models.trained import networks_by_fold

POINTS_N = 300  # number of test readings in the plots of predictions


def train_single(
    settings: Settings, section: Training, indentations: Path, folds: Path, models: Path, scores: Path, plots: Path
) -> None:
    """Train networks on one skin each, and test them on the same skin or on other skins (paper sections 4 and 5.1).

    If training rows and test rows are from the same skin, the stage also runs the control experiments of
    `pipeline.training.before_contact`. They predict places from readings before the contact.
    """
    preload_training()
    data = read_data(settings, indentations, folds)
    folds_of_one_skin = [fold for fold in data.folds if fold.experiment in ONE_SKIN]
    jobs = make_jobs(data, section, folds_of_one_skin)
    cards = write_models(models, data, jobs, train_jobs(data, jobs, "train_single"), "train_single")
    write_plots(plots, models, cards)
    captures, networks = io.read_json(folds)["captures"], networks_by_fold(models, BY_TIME)
    controls = make_table(score_before_contact(data, indentations, captures, networks))
    write_scores(scores, join([rows_of_cards(cards), controls]))


def train_multi(
    settings: Settings,
    section: Training,
    indentations: Path,
    folds: Path,
    models: Path,
    final: Path,
    scores: Path,
    plots: Path,
) -> None:
    """Train networks on the skins of all boards except one, and test them on this board (paper section 5.1).

    Each board is held out in turn. After that, the final model is trained on all boards.
    """
    preload_training()
    data = read_data(settings, indentations, folds)
    jobs = make_jobs(data, section, data.folds_of("lobo"))
    cards = write_models(models, data, jobs, train_jobs(data, jobs, "train_multi"), "train_multi")
    write_plots(plots, models, cards)
    write_scores(scores, rows_of_cards(cards))
    train_final(final, data, section, cards, code_of("train_multi"))


def train_triplet(
    settings: Settings, section: Training, indentations: Path, folds: Path, models: Path, scores: Path, plots: Path
) -> None:
    """Train networks as in `train_multi`, but with the triplet loss (paper section 5); there is no final model."""
    preload_training()
    data = read_data(settings, indentations, folds)
    jobs = make_jobs(data, section, data.folds_of("lobo"), experiment="triplet")
    cards = write_models(models, data, jobs, train_jobs(data, jobs, "train_triplet"), "train_triplet")
    write_plots(plots, models, cards)
    write_scores(scores, rows_of_cards(cards))


def adapt(
    settings: Settings,
    section: Adaptations,
    indentations: Path,
    folds: Path,
    pretrained: Path,
    models: Path,
    scores: Path,
    plots: Path,
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
    cards = write_models(models, data, jobs, train_jobs(data, jobs, "adapt"), "adapt")
    write_plots(plots, models, cards)
    write_scores(scores, rows_of_cards(cards))


def write_plots(plots: Path, models: Path, cards: Sequence[Mapping[str, Any]]) -> None:
    """Write the data of the plots that `dvc plots` shows: loss curves, and predictions against true values.

    They are those of the section's own recipe: the mean loss over its networks at each step, and predictions of test
    readings, spread evenly over all of its networks. Readings with an unknown force or place are left out.
    """
    headline = [card for card in cards if card["recipe_name"] == HEADLINE]
    points = pd.concat([pd.DataFrame({"step": card["curve_steps"], "loss": card["curve"]}) for card in headline])
    rows = io.read_table(models / "predictions.parquet").to_pandas().query("recipe == @HEADLINE")
    rows = rows.rename(columns={"true_Fz_N": "true_force_N", "predicted_Fz_N": "predicted_force_N"})
    tables = {"loss": points.groupby("step", as_index=False)["loss"].mean()}
    for name, columns in (("force", ["true_force_N", "predicted_force_N"]), ("place", ["true_x_mm", "predicted_x_mm"])):
        known = rows[columns].dropna()
        tables[name] = known.iloc[np.linspace(0, len(known) - 1, min(POINTS_N, len(known))).astype(int)]
    io.write_texts(
        plots, {f"{name}.csv": table.to_csv(index=False, float_format="%.5g") for name, table in tables.items()}
    )

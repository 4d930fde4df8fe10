"""Stages of figure 6: adaptation with few and many pokes, and training on few and many skins."""

from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from pipeline.settings import Settings
from pipeline.training.jobs import (
    SceneData,
    adaptation_jobs,
    preload_training,
    read_data,
    read_pretrained,
    sweep_point,
    train_jobs,
    write_timings,
)
from reskin import io
from reskin.config import Strict
from reskin.data.splits import Fold
from reskin.errors import ParamsError
from reskin.models.job import Pretrained, TrainingJob
from reskin.models.recipe import HEADLINE, Recipe


class PokesSweep(Strict):
    """Section sweep_pokes: numbers of unlabelled indentations (0: not adapted); the last `boards_n` boards held out."""

    pokes_n: Annotated[tuple[Annotated[int, Field(ge=0)], ...], Field(min_length=1)]
    boards_n: Annotated[int, Field(ge=1)]


def read_sweep_pokes(settings: Settings) -> PokesSweep:
    """Parse section sweep_pokes."""
    return settings.section(PokesSweep, "sweep_pokes")


def sweep_pokes(settings: Settings, indentations: Path, folds: Path, pretrained: Path, scores: Path) -> None:
    """Adapt with every number of unlabelled indentations and score (paper figure 6a)."""
    preload_training()
    data, starts = read_data(settings, indentations, folds), read_pretrained(pretrained)
    sweep, recipe = read_sweep_pokes(settings), settings.adaptations().recipes[HEADLINE]
    held_out = data.folds_of("lobo")[-sweep.boards_n :]
    if sweep.boards_n > len(held_out):
        rule = f"at most the {len(held_out)} boards of the scene"
        raise ParamsError(settings.where, "sweep_pokes.boards_n", rule, sweep.boards_n, "Ask for fewer.")
    pairs = [
        (job, pokes_n)
        for fold in held_out
        for pokes_n in sweep.pokes_n
        if pokes_n
        for job in adaptation_jobs(data, fold, (HEADLINE, recipe), starts, experiment="pokes", pokes_n=pokes_n)
    ]
    jobs = [job for job, _ in pairs]
    trained = train_jobs(data, jobs, "sweep_pokes")
    points = [
        sweep_point(data, job, result, "adapted") | {"pokes_n": pokes_n}
        for (job, pokes_n), result in zip(pairs, trained, strict=True)
    ]
    io.write_json(scores, points + _unadapted(pretrained, recipe.base, {fold.name for fold in held_out}))
    write_timings(settings.scene, "sweep_pokes", jobs, trained)


def _unadapted(pretrained: Path, base: str, held_out: set[str]) -> list[dict[str, Any]]:
    """Take the scores of the networks that adaptation starts from, as points with no pokes."""
    cards = [io.read_json(file) for file in sorted(pretrained.glob("*.json"))]
    kept = ("key", "question", "fold", "seed_i", "stopped_step", "scores")
    return [
        {name: card[name] for name in kept} | {"method": "triplet", "pokes_n": 0}
        for card in cards
        if card["recipe_name"] == base and card["fold"] in held_out
    ]


def sweep_sensors(settings: Settings, indentations: Path, folds: Path, scores: Path) -> None:
    """Train the headline recipes on every draw of skins, adapt to each held-out skin, and score (paper figure 6b)."""
    preload_training()
    data = read_data(settings, indentations, folds)
    multi, triplet = (settings.training(section).recipes for section in ("train_multi", "train_triplet"))
    section = settings.adaptations()
    recipe = section.recipes[HEADLINE]
    jobs = _jobs(data, multi[HEADLINE], "multi") + _jobs(data, triplet[recipe.base], "triplet")
    trained = train_jobs(data, jobs, "sweep_sensors")
    starts = {
        (recipe.base, job.fold, job.seed_i): Pretrained(result.key, result.weights, result.scaler)
        for job, result in zip(jobs, trained, strict=True)
        if job.what == "triplet"
    }
    adapted = [
        job
        for fold in _folds(data)
        for job in adaptation_jobs(
            data, fold, (HEADLINE, recipe), starts, experiment="sensors", pokes_n=section.pokes_n
        )
    ]
    methods = [job.what for job in jobs] + ["adapted"] * len(adapted)
    jobs, trained = jobs + adapted, trained + train_jobs(data, adapted, "sweep_sensors")
    three = zip(jobs, trained, methods, strict=True)
    io.write_json(scores, [sweep_point(data, job, result, method) for job, result, method in three])
    write_timings(settings.scene, "sweep_sensors", jobs, trained)


def _folds(data: SceneData) -> list[Fold]:
    """Order folds by their number of training skins, most first, so that those of all skins stack as in `train_multi`.

    Finished trainings are cached by their whole stack; only in this order are those of `train_multi` reused.
    """
    return sorted(data.folds_of("sensors"), key=lambda fold: -len(np.unique(data.rows.skin[fold.train])))


def _jobs(data: SceneData, recipe: Recipe, method: str) -> list[TrainingJob]:
    """Make one job for each draw of skins; its seed is the draw, as the fold's name is part of the generator's."""
    return [
        TrainingJob("sensors", HEADLINE, recipe, fold.name, data.settings.seed, 0, fold.train, fold.test, what=method)
        for fold in _folds(data)
    ]

"""Stages of paper figure 6: adaptation with different numbers of pokes, and training on different numbers of skins."""

from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from pipeline.experiments.results import write_results
from pipeline.scores import rows_of_networks, write_scores
from pipeline.settings import Adaptations, Settings, Training
from pipeline.statistics import tally
from pipeline.training.jobs import (
    adaptation_jobs,
    collapse_record,
    network_keys,
    preload_training,
    read_data,
    read_pretrained,
    score_test,
    train_jobs,
)
from reskin import io
from reskin.config import Strict
from reskin.errors import ParamsError
from reskin.models.job import Pretrained, TrainingJob
from reskin.models.recipe import HEADLINE


class PokesSweep(Strict):
    """Section sweep_pokes: numbers of unlabelled indentations; 0 means no adaptation.

    boards_n: number of held-out boards, which are the last boards of the scene.
    """

    pokes_n: Annotated[tuple[Annotated[int, Field(ge=0)], ...], Field(min_length=1)]
    boards_n: Annotated[int, Field(ge=1)]


def sweep_pokes(
    settings: Settings,
    section: PokesSweep,
    indentations: Path,
    folds: Path,
    pretrained: Path,
    scores: Path,
    results: Path,
) -> None:
    """Adapt networks with each number of unlabelled indentations, and score them (paper figure 6a)."""
    preload_training()
    data, networks = read_data(settings, indentations, folds), read_pretrained(pretrained)
    recipe = settings.section(Adaptations, "adapt").recipes[HEADLINE]
    held_out = data.folds_of("lobo")[-section.boards_n :]
    if section.boards_n > len(held_out):
        rule = f"at most {len(held_out)}, the number of boards of the scene"
        remedy = "Reduce sweep_pokes.boards_n."
        raise ParamsError(settings.where, "sweep_pokes.boards_n", rule, section.boards_n, remedy)
    named_recipe = (HEADLINE, recipe)
    pairs = [
        (job, pokes_n)
        for fold in held_out
        for pokes_n in section.pokes_n
        if pokes_n
        for job in adaptation_jobs(data, fold, named_recipe, networks, experiment="pokes", pokes_n=pokes_n)
    ]
    jobs = [job for job, _ in pairs]
    trained = train_jobs(data, jobs, "sweep_pokes")
    scored = [
        (network_keys(data, job, "adapted") | {"pokes_n": pokes_n}, score_test(data, job.test, result.predicted))
        for (job, pokes_n), result in zip(pairs, trained, strict=True)
    ]
    scored += _before_adaptation(pretrained, recipe.base, {fold.name for fold in held_out})
    write_scores(scores, rows_of_networks(scored))
    write_results(results, {}, {}, trainings=tally(map(collapse_record, trained)))


def _before_adaptation(pretrained: Path, base: str, held_out: set[str]) -> list[tuple[dict[str, Any], dict[str, Any]]]:
    """Return the keys and scores of the networks before adaptation, which is adaptation with 0 pokes."""
    cards = [io.read_json(file) for file in sorted(pretrained.glob("*.json"))]
    return [
        (
            {"experiment": "pokes", "method": "triplet", "fold": card["fold"], "seed": card["seed_i"], "pokes_n": 0},
            card["scores"],
        )
        for card in cards
        if card["recipe_name"] == base and card["fold"] in held_out
    ]


def sweep_sensors(settings: Settings, indentations: Path, folds: Path, scores: Path, results: Path) -> None:
    """Train networks on every draw of skins, adapt them to each held-out skin, and score them (paper figure 6b)."""
    preload_training()
    data, section = read_data(settings, indentations, folds), settings.section(Adaptations, "adapt")
    adaptation = section.recipes[HEADLINE]
    recipes = {
        "multi": settings.section(Training, "train_multi").recipes[HEADLINE],
        "triplet": settings.section(Training, "train_triplet").recipes[adaptation.base],
    }
    # Several networks are trained in one computation, which is called a stack. The cache can reuse a result only if the
    # whole stack is the same. The folds with most training skins come first, so that the folds with all training skins
    # form the same stacks as in stage train_multi, and are not trained again.
    draws = sorted(data.folds_of("sensors"), key=lambda fold: -len(np.unique(data.rows.skin[fold.train])))
    # One seed per draw of skins is enough, because the random numbers of a network depend on the fold's name, which
    # contains the draw.
    jobs = [
        TrainingJob("sensors", HEADLINE, recipe, fold.name, settings.seed, 0, fold.train, fold.test, what=method)
        for method, recipe in recipes.items()
        for fold in draws
    ]
    trained = train_jobs(data, jobs, "sweep_sensors")
    pretrained = {
        (adaptation.base, job.fold, job.seed_i): Pretrained(result.key, result.weights, result.scaler)
        for job, result in zip(jobs, trained, strict=True)
        if job.what == "triplet"
    }
    named_recipe = (HEADLINE, adaptation)
    adapted = [
        job
        for fold in draws
        for job in adaptation_jobs(data, fold, named_recipe, pretrained, experiment="sensors", pokes_n=section.pokes_n)
    ]
    methods = [job.what for job in jobs] + ["adapted"] * len(adapted)
    jobs, trained = jobs + adapted, trained + train_jobs(data, adapted, "sweep_sensors")
    scored = [
        (network_keys(data, job, method), score_test(data, job.test, result.predicted))
        for job, result, method in zip(jobs, trained, methods, strict=True)
    ]
    write_scores(scores, rows_of_networks(scored))
    write_results(results, {}, {}, trainings=tally(map(collapse_record, trained)))

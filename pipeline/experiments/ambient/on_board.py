"""What stage ambient does on one held-out board: fields added, arms tried, answers scored. Knows no argv."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd

from pipeline.core.seeds import rng_for
from pipeline.dataset.splits import Fold
from pipeline.evaluation.metrics import score
from pipeline.evaluation.scores import tally
from pipeline.experiments.ambient.fields import (
    Case,
    Instrument,
    iron_cases,
    one_a_poke,
    project,
    uniform_cases,
    without_common_part,
)
from pipeline.experiments.ambient.settings import Ambient
from pipeline.learning.card import collapse_record
from pipeline.learning.recipe import HEADLINE, Training
from pipeline.physics.skin import draw_skin
from pipeline.synthesis.settings import Synthesis
from pipeline.trials.data import SceneData, train_all, trials_of
from pipeline.trials.networks import Network

AS_IT_IS, ASIDE, OWN = "as it is", "reference chip subtracted", "own chips' common part subtracted"
Networks = Mapping[str, Sequence[Network]]  # by arm


def networks_of_common_part(
    data: SceneData, fold: Fold, training: Training, own: Instrument
) -> tuple[list[Network], dict[str, int]]:
    """Train the headline recipe anew on inputs whose common part is taken off, as in use; count what collapsed."""
    without = project(data.rows.db_uT, without_common_part(own.turn))
    headline = training.model_copy(update={"recipes": {HEADLINE: training.recipes[HEADLINE]}})
    trials = trials_of(data, headline, [fold], question="ambient")
    trained = train_all(replace(data, rows=replace(data.rows, db_uT=without)), trials, "ambient")
    networks = [
        Network({"recipe": trial.recipe.model_dump(mode="json")}, {**one.weights, **one.scaler.arrays()})
        for trial, one in zip(trials, trained, strict=True)
    ]
    return networks, tally(map(collapse_record, trained))


def on_board(
    data: SceneData, fold: Fold, asked: Ambient, *, of: Synthesis, own: Instrument, networks: Networks
) -> Iterator[dict[str, Any]]:
    """Score every arm that has networks in every field, on one reading of each of the board's held-out pokes."""
    test = one_a_poke(data.rows.indentation, fold.test, rng_for(data.settings.seed, "ambient", fold.name, "pokes"))
    db_uT, true = data.rows.db_uT[test], data.rows.target[test]
    off = without_common_part(own.turn)
    arms: dict[str, Callable[[Case], np.ndarray]] = {
        AS_IT_IS: lambda case: db_uT + case.added_uT,
        ASIDE: lambda case: db_uT + case.added_uT - case.guessed_uT,
        OWN: lambda case: project((db_uT + case.added_uT).astype(np.float32), off),
    }
    rng = rng_for(data.settings.seed, "ambient", fold.name, "uniform")
    for case in (
        *uniform_cases(own, asked.fields_uT, rows_n=len(test), rng=rng),
        *_iron(data, fold, test, asked, of, own),
    ):
        for arm, trained in networks.items():
            shown = arms[arm](case).astype(np.float32)
            scores = pd.DataFrame([score(true, network(shown)) for network in trained]).mean().to_dict()
            yield {"board": fold.name, "arm": arm, **case.words, "scores": scores}


def _iron(
    data: SceneData, fold: Fold, test: np.ndarray, asked: Ambient, of: Synthesis, own: Instrument
) -> Iterator[Case]:
    names, which = np.unique(data.rows.skin[test], return_inverse=True)
    rule = of.main_boards.quadrature.quadrature()
    skins = [draw_skin(of.skin, of.spreads, seed=data.settings.seed, name=str(name), rule=rule) for name in names]
    rng = rng_for(data.settings.seed, "ambient", fold.name, "iron")
    return iron_cases(own, skins, which, radius_mm=asked.iron.radius_mm, distances_mm=asked.iron.distances_mm, rng=rng)

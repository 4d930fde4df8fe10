"""What stage ambient does on one held-out board: fields added, arms tried, answers scored. Knows no argv."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from pipeline.dataset.splits import Fold
from pipeline.evaluation.ambient import (
    Case,
    Instrument,
    iron_cases,
    one_a_poke,
    project,
    uniform_cases,
    without_common_part,
)
from pipeline.evaluation.metrics import score, summarise
from pipeline.evaluation.tally import tally
from pipeline.learning.card import went
from pipeline.learning.recipe import HEADLINE, Training
from pipeline.physics.skin import draw_skin
from pipeline.sections import Ambient
from pipeline.seeds import rng_for
from pipeline.stages._networks import Network
from pipeline.stages._train import Scenery, cells_of, train_all
from pipeline.synthesis.capture import Synthesis

AS_IT_IS, ASIDE, OWN = "as it is", "reference chip subtracted", "own chips' common part subtracted"
Networks = Mapping[str, Sequence[Network]]  # by arm


def networks_of_common_part(
    at: Scenery, fold: Fold, training: Training, own: Instrument
) -> tuple[list[Network], dict[str, int]]:
    """Train the headline recipe anew on inputs whose common part is taken off, as in use; count what collapsed."""
    without = project(at.rows.db_uT, without_common_part(own.turn))
    headline = training.model_copy(update={"recipes": {HEADLINE: training.recipes[HEADLINE]}})
    cells = cells_of(at, headline, [fold], question="ambient")
    trained = train_all(replace(at, rows=replace(at.rows, db_uT=without)), cells, "ambient")
    networks = [
        Network({"recipe": cell.recipe.model_dump(mode="json")}, {**one.weights, **one.scaler.arrays()})
        for cell, one in zip(cells, trained, strict=True)
    ]
    return networks, tally(map(went, trained))


def on_board(
    at: Scenery, fold: Fold, asked: Ambient, *, of: Synthesis, own: Instrument, networks: Networks
) -> Iterator[dict[str, Any]]:
    """Score every arm that has networks in every field, on one reading of each of the board's held-out pokes."""
    test = one_a_poke(at.rows.indentation, fold.test, rng_for(at.asked.seed, "ambient", fold.name, "pokes"))
    db_uT, true = at.rows.db_uT[test], at.rows.target[test]
    off = without_common_part(own.turn)
    arms: dict[str, Callable[[Case], np.ndarray]] = {
        AS_IT_IS: lambda case: db_uT + case.added_uT,
        ASIDE: lambda case: db_uT + case.added_uT - case.guessed_uT,
        OWN: lambda case: project((db_uT + case.added_uT).astype(np.float32), off),
    }
    rng = rng_for(at.asked.seed, "ambient", fold.name, "uniform")
    for case in (
        *uniform_cases(own, asked.fields_uT, rows_n=len(test), rng=rng),
        *_iron(at, fold, test, asked, of, own),
    ):
        for arm, trained in networks.items():
            shown = arms[arm](case).astype(np.float32)
            each = summarise([score(true, network(shown)) for network in trained])
            scores = {name: value["mean"] for name, value in each.items()}
            yield {"board": fold.name, "arm": arm, **case.words, "scores": scores}


def _iron(at: Scenery, fold: Fold, test: np.ndarray, asked: Ambient, of: Synthesis, own: Instrument) -> Iterator[Case]:
    names, which = np.unique(at.rows.skin[test], return_inverse=True)
    rule = of.main_boards.quadrature.quadrature()
    skins = [draw_skin(of.skin, of.spreads, seed=at.asked.seed, name=str(name), rule=rule) for name in names]
    rng = rng_for(at.asked.seed, "ambient", fold.name, "iron")
    return iron_cases(own, skins, which, radius_mm=asked.iron.radius_mm, distances_mm=asked.iron.distances_mm, rng=rng)

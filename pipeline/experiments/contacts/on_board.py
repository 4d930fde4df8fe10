"""What stage contacts does on one held-out board: its pairs, answered and looked at. Knows no argv."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float32

from pipeline.core.seeds import rng_for
from pipeline.dataset.splits import Fold
from pipeline.experiments.contacts.oddness import direction_distance, disagreement, neighbour_distance, residual
from pipeline.experiments.contacts.pairs import Pairs, along_the_line, detect, draw_pairs, keep_aside, where_it_falls
from pipeline.experiments.contacts.settings import Contacts
from pipeline.learning.inputs import shape
from pipeline.trials.data import SceneData

KNOWN_ROWS_N = 6000  # that detectors look neighbours up in, drawn
SINGLES_N = 1000  # single contacts that a threshold is set on, and as many that are tested
SAME_PLACE = 0.0  # mm: what strength and noise of two readings do, without two places
Answering = Callable[[np.ndarray], np.ndarray]  # changes of field in uT -> x and y in mm, F in N
DRAWN_N = 60  # pairs a board and separation that the figure shows


def on_board(
    data: SceneData, fold: Fold, asked: Contacts, networks: Sequence[Answering]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Answer pairs of one held-out board: its numbers, and where answers fall for the figure."""
    rng = rng_for(data.settings.seed, "contacts", fold.name)
    fit, aside, what = keep_aside(data.rows, fold.train)
    known = rng.choice(fit, min(KNOWN_ROWS_N, len(fit)), replace=False)
    singles = {
        side: rng.choice(own, min(SINGLES_N, len(own)), replace=False)
        for side, own in (("aside", aside), ("test", fold.test))
    }
    pairs = {
        separation_mm: draw_pairs(data.rows, fold.test, separation_mm, pairs_n=asked.pairs_n, rng=rng)
        for separation_mm in (SAME_PLACE, *asked.separations_mm)
    }
    answers = {separation_mm: _answers(networks, one.sum_uT(data.rows.db_uT)) for separation_mm, one in pairs.items()}
    double = {
        separation_mm: _odd(data, known, one.sum_uT(data.rows.db_uT), answers[separation_mm])
        for separation_mm, one in pairs.items()
    }
    single = {
        side: _odd(data, known, data.rows.db_uT[own], _answers(networks, data.rows.db_uT[own]))
        for side, own in singles.items()
    }
    numbers = detect(single["aside"], single["test"], double, asked.false_alarm_fraction)
    numbers["falls"] = {s: _falls(data, pairs[s], answers[s]) for s in pairs}
    drawn = {
        f"{s:g}": along_the_line(*_truth(data, pairs[s]), answers[s][0])[:DRAWN_N].round(2).tolist()
        for s in asked.separations_mm
    }
    return numbers, {"kept_aside": what, "along": drawn}


def _answers(networks: Sequence[Answering], db_uT: Float32[np.ndarray, "f ch"]) -> Float32[np.ndarray, "m f 3"]:
    return np.stack([network(db_uT) for network in networks])


def _odd(data: SceneData, known: np.ndarray, db_uT: np.ndarray, answers: np.ndarray) -> dict[str, np.ndarray]:
    reference = data.rows.target[known], data.rows.db_uT[known]
    scores = {
        "direction and length": neighbour_distance(shape(data.rows.db_uT[known]), shape(db_uT)),
        "direction above noise": direction_distance(data.rows.db_uT[known], db_uT),
        "residual": residual(reference, answers.mean(axis=0), db_uT),
    }
    return scores | ({"networks disagree": disagreement(answers)} if len(answers) > 1 else {})


def _truth(data: SceneData, pairs: Pairs) -> tuple[np.ndarray, np.ndarray]:
    return data.rows.target[pairs.weaker], data.rows.target[pairs.stronger]


def _falls(data: SceneData, pairs: Pairs, answers: np.ndarray) -> dict[str, float]:
    each = [where_it_falls(*_truth(data, pairs), answer) for answer in answers]
    return {name: float(np.mean([one[name] for one in each])) for name in each[0]}

"""Stage contacts: what networks of single contacts make of two at once, and whether two are detected (section 7).

Refuses to know how networks are trained (`trials`).
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float32
from pydantic import Field

from pipeline.experiments.answer import write_answer
from pipeline.experiments.contacts.pairs import (
    Pairs,
    along_the_line,
    detect,
    direction_distance,
    disagreement,
    draw_pairs,
    keep_aside,
    neighbour_distance,
    residual,
    summarise_nested,
    where_it_falls,
)
from pipeline.experiments.contacts.superposition import superposition
from pipeline.settings import Settings
from pipeline.synthesis import synthesis_of
from pipeline.training.trainings import SceneData, read_data
from reskin.config import Strict
from reskin.data.splits import Fold
from reskin.models.inputs import shape
from reskin.models.trained import networks_without
from reskin.seeds import rng_for

Count = Annotated[int, Field(ge=1)]
Fraction = Annotated[float, Field(gt=0, lt=1)]


class Contacts(Strict):
    """Two contacts at once, as sums of two pokes of a held-out skin (paper section 7)."""

    pairs_n: Count
    separations_mm: Annotated[tuple[Annotated[float, Field(gt=0)], ...], Field(min_length=1)]
    false_alarm_fraction: Fraction


KNOWN_ROWS_N = 6000  # that detectors look neighbours up in, drawn
SINGLES_N = 1000  # single contacts that a threshold is set on, and as many that are tested
SAME_PLACE = 0.0  # mm: what strength and noise of two readings do, without two places
Answering = Callable[[np.ndarray], np.ndarray]  # changes of field in uT -> x and y in mm, F in N
DRAWN_N = 60  # pairs a board and separation that the figure shows


def on_board(
    data: SceneData, fold: Fold, section: Contacts, networks: Sequence[Answering]
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
        separation_mm: draw_pairs(data.rows, fold.test, separation_mm, pairs_n=section.pairs_n, rng=rng)
        for separation_mm in (SAME_PLACE, *section.separations_mm)
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
    numbers = detect(single["aside"], single["test"], double, section.false_alarm_fraction)
    numbers["falls"] = {s: _falls(data, pairs[s], answers[s]) for s in pairs}
    drawn = {
        f"{s:g}": along_the_line(*_truth(data, pairs[s]), answers[s][0])[:DRAWN_N].round(2).tolist()
        for s in section.separations_mm
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


# The networks behind two of the detectors were trained on all that the held-out board leaves, so on this part as well.
KEPT_ASIDE = (
    "training contacts of a {} among which detectors look no neighbours up; the networks behind `residual` and "
    "`networks disagree` were trained on them"
)


def read(settings: Settings) -> Contacts:
    """Read section contacts."""
    return settings.section(Contacts, "contacts")


def contacts(settings: Settings, folds: Path, indentations: Path, models: Path, answer: Path) -> None:
    """Add pokes of every held-out board in pairs, and ask the networks that never saw it."""
    data = read_data(settings, indentations, folds)
    settings, held_out = data.settings, data.folds_of("lobo")
    section = read(settings)
    boards, drawn = zip(
        *(on_board(data, fold, section, networks_without(models, fold.name)) for fold in held_out), strict=True
    )
    stats = summarise_nested(boards)
    numbers: dict[str, Any] = {
        "pairs_n": section.pairs_n,
        "boards_n": len(boards),
        "threshold_set_on": KEPT_ASIDE.format(drawn[0]["kept_aside"]),
        "noise": "that of two readings",
        "by_separation": [_row(stats, separation_mm) for separation_mm in section.separations_mm],
        "same_place": _row(stats, SAME_PLACE),
        "false_alarm_pct": {
            detector: {"asked": 100 * section.false_alarm_fraction, "realised": realised}
            for detector, realised in stats["false_alarm_pct"].items()
        },
        "auc": stats["auc"],
    }
    if "simulate" in settings.of_scene:
        numbers["superposition"] = superposition(
            synthesis_of(data.settings), section.separations_mm, seed=data.settings.seed
        )
    along = {s: [value for one in drawn for value in one["along"][s]] for s in drawn[0]["along"]}
    write_answer(answer, numbers, {"along": along})


def _row(stats: dict[str, Any], separation_mm: float) -> dict[str, Any]:
    return {"separation_mm": separation_mm, **stats["falls"][separation_mm], **stats["by_separation"][separation_mm]}

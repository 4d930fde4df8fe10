"""Stage ambient: what fields from outside and iron nearby cost, and what subtracting them regains (section 7).

Refuses to know how fields add up (`fields`) and how networks are trained (`trials`).
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field
from scipy.constants import micro

from pipeline.experiments.ambient.fields import (
    REFERENCE_ASIDE_MM,
    Case,
    Instrument,
    by_step,
    iron_cases,
    one_a_poke,
    project,
    take_board,
    uniform_cases,
    without_common_part,
)
from pipeline.experiments.answer import write_answer
from pipeline.report.statistics import tally
from pipeline.settings import Settings, Training
from pipeline.synthesis import synthesis_of
from pipeline.training.trainings import SceneData, collapse_record, read_data, train_all, trials_of
from reskin.config import Strict
from reskin.data.splits import Fold
from reskin.metrics import score
from reskin.models.recipe import HEADLINE
from reskin.models.trained import Network, networks_without
from reskin.physics.ambient import EARTH_DIP_DEG, EARTH_SIZE_T
from reskin.physics.skin import draw_skin
from reskin.seeds import rng_for
from reskin.simulation.settings import Synthesis


class Iron(Strict):
    """A ball of soft iron near the skin, right above its middle."""

    radius_mm: Annotated[float, Field(gt=0, le=100)]
    distances_mm: Annotated[tuple[Annotated[float, Field(gt=0)], ...], Field(min_length=1)]  # skin's top to its surface


class Ambient(Strict):
    """What a field from outside that comes up after the no-load reading does (paper section 7)."""

    fields_uT: Annotated[tuple[Annotated[float, Field(ge=0)], ...], Field(min_length=1)]
    iron: Iron


AS_IT_IS, ASIDE, OWN = "as it is", "reference chip subtracted", "own chips' common part subtracted"
Networks = Mapping[str, Sequence[Network]]  # by arm


def networks_of_common_part(
    data: SceneData, fold: Fold, training: Training, instrument: Instrument
) -> tuple[list[Network], dict[str, int]]:
    """Train the headline recipe anew on inputs whose common part is taken off, as in use; count what collapsed."""
    without = project(data.rows.db_uT, without_common_part(instrument.turn))
    headline = training.model_copy(update={"recipes": {HEADLINE: training.recipes[HEADLINE]}})
    trials = trials_of(data, headline, [fold], question="ambient")
    trained = train_all(replace(data, rows=replace(data.rows, db_uT=without)), trials, "ambient")
    networks = [
        Network({"recipe": trial.recipe.model_dump(mode="json")}, {**one.weights, **one.scaler.arrays()})
        for trial, one in zip(trials, trained, strict=True)
    ]
    return networks, tally(map(collapse_record, trained))


def on_board(
    data: SceneData, fold: Fold, section: Ambient, *, of: Synthesis, instrument: Instrument, networks: Networks
) -> Iterator[dict[str, Any]]:
    """Score every network of every arm in every field, on one reading of each of the board's held-out pokes."""
    test = one_a_poke(data.rows.indentation, fold.test, rng_for(data.settings.seed, "ambient", fold.name, "pokes"))
    db_uT, true = data.rows.db_uT[test], data.rows.target[test]
    off = without_common_part(instrument.turn)
    arms: dict[str, Callable[[Case], np.ndarray]] = {
        AS_IT_IS: lambda case: db_uT + case.added_uT,
        ASIDE: lambda case: db_uT + case.added_uT - case.guessed_uT,
        OWN: lambda case: project((db_uT + case.added_uT).astype(np.float32), off),
    }
    rng = rng_for(data.settings.seed, "ambient", fold.name, "uniform")
    for case in (
        *uniform_cases(instrument, section.fields_uT, rows_n=len(test), rng=rng),
        *_iron(data, fold, test, section, of, instrument),
    ):
        for arm, trained in networks.items():
            shown = arms[arm](case).astype(np.float32)
            for network in trained:
                yield {"board": fold.name, "arm": arm, **case.words, "scores": score(true, network(shown))}


def _iron(
    data: SceneData, fold: Fold, test: np.ndarray, section: Ambient, of: Synthesis, instrument: Instrument
) -> Iterator[Case]:
    names, which = np.unique(data.rows.skin[test], return_inverse=True)
    rule = of.main_boards.quadrature.quadrature()
    skins = [draw_skin(of.skin, of.spreads, seed=data.settings.seed, name=str(name), rule=rule) for name in names]
    rng = rng_for(data.settings.seed, "ambient", fold.name, "iron")
    return iron_cases(
        instrument, skins, which, radius_mm=section.iron.radius_mm, distances_mm=section.iron.distances_mm, rng=rng
    )


def read(settings: Settings) -> Ambient:
    """Read section ambient."""
    return settings.section(Ambient, "ambient")


def ambient(settings: Settings, folds: Path, indentations: Path, models: Path, answer: Path) -> None:
    """Test every held-out board in fields that came up after its no-load readings; train one arm on the last board."""
    data = read_data(settings, indentations, folds)
    of, seed = synthesis_of(data.settings), data.settings.seed
    section, trained = read(data.settings), data.settings.training("train_multi")
    held_out = data.folds_of("lobo")
    boards = [fold.name for fold in held_out]
    points: list[dict[str, Any]] = []
    for fold in held_out:
        instrument = take_board(of, fold.name, seed=seed)
        networks = {arm: networks_without(models, fold.name) for arm in (AS_IT_IS, ASIDE)}
        if fold is held_out[-1]:
            networks[OWN], trainings = networks_of_common_part(data, fold, trained, instrument)
        points += on_board(data, fold, section, of=of, instrument=instrument, networks=networks)
    last = boards[-1:]
    numbers = {
        "arms": {
            AS_IT_IS: "the paper's network",
            ASIDE: f"a chip {REFERENCE_ASIDE_MM:g} mm aside reads the ambient field, and its mean reading is taken off",
            OWN: "the uniform field that fits a board's own chips best is taken off, in training as in use",
        },
        "boards_n": len(boards),
        "seeds_n": trained.seeds_n,
        "directions": "a random one for each poke",
        "earth_uT": EARTH_SIZE_T / micro,
        "earth_dip_deg": EARTH_DIP_DEG,
        "iron_radius_mm": section.iron.radius_mm,
        "uniform": by_step(points, "field_uT", boards),
        "iron": by_step(points, "distance_mm", boards),
        "last_board": {
            "board": boards[-1],
            "uniform": by_step(points, "field_uT", last),
            "iron": by_step(points, "distance_mm", last),
        },
    }
    write_answer(answer, numbers, {}, trainings=trainings)

"""Stage rivals: what else may be done for a board that nobody calibrated, on the folds of question labels.

Inputs aligned with known boards'; a law fitted to unlabelled pokes, searched, and what it leaves over as an alarm; and,
as a control, what another skin's pokes do to all that use unlabelled ones. Refuses to know how each rival works
(modules beside this one).
"""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from pipeline.experiments.answer import read_folder, write_answer
from pipeline.experiments.compare.run import Compare, see, setup_of, skins_of, turns_of
from pipeline.experiments.rivals import aligned, flagged, told
from pipeline.experiments.rivals.alarm import alarm
from pipeline.experiments.rivals.points import Point, pokes_of, summarise
from pipeline.provenance import SECONDS
from pipeline.report.statistics import tally
from pipeline.settings import Settings
from pipeline.stage import say
from pipeline.training.trainings import SceneData, read_data
from pipeline.training.universal import QUESTION, Bench, Frame, Known, read_experts
from reskin import io
from reskin.config import Strict, parse
from reskin.data.splits import Fold
from reskin.errors import ParamsError
from reskin.models.classical import Classical
from reskin.models.recipe import Name, Recipe
from reskin.physics.skin import SkinDesign


class Rivals(Strict):
    """Section rivals: numbers of labels; regressors and the network whose inputs are aligned; the alarm's limit."""

    labels_n: Annotated[tuple[Annotated[int, Field(ge=1)], ...], Field(min_length=1)]
    methods: dict[Name, Classical]
    recipe: Recipe
    adversarial_weight: Annotated[float, Field(gt=0)]
    false_alarm_fraction: Annotated[float, Field(gt=0, lt=1)]


class RivalsRow(Strict):
    """Section rivals as a scene writes it: `methods` and `recipe` name rows of params.yaml."""

    labels_n: tuple[int, ...]
    methods: Name
    recipe: Name
    inputs: str
    steps_n: int
    adversarial_weight: float
    false_alarm_fraction: float


def read(settings: Settings) -> Rivals:
    """Read section rivals, with the rows that it names."""
    where = f"{settings.where}: rivals"
    row = parse(RivalsRow, settings["rivals"], where)
    recipe = settings.row("recipes", row.recipe) | {"inputs": row.inputs, "steps_n": row.steps_n}
    full = row.model_dump(exclude={"inputs", "steps_n"})
    return parse(Rivals, full | {"recipe": recipe, "methods": settings.row("methods", row.methods)}, where)


def rivals(settings: Settings, indentations: Path, folds: Path, models: Path, answer: Path) -> None:
    """Score rivals on every held-out board, on the rows that question labels tests."""
    data, compare = read_data(settings, indentations, folds), settings.section(Compare, "compare")
    skins = skins_of(read_folder(indentations, tuple(settings.captures_in(indentations))))
    if len(skins) < 2:
        raise ParamsError(f"scene {settings.scene}", "boards with known forces", "two or more", len(skins), "Add one.")
    setup = setup_of(compare, settings.shared_section(SkinDesign, "skin"))
    frame = Frame(turns_of(compare), compare.labels_middle_mm, compare.labels_mirrored)
    seen = {board: see(pokes, compare) for board, pokes in skins.items()}
    section, of_labels = read(settings), data.folds_of(QUESTION)
    points, trainings, unpaired_n = baselines(data, of_labels, section)
    nominal, rig = read_experts(Known(data, frame, setup, seen), models)
    bench = Bench(data, frame, seen, nominal, {}, {})
    took: list[told.Timed] = []
    for fold in of_labels:
        found, timed = told.score_told(bench, setup, of_labels, fold, rig)
        points, took = points + found, took + timed
        say(f"{settings.scene} rivals: {fold.name} told its own pokes, none and another skin's")
    alarms = alarm(data, frame, setup, seen, of_labels, section.false_alarm_fraction)
    numbers: dict[str, Any] = {
        "methods": summarise(points, aligned.controls(section.methods, section.labels_n) | told.controls()),
        "unpaired_n": unpaired_n,
        "flagged": [*flagged.experts(bench, of_labels, section.false_alarm_fraction), alarms.pop("flagged")],
        "alarm": alarms,
    }
    write_answer(answer, numbers, {}, trainings=tally(trainings))
    io.write_json(SECONDS / settings.scene / "rivals.json", [asdict(one) for one in took])


def baselines(data: SceneData, folds: Sequence[Fold], section: Rivals) -> tuple[list[Point], list[dict[str, Any]], int]:
    """Score the baselines; tell which networks collapsed; count labelled pokes that known boards have no pair of."""
    points: list[Point] = []
    trainings: list[dict[str, Any]] = []
    unpaired_n = 0
    for fold in folds:
        for method in section.methods.values():
            points += aligned.score_regressor(data, fold, method, section.labels_n)
        of_networks, records = aligned.score_adversarial(data, fold, section.recipe, section.adversarial_weight)
        points, trainings = points + of_networks, trainings + records
        pairs_uT = aligned.pairs_uT(data.rows, fold.train, pokes_of(data, fold)[: max(section.labels_n)])
        unpaired_n += int(np.isnan(pairs_uT).any(axis=1).sum())
        say(f"{data.scene} rivals: baselines of {fold.name} done")
    return points, trainings, unpaired_n

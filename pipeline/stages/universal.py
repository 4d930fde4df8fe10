"""Stage universal: experts that come with the project, on each held-out board, with no, a few and more of its labels.

A map, and a network with it; with recorded boards of the rig, and with none. Refuses to know how experts are taught
(`trials.experts`).
"""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

from pydantic import Field

from pipeline.experiments.answer import read_folder
from pipeline.experiments.compare.run import Compare, see, setup_of, skins_of, turns_of
from pipeline.stage import run, say
from pipeline.training.trainings import read_data
from pipeline.training.universal import (
    QUESTION,
    Bench,
    Frame,
    Known,
    make_experts,
    score_fold,
    tell_sureness,
    tell_tempers,
    write_networks,
)
from reskin import io
from reskin.config import Files, Settings, parse, read_settings
from reskin.errors import ParamsError
from reskin.physics.skin import SkinDesign
from reskin.universal.training import Lessons


class Universal(Lessons):
    """Section universal: networks' lessons; with so many labelled pokes of the held-out board."""

    labels_n: Annotated[tuple[Annotated[int, Field(ge=0)], ...], Field(min_length=1)]


def universal(scene: str, files: Files, indentations: Path, folds: Path, models: Path, scores: Path) -> None:
    """Score the experts on every held-out board, with every number of its labels, on the rows others are tested on."""
    settings = read_settings("universal", scene, files)
    data, section = read_data(settings, indentations, folds), settings.section(Compare, "compare")
    skins = skins_of(read_folder(indentations, tuple(settings.captures_in(indentations))))
    if len(skins) < 2:
        raise ParamsError(f"scene {scene}", "boards with known forces", "two or more", len(skins), "Add one.")
    setup = setup_of(section, parse(SkinDesign, settings.shared["skin"], "params.yaml: skin"))
    frame = Frame(turns_of(section), section.labels_middle_mm, section.labels_mirrored)
    seen = {board: see(pokes, section) for board, pokes in skins.items()}
    lessons = read(settings)
    nominal, rig = make_experts(Known(data, frame, setup, seen), lessons)
    write_networks(models, [nominal, *rig.values()], lessons, settings.seed)
    sureness = tell_sureness(nominal, lessons.labels_n, settings.seed)
    bench, points = Bench(data, frame, seen, nominal, {}, sureness), []
    bench = replace(bench, tempers=tell_tempers(bench, lessons.labels_n))
    for fold in data.folds_of(QUESTION):
        points += score_fold(bench, fold, rig, lessons.labels_n)
        say(f"{scene} universal: {fold.name} done")
    io.write_json(scores, points)


def read(settings: Settings) -> Universal:
    """Read section universal."""
    return settings.section(Universal, "universal")


if __name__ == "__main__":
    run(universal)

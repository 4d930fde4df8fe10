"""Stage universal: experts that come with the project, on each held-out board, with no, a few and more of its labels.

A map, and a network with it; with recorded boards of the rig, and with none.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from pydantic import Field

from pipeline.core import io
from pipeline.core.config import Files, Settings, parse, read_settings
from pipeline.core.errors import ParamsError
from pipeline.core.executors import make_executor
from pipeline.core.stage import run, say
from pipeline.experiments.answer import read_folder
from pipeline.experiments.compare.run import Compare, see, setup_of, skins_of, turns_of
from pipeline.physics.skin import SkinDesign
from pipeline.trials.data import SceneData, read_data
from pipeline.trials.universal import QUESTION, Bench, Experts, Frame, carried, recorded, score_fold
from pipeline.twin.fit import TEN, Seen, fit
from pipeline.twin.law import Setup
from pipeline.twin.tables import NOMINAL, OF_NOMINAL, OF_RIG, middle, tabulate
from pipeline.twin.training import Lessons, Syllabus, teach


class Universal(Lessons):
    """Section universal: networks' lessons; with so many labelled pokes of the held-out board."""

    labels_n: Annotated[tuple[Annotated[int, Field(ge=0)], ...], Field(min_length=1)]


@dataclass(frozen=True)
class Known:
    """What is known before a board is held out."""

    data: SceneData
    frame: Frame
    setup: Setup
    seen: Mapping[str, Seen]


def universal(scene: str, files: Files, indentations: Path, folds: Path, scores: Path) -> None:
    """Score the experts on every held-out board, with every number of its labels, on the rows others are tested on."""
    settings = read_settings("universal", scene, files)
    data, section = read_data(settings, indentations, folds), settings.section(Compare, "compare")
    skins = skins_of(read_folder(indentations, tuple(settings.captures_in(indentations))))
    if len(skins) < 2:
        raise ParamsError(f"scene {scene}", "boards with known forces", "two or more", len(skins), "Add one.")
    setup = setup_of(section, parse(SkinDesign, settings.shared["skin"], "params.yaml: skin"))
    frame = Frame(turns_of(section), section.labels_middle_mm, section.labels_mirrored)
    seen = {board: see(pokes, section) for board, pokes in skins.items()}
    nominal, rig = make_experts(Known(data, frame, setup, seen), read(settings))
    bench, points = Bench(data, frame, seen, nominal), []
    for fold in data.folds_of(QUESTION):
        points += score_fold(bench, fold, rig, read(settings).labels_n)
        say(f"{scene} universal: {fold.name} done")
    io.write_json(scores, points)


def make_experts(known: Known, lessons: Lessons) -> tuple[Experts, dict[str, Experts]]:
    """Fit known boards; make experts that know none, and for each board those that know the others."""
    seen, setup, data = known.seen, known.setup, known.data
    with make_executor(imports="pipeline.twin.training") as executor:
        laws = dict(zip(seen, executor.map(fit, seen.values(), [setup] * len(seen), [TEN] * len(seen)), strict=True))
        syllabuses = [Syllabus("nominal", NOMINAL, OF_NOMINAL, setup)]
        for board in seen:
            others = {other: own for other, own in seen.items() if other != board}
            taught = [recorded(data, known.frame, other, own.rest_uT.ravel()) for other, own in others.items()]
            centre, residual = middle([laws[other] for other in others]), carried(others, laws, setup)
            syllabuses.append(Syllabus(f"without {board}", centre, OF_RIG, setup, taught, residual))
        tables = [executor.submit(tabulate, each.centre, each.spreads, setup) for each in syllabuses]
        networks = [executor.submit(teach, each, lessons, data.settings.seed) for each in syllabuses]
        found = [
            Experts(of_map.result(), of_networks.result(), each.residual)
            for each, of_map, of_networks in zip(syllabuses, tables, networks, strict=True)
        ]
    say(f"{data.scene} universal: made {len(found)} pairs of experts")
    return found[0], dict(zip(seen, found[1:], strict=True))


def read(settings: Settings) -> Universal:
    """Read section universal."""
    return settings.section(Universal, "universal")


if __name__ == "__main__":
    run(universal)

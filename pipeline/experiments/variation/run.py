"""Stage variation: how the field of equal pokes differs over time and from skin to skin (paper figure 4)."""

from pathlib import Path
from typing import Any

from pipeline.core import io
from pipeline.core.config import Files, Settings, read_settings
from pipeline.core.stage import run
from pipeline.experiments.answer import read_folder, read_losses, write_answer
from pipeline.experiments.drift.windows import pace
from pipeline.experiments.variation.settings import Variation
from pipeline.experiments.variation.visits import (
    Visits,
    find_visits,
    first_of_each_board,
    meanwhile,
    over_skins,
    over_time,
)


def read(settings: Settings) -> Variation:
    """Read section variation."""
    return settings.section(Variation, "variation")


def variation(scene: str, files: Files, main: Path, indentations: Path, answer: Path) -> None:
    """Compare visits of equal places: of the worn skin in `indentations`, and of several skins in `main`."""
    settings = read_settings("variation", scene, files)
    asked = read(settings)
    worn = read_folder(indentations)[0]
    of_skins = _visits(main, settings.captures_in(main), asked)
    places: list[dict[str, Any]] = []
    drawn: list[dict[str, Any]] = []
    for place_i, (x_mm, y_mm) in enumerate(asked.places_mm):
        over = {
            "time": over_time(find_visits(worn, (x_mm, y_mm), asked.depth_mm), asked.contacts_n),
            "skins": over_skins({skin: visits[place_i] for skin, visits in of_skins.items()}),
        }
        where = {"x_mm": x_mm, "y_mm": y_mm}
        places.append(where | {name: told for name, (told, _) in over.items()})
        drawn.append(where | {name: lines for name, (_, lines) in over.items()})
    when = pace([worn]) | meanwhile(worn, asked.contacts_n)
    numbers = {"depth_mm": asked.depth_mm, "worn_skin": worn.skin} | when | {"places": places}
    write_answer(answer, numbers, {"places": drawn}, read_losses(indentations, {}))


def _visits(main: Path, names: list[str], asked: Variation) -> dict[str, list[Visits]]:
    """Find each asked skin's visits of each place, one capture in memory at a time."""
    boards: dict[str, str] = {}
    visits: dict[str, list[Visits]] = {}
    for name in names:
        one = io.read_readings(main / f"{name}.parquet")
        boards[one.skin] = one.board
        visits[one.skin] = [find_visits(one, place_mm, asked.depth_mm) for place_mm in asked.places_mm]
    return {skin: visits[skin] for skin in first_of_each_board(boards, asked.skins_n)}


if __name__ == "__main__":
    run(variation)

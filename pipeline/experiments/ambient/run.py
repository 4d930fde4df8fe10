"""Stage ambient: error against a field from outside and a ball of iron nearby, and what subtracting regains."""

from pathlib import Path
from typing import Any

from scipy.constants import micro

from pipeline.core.config import Files, Settings, read_settings
from pipeline.core.stage import run
from pipeline.experiments.ambient.fields import REFERENCE_ASIDE_MM, by_step, take_board
from pipeline.experiments.ambient.on_board import AS_IT_IS, ASIDE, OWN, networks_of_common_part, on_board
from pipeline.experiments.ambient.settings import Ambient
from pipeline.experiments.answer import write_answer
from pipeline.learning.recipe import training
from pipeline.physics.ambient import EARTH_DIP_DEG, EARTH_SIZE_T
from pipeline.synthesis.settings import synthesis_of
from pipeline.trials.data import read_data
from pipeline.trials.networks import networks_without


def read(settings: Settings) -> Ambient:
    """Read section ambient."""
    return settings.section(Ambient, "ambient")


def ambient(scene: str, files: Files, folds: Path, indentations: Path, models: Path, answer: Path) -> None:
    """Test every held-out board in fields that came up after its no-load readings; train one arm on the last board."""
    data = read_data(read_settings("ambient", scene, files), indentations, folds)
    of, seed = synthesis_of(data.settings), data.settings.seed
    asked, trained = read(data.settings), training(data.settings, "train_multi")
    held_out = data.folds_of("lobo")
    boards = [fold.name for fold in held_out]
    points: list[dict[str, Any]] = []
    for fold in held_out:
        own = take_board(of, fold.name, seed=seed)
        networks = {arm: networks_without(models, fold.name) for arm in (AS_IT_IS, ASIDE)}
        if fold is held_out[-1]:
            networks[OWN], trainings = networks_of_common_part(data, fold, trained, own)
        points += on_board(data, fold, asked, of=of, own=own, networks=networks)
    last = boards[-1:]
    numbers = {
        "arms": {
            AS_IT_IS: "the paper's network",
            ASIDE: f"a chip {REFERENCE_ASIDE_MM:g} mm aside reads the ambient field, and its mean reading is taken off",
            OWN: "the uniform field that fits a board's own chips best is taken off, in training as in use",
        },
        "boards_n": len(boards),
        "directions": "a random one for each poke",
        "earth_uT": EARTH_SIZE_T / micro,
        "earth_dip_deg": EARTH_DIP_DEG,
        "iron_radius_mm": asked.iron.radius_mm,
        "uniform": by_step(points, "field_uT", boards),
        "iron": by_step(points, "distance_mm", boards),
        "last_board": {
            "board": boards[-1],
            "uniform": by_step(points, "field_uT", last),
            "iron": by_step(points, "distance_mm", last),
        },
    }
    write_answer(answer, numbers, {}, trainings=trainings)


if __name__ == "__main__":
    run(ambient)

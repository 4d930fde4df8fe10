"""Stage rig: universal models that are made with the other boards of a rig, one for each held-out board."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

from pipeline.settings import Settings
from pipeline.stage import say
from pipeline.training.recorded import Compare, RecordedBoards, read_boards
from pipeline.training.rig import RigModel, make_models
from reskin import io
from reskin.errors import ParamsError
from reskin.universal.batches import TrainingSettings
from reskin.universal.model import load_universal, write


def rig(settings: Settings, section: TrainingSettings, indentations: Path, models: Path) -> None:
    """Make a universal model for each recorded board from simulated skins and from the scene's other boards.

    For each board, the folder `models` gets the file `<board>.safetensors` with its card. `reskin.load_universal`
    loads it.
    """
    boards = read_boards(settings, indentations)
    if not set(boards.presses) <= set(boards.rows.board):  # their names are `board/skin` if a board has several skins
        what = f"experiment rig needs boards with one skin each, but the scene has {', '.join(boards.presses)}"
        raise ParamsError(f"scene {settings.scene}: {what}. Remove this experiment from the scene.")
    layout = settings.section(Compare, "compare").layout
    powers = load_universal().powers
    made = make_models(boards, layout, section, settings.seed)
    with io.replacing(models) as folder:
        folder.mkdir()
        for board, model in made.items():
            about = card(board, model, boards, section.model_dump() | {"seed": settings.seed})
            file = folder / f"{board}.safetensors"
            write(model.tables, model.networks, powers, layout, about, file, residual=model.prior.residual)
    say(f"{settings.scene} rig: made models for {', '.join(made)}")


def card(board: str, model: RigModel, boards: RecordedBoards, training: dict[str, Any]) -> dict[str, Any]:
    """Return the card of a model: how it was made, and what it must not be used for."""
    others = ", ".join(other for other in boards.presses if other != board)
    return {
        "name": f"universal, boards of the rig without {board}",
        "source": "simulated and recorded",
        "map": f"around the mean of the laws that were fitted to {others}, with the errors of these laws",
        "network": f"trained on simulated skins and on presses of {others}",
        "likelihood_powers_of": "the shipped model",
        "not_for": "boards of another rig, skins of another kind, two contacts at once, shear",
        "centre": asdict(model.prior.centre),
        "training": training,
    }

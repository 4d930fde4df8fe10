"""Stage rig: universal models that are made with the other boards of a rig, one for each held-out board."""

from pathlib import Path

from pipeline.settings import Settings
from pipeline.stage import say
from pipeline.training.recorded import Compare
from pipeline.training.rig import make_models, recorded_boards
from reskin import io
from reskin.errors import ParamsError
from reskin.universal.episodes import TrainingSettings
from reskin.universal.model import load_universal, write


def rig(settings: Settings, section: TrainingSettings, indentations: Path, models: Path) -> None:
    """Train the shipped model further for each recorded board, with the scene's other boards.

    For each board, the folder `models` gets the file `<board>.safetensors` with its card. `reskin.load_universal`
    loads it.
    """
    compare, base = settings.section(Compare, "compare"), load_universal()
    if compare.layout != base.layout:
        what = f"experiment rig needs layout {base.layout.name}, but the scene has layout {compare.layout.name}"
        raise ParamsError(f"scene {settings.scene}: {what}. Remove this experiment from the scene.")
    captures = [io.read_readings(indentations / f"{name}.parquet") for name in settings.captures_in(indentations)]
    boards = recorded_boards(captures, compare, f"scene {settings.scene}")
    made = make_models(base, boards, section, settings.seed)
    with io.replacing(models) as folder:
        folder.mkdir()
        for board, model in made.items():
            others = ", ".join(other for other in boards if other != board)
            about = {
                "name": f"universal, boards of the rig without {board}", "source": "simulated and recorded",
                "network": f"the shipped one, trained further on simulated skins and on presses of {others}",
                "not_for": "boards of another rig, skins of another kind, two contacts at once, shear",
                "training": section.model_dump() | {"seed": settings.seed},
            }  # fmt: skip
            write(model, about, folder / f"{board}.safetensors")
    say(f"{settings.scene} rig: made models for {', '.join(made)}")

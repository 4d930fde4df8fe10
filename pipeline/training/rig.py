"""Universal models that know the other boards of a rig, one for each board that is held out."""

from pipeline.executors import make_executor
from pipeline.training.recorded import Compare
from reskin.errors import ParamsError
from reskin.schema import Readings
from reskin.universal.episodes import RecordedBoard, TrainingSettings
from reskin.universal.making import fine_tune, recorded_board, simulate
from reskin.universal.model import Universal


def recorded_boards(captures: list[Readings], compare: Compare, where: str) -> dict[str, RecordedBoard]:
    """Collect the recorded boards of a scene; raise ParamsError unless there are two or more, with one skin each."""
    skins: dict[str, dict[str, list[Readings]]] = {}
    for readings in captures:
        skins.setdefault(readings.board, {}).setdefault(readings.skin, []).append(readings)
    if len(skins) < 2 or any(len(own) > 1 for own in skins.values()):
        what, got = "boards with one skin each", ", ".join(f"{board}: {len(own)} skins" for board, own in skins.items())
        raise ParamsError(where, what, "two or more", got, "Remove experiment rig from the scene, or add recordings.")
    return {
        board: recorded_board(board, own, compare.layout, mirrored=compare.labels_mirrored)
        for board, by_skin in skins.items()
        for own in by_skin.values()
    }


def make_models(
    base: Universal, boards: dict[str, RecordedBoard], training: TrainingSettings, seed: int
) -> dict[str, Universal]:
    """Train the base model further with all boards but one, for each board; return the models by held-out board."""
    with make_executor(imports="reskin.universal.training") as executor:
        tasks = {
            held_out: executor.submit(
                make_model, base, [own for board, own in boards.items() if board != held_out], training, seed
            )
            for held_out in boards
        }
        return {held_out: task.result() for held_out, task in tasks.items()}


def make_model(base: Universal, boards: list[RecordedBoard], training: TrainingSettings, seed: int) -> Universal:
    """Train the base model further with these boards."""
    return fine_tune(base, simulate(base.layout, training.skins_n, seed, "rig"), boards, training.steps_n, seed)

"""Stage sleeve: places on one large skin over many boards, the last pokes held out (paper section 6, arm sleeve)."""

from pathlib import Path

import numpy as np

from pipeline.core.config import Files, Settings, read_settings
from pipeline.core.executors import make_executor
from pipeline.core.stage import run, say
from pipeline.dataset.rows import Selection, gather
from pipeline.evaluation.scores import tally
from pipeline.experiments.answer import read_folder, read_losses, write_answer
from pipeline.experiments.sleeve import areas as evaluation
from pipeline.experiments.sleeve.settings import Sleeve
from pipeline.learning.baselines import Task, run_tasks
from pipeline.learning.card import collapse_record
from pipeline.learning.classical import Neighbours
from pipeline.learning.recipe import HEADLINE, with_training
from pipeline.learning.trial import Measured, Trial
from pipeline.synthesis.settings import synthesis_of
from pipeline.trials.data import SceneData, train_all
from pipeline.trials.models import note_seconds


def read(settings: Settings) -> Sleeve:
    """Read section sleeve."""
    return with_training(settings, Sleeve, "sleeve")


def sleeve(scene: str, files: Files, indentations: Path, answer: Path) -> None:
    """Train the recipes of section sleeve on the first pokes, score them and nearest neighbours on the last."""
    settings = read_settings("sleeve", scene, files)
    section, captures, area = read(settings), read_folder(indentations), _area(settings)
    data = SceneData(scene, settings, gather(captures, settings.section(Selection, "selection")), [])
    train, test = evaluation.hold_out_last(data.rows, section.test_fraction)
    trials = [
        Trial("sleeve", name, recipe, "last", data.settings.seed, seed_i, train, test)
        for name, recipe in section.training.recipes.items()
        for seed_i in range(section.training.seeds_n)
    ]
    trained = train_all(data, trials, "sleeve")
    note_seconds(scene, "sleeve", trials, trained)
    answers = {name: [o.predicted for c, o in zip(trials, trained, strict=True) if c.recipe_name == name]
               for name in section.training.recipes}  # fmt: skip
    answers |= _neighbours(data, section, train, test)
    true, indentation = data.rows.target[test], data.rows.indentation[test]
    scored = {name: evaluation.score_places(true, own, indentation, area) for name, own in answers.items()}
    trained_n, tested_n = (len(np.unique(data.rows.indentation[part])) for part in (train, test))
    numbers = {
        "chips_n": captures[0].chips_n, "rate_hz": evaluation.rate_hz(captures), "area_mm": list(area.sides_mm),
        "pokes_n": trained_n + tested_n, "trained_n": trained_n, "tested_n": tested_n, "near_mm": evaluation.NEAR_MM,
        **scored.pop(HEADLINE), "variants": scored,
    }  # fmt: skip
    error_mm = evaluation.errors_mm(true, answers[HEADLINE][0])
    drawn = evaluation.to_draw(area, true, error_mm, indentation)
    losses = read_losses(indentations, data.rows.dropped)
    write_answer(answer, numbers, drawn, losses, tally(map(collapse_record, trained)))


def _area(settings: Settings) -> evaluation.Area:
    kind = synthesis_of(settings).boards[settings.words("simulate.protocols.sleeve.boards")]
    tiles = kind.design.tiles
    boards_n, pitch_mm = ((1, 1), 0.0) if tiles is None else ((tiles.columns_n, tiles.rows_n), tiles.pitch_mm)
    return evaluation.lay_out(kind.skin_mm, kind.design.places_mm, boards_n=boards_n, pitch_mm=pitch_mm)


def _neighbours(data: SceneData, section: Sleeve, train: np.ndarray, test: np.ndarray) -> dict[str, list[np.ndarray]]:
    none = np.zeros(0, np.int64)
    tasks = [
        Task(f"knn-{inputs}", Neighbours(method="knn", inputs=inputs, neighbours_n=section.neighbours_n),
             train, test, none, len(train), data.settings.seed)
        for inputs in ("raw", "shape")
    ]  # fmt: skip
    rows = Measured(data.rows.db_uT, data.rows.target, data.rows.skin)
    with make_executor() as executor:
        done = run_tasks(tasks, rows, executor, lambda line: say(f"{data.scene} sleeve: {line}"))
    return {task.name: [one.predicted] for task, one in zip(tasks, done, strict=True)}


if __name__ == "__main__":
    run(sleeve)

"""Stage sleeve: places on one large skin over many boards, the last pokes held out (paper section 6, arm sleeve)."""

from pathlib import Path

import numpy as np

from pipeline.dataset.rows import gather
from pipeline.evaluation import sleeve as evaluation
from pipeline.evaluation.tally import tally
from pipeline.learning.baselines import Task, run_tasks
from pipeline.learning.card import went
from pipeline.learning.cell import Cell, Measured
from pipeline.learning.classical import Neighbours
from pipeline.learning.executors import make_executor
from pipeline.learning.recipe import HEADLINE
from pipeline.questions import EXPERIMENTS
from pipeline.sections import Sleeve
from pipeline.settings import Files, Settings, read_settings
from pipeline.stages._experiment import read_folder, read_losses, write_answer
from pipeline.stages._models import note_seconds
from pipeline.stages._run import run, say
from pipeline.stages._simulated import synthesis_of
from pipeline.stages._train import Scenery, train_all


def sleeve(scene: str, files: Files, indentations: Path, answer: Path) -> None:
    """Train the recipes of section sleeve on the first pokes, score them and nearest neighbours on the last."""
    asked = read_settings("sleeve", scene, files)
    section, captures, area = asked.sleeve, read_folder(indentations), _area(asked)
    at = Scenery(scene, asked, gather(captures, asked.selection), [])
    train, test = evaluation.hold_out_last(at.rows, section.test_fraction)
    cells = [
        Cell("sleeve", name, recipe, "last", at.asked.seed, seed_i, train, test)
        for name, recipe in section.training.recipes.items()
        for seed_i in range(section.training.seeds_n)
    ]
    trained = train_all(at, cells, "sleeve")
    note_seconds(scene, "sleeve", cells, trained)
    answers = {name: [o.predicted for c, o in zip(cells, trained, strict=True) if c.recipe_name == name]
               for name in section.training.recipes}  # fmt: skip
    answers |= _neighbours(at, section, train, test)
    true, indentation = at.rows.target[test], at.rows.indentation[test]
    scored = {name: evaluation.score_places(true, own, indentation, area) for name, own in answers.items()}
    trained_n, tested_n = (len(np.unique(at.rows.indentation[part])) for part in (train, test))
    numbers = {
        "chips_n": captures[0].chips_n, "rate_hz": evaluation.rate_hz(captures), "area_mm": list(area.sides_mm),
        "pokes_n": trained_n + tested_n, "trained_n": trained_n, "tested_n": tested_n, "near_mm": evaluation.NEAR_MM,
        **scored.pop(HEADLINE), "variants": scored,
    }  # fmt: skip
    error_mm = evaluation.errors_mm(true, answers[HEADLINE][0])
    drawn = evaluation.to_draw(area, true, error_mm, indentation)
    losses = read_losses(indentations, at.rows.dropped)
    write_answer(answer, numbers, drawn, losses, tally(map(went, trained)))


def _area(asked: Settings) -> evaluation.Area:
    protocol = EXPERIMENTS["sleeve"]
    kind = synthesis_of(asked).boards[asked.words(f"simulate.protocols.{protocol}.boards")]
    tiles = kind.design.tiles
    boards_n, pitch_mm = ((1, 1), 0.0) if tiles is None else ((tiles.columns_n, tiles.rows_n), tiles.pitch_mm)
    return evaluation.lay_out(kind.skin_mm, kind.design.places_mm, boards_n=boards_n, pitch_mm=pitch_mm)


def _neighbours(at: Scenery, section: Sleeve, train: np.ndarray, test: np.ndarray) -> dict[str, list[np.ndarray]]:
    none = np.zeros(0, np.int64)
    tasks = [
        Task(f"knn-{inputs}", Neighbours(method="knn", inputs=inputs, neighbours_n=section.neighbours_n),
             train, test, none, len(train), at.asked.seed)
        for inputs in ("raw", "shape")
    ]  # fmt: skip
    rows = Measured(at.rows.db_uT, at.rows.target, at.rows.skin)
    with make_executor() as executor:
        done = run_tasks(tasks, rows, executor, lambda line: say(f"{at.scene} sleeve: {line}"))
    return {task.name: [one.predicted] for task, one in zip(tasks, done, strict=True)}


if __name__ == "__main__":
    run(sleeve)

"""What the training stages share: folds and recipes -> cells -> models, cards and predictions. Knows no argv."""

from pathlib import Path

import pyarrow as pa

from pipeline import io
from pipeline.dataset.folds import load_rows, parse_folds
from pipeline.dataset.rows import TARGETS, Rows
from pipeline.evaluation.summary import score_groups
from pipeline.learning.card import describe
from pipeline.learning.executors import make_executor
from pipeline.learning.grid import Cell, Trained, run_cells
from pipeline.params import ANSWERED_BY, read_scene
from pipeline.provenance import code_version
from pipeline.stages._run import say

CELLS = Path(".reskin/cells")  # finished trainings: a cache, and no output


def train_arm(arm: str, scene: str, settings: Path, indentations: Path, folds: Path, models: Path) -> None:
    """Train every recipe of one section of the scene on every fold of the questions it answers."""
    asked = read_scene(settings)
    training = getattr(asked, arm)
    words = io.read_json(folds)
    rows = load_rows([indentations / f"{name}.parquet" for name in words["captures"]], asked.selection)
    cells = [
        Cell(fold.question, name, recipe, fold.name, asked.seed, seed_i, fold.train, fold.test)
        for fold in parse_folds(words, rows, str(folds))
        if ANSWERED_BY[fold.question] == arm
        for name, recipe in training.recipes.items()
        for seed_i in range(training.seeds_n)
    ]
    with make_executor() as executor:
        trained = run_cells(
            cells,
            rows.db_uT,
            rows.target,
            executor=executor,
            cache=CELLS,
            tell=lambda line: say(f"{scene} {arm}: {line}"),
        )
    with io.replacing(models) as folder:
        folder.mkdir()
        for cell, one in zip(cells, trained, strict=True):
            _write_model(folder, cell, one, rows, scene)
        io.write_table(folder / "predictions.parquet", _predictions(cells, trained, rows))


def _write_model(folder: Path, cell: Cell, one: Trained, rows: Rows, scene: str) -> None:
    card = describe(cell, one, rows, scene, code_version())
    test = cell.test
    card["scores"] = score_groups(rows.target[test], one.predicted, rows.board[test], rows.skin[test])
    io.write_tensors(folder / f"{cell.name}.safetensors", one.weights | one.scaler.arrays(), {"format": card["format"]})
    io.write_json(folder / f"{cell.name}.json", card)


def _predictions(cells: list[Cell], trained: list[Trained], rows: Rows) -> pa.Table:
    """One row a test row and training: the truth and the prediction, side by side."""
    tables = []
    for cell, one in zip(cells, trained, strict=True):
        columns = {
            "question": pa.repeat(cell.question, len(cell.test)), "recipe": pa.repeat(cell.recipe_name, len(cell.test)),
            "fold": pa.repeat(cell.fold, len(cell.test)), "seed_i": pa.repeat(cell.seed_i, len(cell.test)),
            "skin": pa.array(rows.skin[cell.test].tolist()),
        }  # fmt: skip
        for i, name in enumerate(TARGETS):
            columns[f"true_{name}"] = pa.array(rows.target[cell.test, i])
            columns[f"predicted_{name}"] = pa.array(one.predicted[:, i])
        tables.append(pa.table(columns))
    return pa.concat_tables(tables)

"""Stage split: indentations -> folds.json, who is held out of what."""

from pathlib import Path

from pipeline import io
from pipeline.asking import folds_of
from pipeline.dataset.folds import load_rows, render_folds
from pipeline.dataset.splits import draw_folds
from pipeline.settings import Files, read_settings
from pipeline.stages._run import run, say


def split(scene: str, files: Files, indentations: Path, folds: Path) -> None:
    """Draw the folds of every question that the scene asks."""
    asked = read_settings("split", scene, files)
    asked.check_questions()
    captures = asked.captures_in(indentations)
    rows = load_rows([indentations / f"{name}.parquet" for name in captures], asked.selection)
    drawn = draw_folds(rows, folds_of(asked.questions), asked.split, asked.seed)
    io.write_json(folds, render_folds(captures, rows, drawn))
    say(f"{scene}: {len(rows)} rows of {len(captures)} captures, {len(drawn)} folds; left out: {rows.dropped}")


if __name__ == "__main__":
    run(split)

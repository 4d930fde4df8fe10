"""Stage split: indentations -> folds.json, who is held out of what."""

from pathlib import Path

from pipeline import io
from pipeline.dataset.folds import load_rows, render_folds
from pipeline.dataset.splits import draw_folds
from pipeline.params import captures_of, check_planned, read_params, read_scene
from pipeline.stages._run import run, say


def split(scene: str, params: Path, settings: Path, indentations: Path, folds: Path) -> None:
    """Draw the folds of every question that the scene asks."""
    asked = read_scene(settings)
    shared = read_params(params)
    check_planned(scene, asked, shared, str(settings))
    captures = captures_of(scene, shared, indentations)
    rows = load_rows([indentations / f"{name}.parquet" for name in captures], asked.selection)
    drawn = draw_folds(rows, asked.trained, asked.split, asked.seed)
    io.write_json(folds, render_folds(captures, rows, drawn))
    say(f"{scene}: {len(rows)} rows of {len(captures)} captures, {len(drawn)} folds; left out: {rows.dropped}")


if __name__ == "__main__":
    run(split)

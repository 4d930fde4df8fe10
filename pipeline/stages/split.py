"""Stage split: indentations -> folds.json, who is held out of what. Refuses to know fields and models."""

from pathlib import Path

from pipeline.stage import run, say
from reskin import io
from reskin.config import Files, Settings, parse_parts, read_settings
from reskin.data.folds import load_rows, render_folds
from reskin.data.rows import Rows, Selection
from reskin.data.splits import Split, draw_folds

NO_ROWS = Rows.of_labels(boards=[], skins=[])


def read(settings: Settings) -> Split:
    """Read section split."""
    return parse_parts(Split, settings.words("split"), f"{settings.where}: split")


def split(scene: str, files: Files, indentations: Path, folds: Path) -> None:
    """Draw the folds of every question that the scene asks."""
    settings = read_settings("split", scene, files)
    captures = settings.captures_in(indentations)
    if not settings.plan("folds"):  # of a scene without questions that hold anybody out, and perhaps without places
        io.write_json(folds, render_folds(captures, NO_ROWS, []))
        return say(f"{scene}: no question of {len(captures)} captures asks for folds")
    rows = load_rows([indentations / f"{name}.parquet" for name in captures], settings.section(Selection, "selection"))
    drawn = draw_folds(rows, settings.plan("folds"), read(settings), settings.seed)
    io.write_json(folds, render_folds(captures, rows, drawn))
    say(f"{scene}: {len(rows)} rows of {len(captures)} captures, {len(drawn)} folds; left out: {rows.dropped}")


if __name__ == "__main__":
    run(split)

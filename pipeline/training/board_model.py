"""Command `reskin model make`. `python -m pipeline.training.board_model` makes the model of the project."""

from collections.abc import Callable
from pathlib import Path

from reskin.config import read_yaml
from reskin.errors import ParamsError, require
from reskin.universal.layout import BoardLayout, as_layout, paper_layout, read_layout
from reskin.universal.making import HELD_OUT_LABELS_N, make_model, read_recordings, with_boards
from reskin.universal.model import FILE, load_universal, write

INDENTATIONS = Path("data/indentations")  # in a checkout, the readings of each scene are in a folder of its name


def make(
    layout_file: Path, out: Path, recordings: Path | None = None, start: Path | None = None, *, mirrored: bool = False,
    say: Callable[[str], None] = print,
) -> None:  # fmt: skip
    """Make the model for the layout in a file, and write it and its card (same name with suffix .json).

    Raises
    ------
    ParamsError : the layout is wrong, `out` is not a new .safetensors file, there are no recordings, or a package is
        not installed
    """
    layout, of_scene = read_layout_of(layout_file)
    mirrored = mirrored or of_scene
    if out.suffix != ".safetensors":
        raise ParamsError(f"--out: {out} must end in .safetensors. Try: {out.with_suffix('.safetensors')}")
    for file in (out, out.with_suffix(".json")):
        if file.exists():
            raise ParamsError(f"--out: {file} exists. Choose another name, or delete this file.")
    if layout.name == paper_layout().name and layout != paper_layout():
        raise ParamsError(
            f"{layout_file}: name {layout.name} is reserved for the paper's board. Change the name there."
        )
    if start is not None and recordings is None:
        raise ParamsError("--start: a model is trained further only with recordings. Add --recordings.")
    for package in ("torch", "sklearn"):
        require(package, "model make")
    boards = [] if recordings is None else read_recordings(folder_of(recordings), layout, mirrored=mirrored)
    if start is not None or (boards and layout == paper_layout()):
        base = load_universal(file=start or FILE)
        if base.layout != layout:
            raise ParamsError(f"--start: {start} is for board {base.layout.name}. Use a model for {layout.name}.")
    else:
        base = make_model(layout, say=say)
    if boards:
        base, held_out = with_boards(base, boards, say=say)
        labels = f"without labels / with {HELD_OUT_LABELS_N}"
        for each in held_out:
            before, after = (
                "{:.0f} / {:.0f} %".format(*pair) for pair in (each.without_boards_pct, each.with_boards_pct)
            )
            say(f"board {each.board} held out, within 1 mm {labels}: {before} before, {after} with the other boards")
        if not held_out:
            say("only one board was recorded, so none could be held out: its accuracy on a new board is unknown")
    write(base, base.card, out)


def folder_of(recordings: Path) -> Path:
    """Return the folder of recorded readings: the given folder or, in a checkout, that of the scene with this name."""
    if recordings.is_dir():
        return recordings
    if (folder := INDENTATIONS / recordings).is_dir():
        return folder
    raise ParamsError(
        f"--recordings: {recordings} is neither a folder nor a scene with readings in {INDENTATIONS}. Pass a folder of "
        "Parquet files of readings, or run dvc repro for the scene first."
    )


def read_layout_of(file: Path) -> tuple[BoardLayout, bool]:
    """Read a layout from a file or name that `read_layout` accepts, or from section `compare` of a scene's file.

    Also returns whether a scene states that y of its labels is opposite to y of the board.
    """
    content = read_yaml(file) if file.suffix in (".yaml", ".yml") else {}
    if not (isinstance(content, dict) and "source" in content):
        return read_layout(file), False
    section = content.get("compare", {})
    if (given := section.get("layout")) is None:
        raise ParamsError(
            f"{file}: this scene has no layout (compare.layout). Add it to the scene, or pass the file of a layout."
        )
    layout = read_layout(given) if isinstance(given, str) else as_layout(given, f"{file}: compare.layout")
    return layout, section.get("labels_mirrored") is True


if __name__ == "__main__":
    shipped = make_model(paper_layout())
    write(shipped, shipped.card, FILE)

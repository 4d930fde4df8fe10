"""Command `reskin new`: write the file of a new scene for two or more boards, each of which is held out in turn."""

import re
from collections.abc import Sequence
from pathlib import Path

from pipeline import SCENES
from pipeline.scenes import Source, read_scene, scene_names
from reskin import io
from reskin.errors import ParamsError
from reskin.layouts import FOLDER
from reskin.recordings.header import NAME, NAME_RULE
from reskin.universal.layout import BoardLayout, paper_layout, read_layout
from reskin.universal.model import FILE

PRESSES_MAX_N = 65  # largest number of unlabelled presses of a held-out skin, as in scene lab
LABELS_N = (0, 1, 10, 20, 40)
SHIPPED = str(FILE.relative_to(Path(__file__).parents[2]))
TEMPLATE = """\
# Scene {scene}: leave-one-board-out on boards {boards}. Written by `reskin new`; docs/settings.md explains the keys.
source: {source}
boards: [{boards}] # `reskin add` accepts only these names
seed: 2021
# Experiments may be removed from this list; their settings may stay in this file.
experiments: [{experiments}]
selection:
  force_min_N: 0.0 # readings with a smaller measured force are treated as no contact
split:
  transfer_skins_n: {transfer_n} # experiment transfer trains networks on one skin each; number of their boards
{pool_passes}\
train_single: {{recipe: paper, steps_n: 3000, seeds_n: 1, variants: {{}}}}
train_multi: {{recipe: paper, steps_n: 3000, seeds_n: 3, variants: {{}}}}
train_triplet: {{recipe: triplet, steps_n: 3000, seeds_n: 3, variants: {{}}}}
adapt:
  adaptation: paper
  base: paper # recipe of section train_triplet whose networks are adapted
  steps_n: 300
  pokes_n: {pokes_n} # unlabelled indentations: those of the first pass
  variants:
    control: {{unlabelled_weight: 0.0}} # equally many steps, but without the new skin's indentations
new_board:
  presses_n: [{presses_n}] # unlabelled presses of a new board
  labels_n: {labels_n} # presses with a known place and force; 1 is a press in the middle of the skin
  draws_n: 4 # random draws of these presses; more draws take longer and make the scores more precise
{about_model}\
  model: {model}
audit: # optional: similar_skins, weak_skins
  settings: chosen
compare:
  labels_mirrored: false # true if the y axis of the labels is opposite to the y axis of the board
  # The layout of your boards: all experiments that simulate skins or use the in-context model refer to it.
  layout:{layout}
"""
POOL_PASSES = "  pool_passes_n: 1 # the first pass of each held-out skin is for adaptation; it is not tested\n"
ABOUT_MODEL = """\
  # To test an in-context model for the layout below, make it, and name its file here:
  #   reskin model make --layout {file} --out {scene}.safetensors
"""
ONE_BOARD = (
    "two or more boards are needed, because one board cannot be held out and also be trained on. To train on the "
    "first passes over one board and test on its last passes, copy pipeline/scenes/ini.yaml instead. Or use the "
    "universal model, which needs no training: see docs/live.md, Calibrate the model"
)


def new(
    root: Path, scene: str, boards: Sequence[str], presses_n: int, passes_n: int, layout: str | None, source: Source
) -> tuple[Path, list[str]]:
    """Write `pipeline/scenes/<scene>.yaml`; return its path, and sentences on what to do next.

    Parameters
    ----------
    root, scene
        Folder of the checkout; name of the scene.
    boards
        Names of two or more boards.
    presses_n, passes_n
        Number of indentations of each skin in one pass over all places, and number of passes. With two passes or more,
        the scene also adapts networks.
    layout
        Name of a layout of the project, or path of a YAML file whose text is copied into the scene's file. If None, the
        text of the paper's layout is copied, and the user must edit it.
    source
        "simulated" for recordings of emulated boards.

    Raises
    ------
    ParamsError
        A name is invalid or taken, there are fewer than two boards, or the layout is invalid.
    """
    for option, name in (("SCENE", scene), *(("--boards", board) for board in boards)):
        if not re.fullmatch(NAME, name):
            raise ParamsError(option, "a name", NAME_RULE, repr(name), "Choose another name.")
    if len(set(boards)) < len(boards):
        raise ParamsError(f"--boards: {', '.join(boards)}: a name occurs twice. Name each board once.")
    if len(boards) < 2:
        raise ParamsError(f"--boards: {ONE_BOARD}.")
    if scene in scene_names(root):
        raise ParamsError(f"{root / SCENES / scene}.yaml exists already. Choose another name, or edit this file.")
    file = root / SCENES / f"{scene}.yaml"
    io.write_text(file, scene_text(scene, boards, presses_n, passes_n, layout, source))
    try:
        experiments = read_scene(root, scene).experiments
    except BaseException:
        io.remove(file)
        raise
    return file, _next_steps(file.relative_to(root), scene, layout, experiments, source)


def scene_text(
    scene: str, boards: Sequence[str], presses_n: int, passes_n: int, layout: str | None, source: Source = "recorded"
) -> str:
    """Return the text of the scene's file; see `new`."""
    given = paper_layout() if layout is None else read_layout(layout)
    fits, adapted = layout is not None and is_shipped(given), passes_n > 1
    experiments = ["transfer", "lobo", "triplet", *["adapt"] * adapted, "audit"]
    # Experiment compare compares recorded fields with simulated fields.
    experiments += ["compare"] * (source == "recorded")
    unlabelled_n = min(PRESSES_MAX_N, presses_n * passes_n // 3)
    return TEMPLATE.format(
        scene=scene, source=source, boards=", ".join(boards),
        experiments=", ".join([*experiments, "new_board"]),
        transfer_n=max(1, len(boards) // 2), pool_passes=POOL_PASSES if adapted else "", pokes_n=presses_n,
        presses_n=unlabelled_n, labels_n=[n for n in LABELS_N if n <= unlabelled_n],
        model=SHIPPED if fits else "null",
        about_model="" if fits else ABOUT_MODEL.format(file=f"{SCENES}/{scene}.yaml", scene=scene),
        layout=_layout_text(layout, scene),
    )  # fmt: skip


def is_shipped(layout: BoardLayout) -> bool:
    """Return whether the shipped universal model was made for this layout."""
    return layout.model_copy(update={"name": paper_layout().name}) == paper_layout()


def _layout_text(layout: str | None, scene: str) -> str:
    """Return the value of key `layout`: a name, or the indented text of a file."""
    file = FOLDER / "reskin.yaml" if layout is None else Path(layout)
    if not file.suffix:
        return f" {layout}"
    lines = file.read_text(encoding="utf-8").splitlines()
    if layout is None:
        first_i = next(i for i, line in enumerate(lines) if not line.startswith("#"))
        name = f"name: {scene} # saved calibrations of the universal model refer to this name"
        lines = [name, *lines[first_i + 1 :]]
    return "".join(f"\n    {line}" if line.strip() else "\n" for line in lines)


def _next_steps(file: Path, scene: str, layout: str | None, experiments: Sequence[str], source: Source) -> list[str]:
    steps = [f"wrote {file}"]
    if "adapt" not in experiments:
        steps.append("experiment adapt is left out, because it needs two or more passes over each skin (--passes 2)")
    add = f"reskin add BOARD_SKIN.csv ... --layout table --scene {scene}"
    if source == "simulated":
        add = f"reskin add captures/BOARD_SKIN ... --layout capture --scene {scene}"
    if layout is None:
        steps.append(
            "next: describe your boards in this file, in section compare, under key layout. At present, this key "
            "describes the paper's board"
        )
    return [*steps, f"then: {add}" if layout is None else f"next: {add}"]

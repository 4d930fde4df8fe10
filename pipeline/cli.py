"""The commands of `reskin` that need a checkout of this project: they manage recordings, scenes and results.

`reskin.cli` adds these commands to `reskin` if the working directory is a checkout. Most imports are inside the
commands, so that `reskin --help` starts quickly.
"""

import sys
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer
from typer import Argument, Option

from pipeline import PLAN
from reskin.cli import BOARD, MAINTENANCE, PIPELINE, RECORDINGS, WIRE
from reskin.errors import ParamsError
from reskin.recordings import ReaderLayout

if TYPE_CHECKING:
    from pipeline.plan import Plan
    from pipeline.scenes import Source

ROOT = Path()  # the checkout, which is the working directory

app = typer.Typer()
scenes = typer.Typer(no_args_is_help=True, help="Choose which scenes `dvc repro` runs.")
app.add_typer(scenes, name="scenes", rich_help_panel=PIPELINE)
models = typer.Typer(no_args_is_help=True, help="Make a universal model for your own board.")
app.add_typer(models, name="model", rich_help_panel=BOARD)

Layout = Literal["capture", "serial-binary", "serial-text", ReaderLayout]
LAYOUT = (
    "Format of the recordings: table for your own CSV files, or capture for a folder that `reskin record` wrote. "
    "data/README.md describes all formats."
)
Board = Annotated[str, Option(help="Name of the circuit board.")]
Marks = Annotated[
    list[str] | None,
    Option(
        help="Layouts capture, serial-*: two times of the same event in seconds, as STREAM_S,PROBE_S. The first is on "
        "the clock of the readings, and the second is on the clock of the robot's log. The option may be repeated."
    ),
]


def checked_plan() -> "Plan":
    """Read pipeline/plan.yaml; raise `ParamsError` if the plan is out of date."""
    from pipeline import plan

    return plan.check(ROOT)


@app.command(rich_help_panel=RECORDINGS)
def new(
    scene: Annotated[str, Argument(help="Name of the new scene.")],
    boards: Annotated[str, Option(help="Names of your boards, separated by commas: b1,b2,b3.")],
    presses_n: Annotated[
        int,
        Option("--presses", help="Number of indentations of each skin in one pass over all places.", min=4),
    ],
    passes_n: Annotated[
        int, Option("--passes", help="Number of passes: how often each skin is pressed at all places.", min=1)
    ] = 1,
    layout: Annotated[
        str | None,
        Option(
            help="Layout of your boards, which states where the chips are: reskin (the paper's board), anyskin, "
            "eflesh, or a YAML file, which is copied into the scene's file. Default: the layout of the paper's board "
            "is written into the scene's file, where you can change it to the layout of your boards."
        ),
    ] = None,
    simulated: Annotated[
        bool,
        Option(
            "--simulated",
            help="State that the recordings will come from emulated boards (`reskin record --simulated`).",
        ),
    ] = False,
) -> None:
    """Write a scene for two or more boards of your own.

    Each board is held out in turn: networks are trained on the other boards and tested on this one.
    """
    from pipeline.manage import new as creating
    from pipeline.manage.lock import changing

    names = [name.strip() for name in boards.split(",") if name.strip()]
    source: Source = "simulated" if simulated else "recorded"
    with changing(ROOT):
        steps = creating.new(ROOT, scene, names, presses_n, passes_n, layout, source)[1]
    typer.echo("\n".join(steps))


@app.command(rich_help_panel=RECORDINGS)
def add(
    recordings: Annotated[
        list[Path],
        Argument(metavar="RECORDING...", help="Files or folders of recordings; --layout determines which."),
    ],
    layout: Annotated[Layout, Option(help=LAYOUT)],
    scene: Annotated[str, Option(help="Scene to add the recordings to.")],
    board: Annotated[
        str | None,
        Option(help="Name of the circuit board. Default: the first part of the name of each file, BOARD_SKIN.csv."),
    ] = None,
    skin: Annotated[
        str | None,
        Option(
            help="Name of the skin. A skin that was moved to another board needs a new name. Default: BOARD_SKIN, from "
            "the name of each file."
        ),
    ] = None,
    name: Annotated[
        str | None,
        Option(help="Name of the recording in the scene. Default: the name is made from the board and the skin."),
    ] = None,
    probe: Annotated[
        Path | None, Option(help="Layouts capture, serial-*: CSV log of the robot, with the places that it presses.")
    ] = None,
    chips_n: Annotated[
        int | None, Option("--chips", help="Layouts serial-*: number of chips in a frame. Default: 5.", min=1, max=64)
    ] = None,
    rate_hz: Annotated[
        float | None, Option("--rate-hz", help="Layouts serial-*: frames per second. Default: 400.")
    ] = None,
    wire: Annotated[
        str | None,
        Option(help=f"Layouts serial-*. {WIRE} Default: binary for serial-binary, text-xyzt for serial-text."),
    ] = None,
    mark: Marks = None,
    rows_late: Annotated[
        int | None,
        Option(
            help="Layout ini: number of rows by which the fields lag behind the labels. Default: the number is found "
            "from the readings.",
            min=0,
            max=5,
        ),
    ] = None,
    force_axis: Annotated[
        Literal["x", "y", "z"] | None, Option(help="Layout eflesh: direction of the force gauge. Default: z.")
    ] = None,
    pad: Annotated[
        int | None,
        Option(
            help="Layout leaphand: number of the pad whose readings are added, counted from 1. Add each pad with a "
            "command of its own.",
            min=1,
        ),
    ] = None,
    columns: Annotated[
        Path | None,
        Option(help="Layout table: YAML file that maps the columns and units of the file (docs/add-your-data.md)."),
    ] = None,
    allow_copy: Annotated[
        bool,
        Option(
            "--allow-copy",
            help="Also accept readings that are already in the scene with the name of another board or skin.",
        ),
    ] = False,
) -> None:
    """Add recordings to a scene. `dvc repro` uses them if the scene is in the plan (`reskin scenes use`).

    If one of the recordings cannot be added, none of them is added.
    """
    from pipeline.manage import add as adding
    from pipeline.manage.lock import changing
    from pipeline.manage.options import Options
    from pipeline.plan import next_command
    from reskin.recordings.preparing import CaptureNames, suggesting_layout

    options = Options(probe, mark, chips_n, rate_hz, wire, rows_late, force_axis, pad, columns)
    options.check(layout)
    for option, value in (("--name", name), ("--skin", skin), ("--probe", probe), ("--mark", mark)):
        if value is not None and len(recordings) > 1:
            n = len(recordings)
            raise ParamsError(f"{option} is for one recording, but there are {n}. Add each with a command of its own.")
    added: list[str] = []
    with changing(ROOT), adding.undoing(ROOT, scene, added):
        for recording in recordings:
            names = adding.names_of(ROOT, scene, recording, CaptureNames(board or "", skin or "", name))
            with suggesting_layout(recording, layout):
                header = adding.add(ROOT, scene, options.prepare(recording, layout, names), allow_copy=allow_copy)
            added.append(header.capture)
            typer.echo(f"added {scene}/{header.capture} (board {header.board}, skin {header.skin})")
    typer.echo(f"next: {next_command(ROOT, scene)}")


@app.command(rich_help_panel=RECORDINGS)
def fetch(
    source: Annotated[
        str | None,
        Argument(
            help="Name of a set of recordings: lab, ini, eflesh or leaphand. Default: nothing is fetched, and "
            "all sets are described."
        ),
    ] = None,
    origin: Annotated[
        str | None,
        Option("--from", help="Folder, or address of a mirror, from which the files are taken."),
    ] = None,
    scene: Annotated[
        str | None,
        Option(help="Scene to which the recordings are added. Default: the scene that belongs to the recordings."),
    ] = None,
    yes: Annotated[bool, Option("--yes", help="Do not ask before using data that has no licence.")] = False,
) -> None:
    """Fetch public recordings, check that the files are complete and unchanged, and add them to a scene."""
    from pipeline.manage import fetch as fetching
    from pipeline.manage.lock import changing

    def agree(question: str) -> bool:
        return yes or (sys.stdin.isatty() and typer.confirm(question))

    with changing(ROOT):
        fetching.fetch(ROOT, source, origin, scene, agree=agree, say=typer.echo)


@app.command(rich_help_panel=RECORDINGS)
def remove(
    scene: Annotated[str, Argument(help="Name of the scene that contains the recording.")],
    capture: Annotated[str, Argument(help="Name of the recording in the scene, as in data/captures.yaml.")],
) -> None:
    """Remove a recording from a scene, and delete its files from the checkout."""
    from pipeline.manage import add as adding
    from pipeline.manage.lock import changing

    with changing(ROOT):
        adding.remove(ROOT, scene, capture)
    typer.echo(f"removed {scene}/{capture}; next: dvc repro")


@app.command(rich_help_panel=MAINTENANCE)
def publish() -> None:
    """Write to MLflow the training runs, scores and final models that it lacks, and print links to them.

    They are missing, for example, if DVC took the results from its cache, or if MLflow could not be reached.
    """
    from pipeline import tracking

    for name in checked_plan().scenes:
        typer.echo(tracking.publish(name))


@app.command(rich_help_panel=PIPELINE)
def verify(
    names: Annotated[
        list[str] | None,
        Argument(metavar="[SCENE]...", help="Names of scenes. Default: all scenes that `dvc repro` runs."),
    ] = None,
) -> None:
    """Run scenes again in a fresh clone of the last commit, and compare their numbers with the committed ones.

    The exit status is 1 if any value differs.
    """
    from pipeline.manage import verify as verifying

    sys.exit(verifying.verify(ROOT, names or list(checked_plan().scenes), typer.echo))


@app.command(rich_help_panel=MAINTENANCE)
def readme(
    check: Annotated[
        bool, Option("--check", help="Write nothing; exit with status 1 if a page is out of date.")
    ] = False,
) -> None:
    """Write the generated parts of README.md and docs, and the figure of README.md, from the results in reports/."""
    from pipeline.manage.lock import changing
    from pipeline.report.readme import fill_pages

    with nullcontext() if check else changing(ROOT):
        changed = fill_pages(ROOT, write=not check)
    if check and changed:
        typer.echo(f"out of date: {', '.join(changed)}; to write them again: reskin readme", err=True)
        sys.exit(1)
    typer.echo(f"rewritten: {', '.join(changed) or 'nothing'}")


@scenes.command("list")
def list_scenes() -> None:
    """List all scenes. A star marks the scenes that `dvc repro` runs."""
    from pipeline.scenes import scene_names

    planned = checked_plan().scenes
    for name in scene_names(ROOT):
        typer.echo(f"{'*' if name in planned else ' '} {name}")


@scenes.command()
def use(
    names: Annotated[
        list[str], Argument(help="Names of the scenes that `dvc repro` runs from now on. It runs no other scenes.")
    ],
) -> None:
    """Choose the scenes that `dvc repro` runs."""
    from pipeline import plan
    from pipeline.manage.lock import changing

    with changing(ROOT):
        plan.use(ROOT, names)
    typer.echo(f"dvc repro now runs: {', '.join(names)}")


@scenes.command()
def check() -> None:
    """Check the settings of the scenes that `dvc repro` runs, their plan, and whether all recordings are registered."""
    from pipeline.manage.registry import REGISTRY, unregistered

    names = list(checked_plan().scenes)
    if lost := unregistered(ROOT):
        remedy = "No stage reads them. Delete their files, and add their recordings again."
        typer.echo(f"warning: {REGISTRY} does not list {', '.join(lost)} in data/raw. {remedy}", err=True)
    typer.echo(f"{PLAN} is up to date; scenes: {', '.join(names) or 'none'}")


@models.command("make")
def make_model(
    layout: Annotated[
        Path,
        Option(
            help="Layout of your board: a YAML file like reskin/layouts/reskin.yaml, or the YAML file of a "
            "scene that contains a layout, or one of the names reskin, anyskin, eflesh."
        ),
    ],
    out: Annotated[
        Path,
        Option(
            help="File to which the model is written (.safetensors). A description of the model is written to a .json "
            "file with the same name."
        ),
    ],
    recordings: Annotated[
        Path | None,
        Option(
            help="Recorded boards of this layout with known places and forces: a scene, or a folder of Parquet files "
            "of readings. The model is also trained with them, and each is held out once to say how good such a model "
            "is on a new board."
        ),
    ] = None,
    mirrored: Annotated[
        bool,
        Option(
            help="The y axis of the labels in the recordings is opposite to the y axis of the board. If --layout is "
            "the file of a scene, the scene states this."
        ),
    ] = False,
    start: Annotated[
        Path | None,
        Option(help="Model that is trained further with the recordings. Default: the shipped one, for layout reskin."),
    ] = None,
) -> None:
    """Train a universal model for your board, on simulated skins and, if there are any, on recorded boards.

    Without recordings, this takes about ten minutes of one core. It needs PyTorch and scikit-learn.
    """
    from pipeline.training.board_model import make

    make(layout, out, recordings, start, mirrored=mirrored, say=typer.echo)
    typer.echo(f"wrote {out}. Next: reskin live --model {out}")

"""The commands of `reskin` that need a checkout of this project: they manage recordings, scenes and results.

`reskin.cli` adds these commands to `reskin` if the working directory is a checkout. Most imports are inside the
commands, so that `reskin --help` starts quickly.
"""

import sys
from collections.abc import Mapping, Set
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer
from typer import Argument, Option

from pipeline import PLAN
from reskin.cli import BOARD, MAINTENANCE, PIPELINE, RECORDINGS, Wire
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

    names = [name.strip() for name in boards.split(",") if name.strip()]
    source: Source = "simulated" if simulated else "recorded"
    for step in creating.new(ROOT, scene, names, presses_n, passes_n, layout, source)[1]:
        typer.echo(step)


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
        Wire | None,
        Option(
            help="Layouts serial-*: format in which the board sent the readings. Default: binary for serial-binary, "
            "text-xyzt for serial-text."
        ),
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
    from pipeline.plan import next_command
    from reskin.recordings import preparing

    serial, native = {"serial-binary", "serial-text"}, {"capture", "serial-binary", "serial-text"}
    _check_options(
        layout,
        {
            "--probe": (probe, native), "--mark": (mark, native), "--chips": (chips_n, serial),
            "--rate-hz": (rate_hz, serial), "--wire": (wire, serial), "--rows-late": (rows_late, {"ini"}),
            "--force-axis": (force_axis, {"eflesh"}), "--pad": (pad, {"leaphand"}),
        },
    )  # fmt: skip
    _check_number(recordings, {"--name": name, "--skin": skin, "--probe": probe, "--mark": mark or None})
    marks = preparing.parse_marks(mark or [])
    added: list[str] = []
    with adding.undoing(ROOT, scene, added):
        for recording in recordings:
            names = adding.names_of(ROOT, scene, recording, preparing.CaptureNames(board or "", skin or "", name))
            with preparing.suggesting_layout(recording, layout):
                if layout == "capture":
                    prepared = preparing.native(recording, names, probe, marks)
                elif layout == "serial-binary" or layout == "serial-text":
                    default_wire: Wire = "binary" if layout == "serial-binary" else "text-xyzt"
                    dump_options = preparing.Dump(
                        wire or default_wire, chips_n or 5, 400.0 if rate_hz is None else rate_hz, probe, marks
                    )
                    prepared = preparing.dump(recording, names, dump_options)
                else:
                    options = {"force_axis": str(force_axis or "z")} if layout == "eflesh" else {}
                    options |= {"rows_late": str(rows_late)} if layout == "ini" and rows_late is not None else {}
                    options |= {"pad": str(pad)} if layout == "leaphand" and pad is not None else {}
                    prepared = preparing.foreign(recording, layout, names, options)
                header = adding.add(ROOT, scene, prepared, allow_copy=allow_copy)
            added.append(header.capture)
            typer.echo(f"added {scene}/{header.capture} (board {header.board}, skin {header.skin})")
    typer.echo(f"next: {next_command(ROOT, scene)}")


def _check_number(recordings: list[Path], options: Mapping[str, object]) -> None:
    """Raise `ParamsError` if an option that names or describes one recording is given with several recordings."""
    given = [option for option, value in options.items() if value is not None]
    if len(recordings) > 1 and given:
        raise ParamsError(
            f"{given[0]} is for one recording, but there are {len(recordings)}. Add each recording with a command of "
            "its own."
        )


def _check_options(layout: str, options: Mapping[str, tuple[object, Set[str]]]) -> None:
    """Raise `ParamsError` if an option is given that the layout does not use.

    options: for each option, its value and the layouts that use it.
    """
    for option, (value, layouts) in options.items():
        if value not in (None, []) and layout not in layouts:
            used = " and ".join(sorted(layouts))
            raise ParamsError(f"{option} is only for --layout {used}, not {layout}. Omit {option}.")


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
        Option("--from", help="Git mirror or folder from which the files are taken, instead of their public address."),
    ] = None,
    scene: Annotated[
        str | None,
        Option(help="Scene to which the recordings are added. Default: the scene that belongs to the recordings."),
    ] = None,
    yes: Annotated[bool, Option("--yes", help="Do not ask before using data that has no licence.")] = False,
) -> None:
    """Fetch public recordings, check that the files are complete and unchanged, and add them to a scene."""
    from pipeline.manage import fetch as fetching

    def agree(question: str) -> bool:
        return yes or (sys.stdin.isatty() and typer.confirm(question))

    fetching.fetch(ROOT, source, origin, scene, agree=agree, say=typer.echo)


@app.command(rich_help_panel=RECORDINGS)
def remove(
    scene: Annotated[str, Argument(help="Name of the scene that contains the recording.")],
    capture: Annotated[str, Argument(help="Name of the recording in the scene, as in data/captures.yaml.")],
) -> None:
    """Remove a recording from a scene, and delete its files from the checkout."""
    from pipeline.manage import add as adding

    adding.remove(ROOT, scene, capture)
    typer.echo(f"removed {scene}/{capture}; next: dvc repro")


@app.command(rich_help_panel=MAINTENANCE)
def merge() -> None:
    """Resolve the git conflicts that arise when a branch with other recordings is merged.

    The conflicts are in the files that commands write: data/captures.yaml, pipeline/plan.yaml, dvc.lock and reports.
    """
    from pipeline.manage import merge as merging

    typer.echo(merging.merge(ROOT))


@app.command(rich_help_panel=MAINTENANCE)
def publish() -> None:
    """Write to MLflow the training runs and reports that are missing there.

    They are missing, for example, if the MLflow server could not be reached when they were computed.
    """
    from pipeline.scenes import read_scene
    from pipeline.stages.report import published_results, write_scene

    for name in checked_plan().scenes:
        scene, results = read_scene(ROOT, name), ROOT / "data/results" / name
        models = {stage: ROOT / "data/models" / name / stage for stage in scene.model_stages}
        written = [results / f"{stage}.json" for stage in (*scene.curves.values(), *scene.analyses)]
        missing = [path for path in (*models.values(), *written) if not path.exists()]
        if missing:
            path = missing[0].relative_to(ROOT)
            typer.echo(
                f"scene {name}: {path} is missing, so nothing is written to MLflow. To compute all results: dvc repro"
            )
            continue
        folders = (
            *(ROOT / "data" / kind / name for kind in ("indentations", "models", "scores", "results")),
            ROOT / "reports" / name,
        )
        typer.echo(write_scene(published_results(scene, name, *folders), name, ROOT))


@app.command(rich_help_panel=PIPELINE)
def compare(
    scene: Annotated[str | None, Argument(help="Name of a scene. Default: all scenes that `dvc repro` runs.")] = None,
    against: Annotated[str, Option(help="Compare with the reports of this git revision or folder.")] = "HEAD",
) -> None:
    """Compare the reports in reports/ with the committed reports. The exit status is 1 if any value differs."""
    from pipeline.manage.compare import compare_scene

    names = [scene] if scene else checked_plan().scenes
    sys.exit(max((compare_scene(ROOT, name, against, typer.echo) for name in names), default=0))


@app.command(rich_help_panel=PIPELINE)
def summary(
    scene: Annotated[str | None, Argument(help="Name of a scene. Default: all scenes that `dvc repro` runs.")] = None,
) -> None:
    """Print the main scores, say whether they equal the committed scores, and name pages and commands to go on with."""
    from pipeline.manage.summary import print_summary

    print_summary(ROOT, [scene] if scene else list(checked_plan().scenes), typer.echo)


@app.command(rich_help_panel=PIPELINE)
def verify_reports(
    names: Annotated[
        list[str] | None,
        Argument(metavar="[SCENE]...", help="Names of scenes. Default: all scenes that `dvc repro` runs."),
    ] = None,
    against: Annotated[
        Path | None,
        Option(
            help="Folder with reports of scenes that were run again before. If this option is given, the scenes are "
            "not run, and these reports are compared."
        ),
    ] = None,
) -> None:
    """Run scenes again in a fresh clone of the last commit, and compare their reports with the committed reports.

    The exit status is 1 if any value differs.
    """
    from pipeline.manage.verify import verify

    sys.exit(verify(ROOT, names or list(checked_plan().scenes), against, typer.echo))


@app.command(rich_help_panel=MAINTENANCE)
def check_cache() -> None:
    """Look for damaged files in DVC's cache, move them out of the cache, and print how to restore them."""
    from pipeline.manage import cache

    sys.exit(cache.check(ROOT, typer.echo))


@app.command(rich_help_panel=MAINTENANCE)
def readme(
    check: Annotated[
        bool, Option("--check", help="Write nothing; exit with status 1 if a page is out of date.")
    ] = False,
) -> None:
    """Write the generated parts of README.md and docs, and the figure of README.md, from the results in reports/."""
    from pipeline.report.readme import fill_pages

    changed, scenes_shown = fill_pages(ROOT, write=not check)
    if check and changed:
        typer.echo(f"out of date: {', '.join(changed)}; to write them again: reskin readme", err=True)
        sys.exit(1)
    typer.echo(f"rewritten: {', '.join(changed) or 'nothing'}; results shown: scenes {', '.join(scenes_shown)}")


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
    from pipeline.manage import tidy as tidying

    plan.use(ROOT, names)
    typer.echo(f"dvc repro now runs: {', '.join(names)}")
    if stale := tidying.stale_outputs(ROOT, checked_plan()):
        typer.echo(
            f"There are still results of stages that no longer run: {', '.join(stale)}. To delete them: reskin scenes "
            "tidy"
        )


@scenes.command()
def tidy() -> None:
    """Delete the results of experiments that the scenes in the plan no longer run."""
    from pipeline.manage import tidy as tidying

    stale = tidying.tidy(ROOT, checked_plan())
    for stage, paths in stale.items():
        typer.echo(f"removed {stage}: {', '.join(map(str, paths)) or 'no files, because other stages use them'}")
    if not stale:
        typer.echo("nothing to remove")


@scenes.command()
def check() -> None:
    """Check the settings of the scenes that `dvc repro` runs, and whether pipeline/plan.yaml is up to date."""
    names = list(checked_plan().scenes)
    typer.echo(f"{PLAN} is up to date; scenes: {', '.join(names) or 'none'}")


@models.command("make")
def make_model(
    layout: Annotated[
        Path,
        Option(
            help="Layout of your board: a YAML file like reskin/universal/layouts/reskin.yaml, or the YAML file of a "
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
) -> None:
    """Simulate skins on your board, and train a universal model for it.

    This takes a few minutes and needs PyTorch.
    """
    from pipeline.training import shipping

    shipping.make(layout, out, typer.echo)
    typer.echo(f"wrote {out}. Next: reskin live --model {out}")


# `reskin --help` lists groups of commands in the order in which their first commands are registered. Sorting puts the
# group of maintenance commands last.
app.registered_commands.sort(key=lambda command: command.rich_help_panel == MAINTENANCE)

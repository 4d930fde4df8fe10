"""Commands that manage the recordings, scenes and results of a checkout, which is the working directory.

`reskin.cli` adds them to `reskin` if it runs in a checkout. Each command imports what it needs when it runs, so that
`reskin --help` is quick.
"""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer
from typer import Argument, Option

from pipeline import PLAN
from reskin.cli import Wire
from reskin.recordings import ReaderLayout

if TYPE_CHECKING:
    from pipeline.scenes import Plan

ROOT = Path()  # of the checkout

app = typer.Typer()
scenes = typer.Typer(no_args_is_help=True, help="Choose which scenes `dvc repro` runs.")
app.add_typer(scenes, name="scenes")

Layout = Literal["capture", "serial-binary", "serial-text", ReaderLayout]
Board = Annotated[str, Option(help="Name of the circuit board.")]
Marks = Annotated[
    list[str] | None,
    Option(
        help="Layouts capture, serial-*: STREAM_S,PROBE_S, the times of one event in the recording and in the "
        "robot's log; may be repeated."
    ),
]


def checked_plan() -> "Plan":
    """Read the plan; raise if it is out of date."""
    from pipeline import plan

    return plan.check(ROOT)


@app.command()
def add(
    recording: Annotated[Path, Argument(help="A file or a folder, depending on the layout.")],
    layout: Annotated[Layout, Option(help="Format of the recording (see data/README.md).")],
    board: Board,
    skin: Annotated[str, Option(help="Name of the skin; a skin belongs to one board.")],
    scene: Annotated[str, Option(help="Scene to add the recording to.")],
    like: Annotated[str | None, Option(help="Create SCENE as a copy of this scene first.")] = None,
    name: Annotated[str | None, Option(help="Name of the capture. Default: made from board and skin.")] = None,
    probe: Annotated[Path | None, Option(help="Layouts capture, serial-*: log of the robot (CSV).")] = None,
    chips_n: Annotated[int, Option("--chips", help="Layouts serial-*: chips in a frame.", min=1, max=64)] = 5,
    rate_hz: Annotated[float, Option("--rate-hz", help="Layouts serial-*: frames per second.")] = 400.0,
    wire: Annotated[
        Wire | None,
        Option(help="Layouts serial-*: wire format. Default: binary for serial-binary, text-xyzt for serial-text."),
    ] = None,
    mark: Marks = None,
    rows_late: Annotated[
        int | None,
        Option(help="Layout ini: number of rows by which fields lag behind labels. Default: detected.", min=0, max=5),
    ] = None,
    force_axis: Annotated[Literal["x", "y", "z"], Option(help="Layout eflesh: direction of the force gauge.")] = "z",
    allow_copy: Annotated[
        bool,
        Option("--allow-copy", help="Add it even if the scene has the same readings under another board or skin."),
    ] = False,
) -> None:
    """Add a recording to a scene. The next `dvc repro` uses it."""
    from pipeline import plan
    from pipeline.manage import add as adding
    from pipeline.scenes import read_plan
    from reskin.recordings import preparing

    names, marks = preparing.CaptureNames(board, skin, name), preparing.parse_marks(mark or [])
    running = read_plan(ROOT / PLAN).scenes
    with plan.scene_copy(ROOT, scene, like), preparing.suggesting_layout(recording, layout):
        if layout == "capture":
            prepared = preparing.native(recording, names, probe, marks)
        elif layout == "serial-binary" or layout == "serial-text":
            usual: Wire = "binary" if layout == "serial-binary" else "text-xyzt"
            prepared = preparing.dump(recording, names, preparing.Dump(wire or usual, chips_n, rate_hz, probe, marks))
        else:
            options = {"force_axis": str(force_axis)} if layout == "eflesh" else {}
            options |= {"rows_late": str(rows_late)} if layout == "ini" and rows_late is not None else {}
            prepared = preparing.foreign(recording, layout, names, options)
        header = adding.add(ROOT, scene, prepared, allow_copy=allow_copy)
    typer.echo(f"added {scene}/{header.capture} (board {board}, skin {skin}); now: dvc repro (or: report@{scene})")
    if scene not in running:
        typer.echo(f"added scene {scene} to {PLAN} (already there: {', '.join(running) or 'none'})")


@app.command()
def fetch(
    source: Annotated[str | None, Argument(help="lab, ini, eflesh or eflash7. Default: list these sources.")] = None,
    origin: Annotated[
        str | None, Option("--from", help="Git mirror, or folder of the files, to read instead of the source's home.")
    ] = None,
    yes: Annotated[bool, Option("--yes", help="Do not ask before fetching data that have no licence.")] = False,
) -> None:
    """Fetch public recordings, verify them, and add them to their scene."""
    from pipeline.manage import fetch as fetching

    def agree(question: str) -> bool:
        return yes or (sys.stdin.isatty() and typer.confirm(question))

    fetching.fetch(ROOT, source, origin, agree=agree, say=typer.echo)


@app.command()
def remove(
    scene: Annotated[str, Argument(help="Scene that the capture belongs to.")],
    capture: Annotated[str, Argument(help="Name of the capture.")],
) -> None:
    """Remove a recorded capture from a scene."""
    from pipeline.manage import add as adding

    adding.remove(ROOT, scene, capture)
    typer.echo(f"removed {scene}/{capture}; now: dvc repro")


@app.command()
def merge() -> None:
    """Resolve conflicts in captures, plan, dvc.lock and reports after a git merge of two people's recordings."""
    from pipeline.manage import merge as merging

    typer.echo(merging.merge(ROOT))


@app.command()
def publish() -> None:
    """Write to MLflow the training runs and reports that are missing there, of the scenes that `dvc repro` runs."""
    from pipeline.scenes import read_scene
    from pipeline.stages.report import read_curves
    from pipeline.tracking import publish as write

    for name in checked_plan().scenes:
        scene, results = read_scene(ROOT, name), ROOT / "data/results" / name
        models = {stage: ROOT / "data/models" / name / stage for stage in scene.model_stages}
        written = [results / f"{stage}.json" for stage in (*scene.curves.values(), *scene.analyses)]
        missing = [path for path in (*models.values(), *written) if not path.exists()]
        if missing:
            typer.echo(f"{name}: {missing[0].relative_to(ROOT)} not found; run dvc repro first")
            continue
        counts = write(models, read_curves(scene, results), ROOT / "reports" / name, scene=name, root=ROOT)
        typer.echo(f"{name}: MLflow runs {counts}")


@app.command()
def compare(
    scene: Annotated[str | None, Argument(help="Name of a scene. Default: all that `dvc repro` runs.")] = None,
    against: Annotated[str, Option(help="Git revision, or folder, of the reports to compare with.")] = "HEAD",
) -> None:
    """Compare fresh reports with the committed ones; exit status 1 if any value differs."""
    from pipeline.manage.compare import compare_scene

    names = [scene] if scene else checked_plan().scenes
    sys.exit(max((compare_scene(ROOT, name, against, typer.echo) for name in names), default=0))


@app.command()
def verify_reports(
    names: Annotated[
        list[str] | None, Argument(metavar="[SCENE]...", help="Default: all scenes that `dvc repro` runs.")
    ] = None,
    against: Annotated[
        Path | None, Option(help="Folder with the reports of an earlier rerun, to compare without running again.")
    ] = None,
) -> None:
    """Rerun scenes in a fresh clone of the last commit; exit status 1 if any value of their reports differs."""
    from pipeline.manage.verify import verify

    sys.exit(verify(ROOT, names or list(checked_plan().scenes), against, typer.echo))


@app.command()
def check_cache() -> None:
    """Verify the files in DVC's cache and move damaged ones aside; `dvc repro` then makes them again."""
    from pipeline.manage import cache

    sys.exit(cache.check(ROOT, typer.echo))


@app.command()
def readme(
    check: Annotated[bool, Option("--check", help="Write nothing; exit status 1 if they are out of date.")] = False,
) -> None:
    """Write the generated parts of README.md and docs from the results in reports/."""
    from pipeline.report.readme import fill_pages

    changed, shown = fill_pages(ROOT, write=not check)
    if check and changed:
        typer.echo(f"out of date: {', '.join(changed)}; run: reskin readme", err=True)
        sys.exit(1)
    typer.echo(f"rewritten: {', '.join(changed) or 'nothing'}; results shown: scenes {', '.join(shown)}")


@scenes.command("list")
def list_scenes() -> None:
    """List all scenes; a star marks those that `dvc repro` runs."""
    from pipeline import plan

    running = checked_plan().scenes
    for name in plan.scene_names(ROOT):
        typer.echo(f"{'*' if name in running else ' '} {name}")


@scenes.command()
def use(names: Annotated[list[str], Argument(help="Names of all scenes to run.")]) -> None:
    """Set the scenes that `dvc repro` runs."""
    from pipeline import plan
    from pipeline.manage import tidy as tidying

    plan.use(ROOT, names)
    typer.echo(f"dvc repro now runs: {', '.join(names)}")
    if stale := tidying.stale_outputs(ROOT, checked_plan()):
        typer.echo(f"files of stages that no longer run: {', '.join(stale)}; `reskin scenes tidy` removes them")


@scenes.command()
def tidy() -> None:
    """Remove the output files of experiments that the scenes no longer run."""
    from pipeline.manage import tidy as tidying

    stale = tidying.tidy(ROOT, checked_plan())
    for stage, paths in stale.items():
        typer.echo(f"removed {stage}: {', '.join(map(str, paths)) or 'no file of its own'}")
    if not stale:
        typer.echo("nothing to remove")


@scenes.command()
def check() -> None:
    """Check the scenes in the plan and params.yaml, and that the plan is up to date."""
    checked_plan()

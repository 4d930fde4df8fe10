"""Commands that manage a checkout: recordings, scenes, results. They join the `reskin` command there (`reskin.cli`).

A command imports what it needs when it runs, so that `reskin --help` is quick.
"""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer
from typer import Argument, Option

from pipeline import PLAN
from reskin.cli import Wire
from reskin.errors import ParamsError
from reskin.recordings import ReaderLayout

if TYPE_CHECKING:
    from pipeline.scenes import Plan

app = typer.Typer()
scenes = typer.Typer(no_args_is_help=True, help="Choose which scenes `dvc repro` runs.")
app.add_typer(scenes, name="scenes")

Layout = Literal["capture", "serial-binary", "serial-text", ReaderLayout]
Board = Annotated[str, Option(help="The circuit board's name.")]
Marks = Annotated[list[str] | None, Option(help="capture, serial-*: STREAM_S,PROBE_S of one event; may be repeated.")]


def checkout() -> Path:
    """Give the checkout that a command works in: the working directory."""
    root = Path()
    if not (root / "dvc.yaml").is_file():
        rule = "a checkout of the project, with dvc.yaml in it"
        raise ParamsError("reskin", "the working directory", rule, Path.cwd(), "Change to the checkout first.")
    return root


def checked_plan() -> "Plan":
    """Read the checkout's plan; raise if it is not what its scenes ask for."""
    from pipeline import plan

    return plan.check(checkout())


@app.command()
def add(
    recording: Annotated[Path, Argument(help="A file or a folder, as its layout has it.")],
    layout: Annotated[Layout, Option(help="What wrote it.")],
    board: Board,
    skin: Annotated[str, Option(help="The skin's name; a skin belongs to one board.")],
    scene: Annotated[str, Option(help="The scene that it joins.")],
    like: Annotated[str | None, Option(help="The scene that a new SCENE is a copy of.")] = None,
    name: Annotated[str | None, Option(help="The capture's name; made from the labels if not given.")] = None,
    probe: Annotated[Path | None, Option(help="capture, serial-*: the robot's log (CSV).")] = None,
    chips_n: Annotated[int, Option("--chips", help="serial-*: chips in a frame.", min=1, max=64)] = 5,
    rate_hz: Annotated[float, Option("--rate-hz", help="serial-*: frames a second.")] = 400.0,
    wire: Annotated[Wire | None, Option(help="serial-*: format, if not binary or text-xyzt.")] = None,
    mark: Marks = None,
    rows_late: Annotated[int | None, Option(help="ini: rows that fields lag; without it, found.", min=0, max=5)] = None,
    force_axis: Annotated[Literal["x", "y", "z"], Option(help="eflesh: the gauge's direction.")] = "z",
    allow_copy: Annotated[bool, Option("--allow-copy", help="Accept bytes that another label has.")] = False,
) -> None:
    """Add a recording to a scene; then `dvc repro` uses it."""
    root = checkout()  # first: who is elsewhere lacks more than packages
    from pipeline import plan
    from pipeline.manage import add as adding
    from pipeline.scenes import read_plan
    from reskin.recordings import preparing

    labels, marks = preparing.Labels(board, skin, name), preparing.parse_marks(mark or [])
    running = read_plan(root / PLAN).scenes
    with plan.copied(root, scene, like), preparing.suggesting_layout(recording, layout):
        if layout == "capture":
            prepared = preparing.native(recording, labels, probe, marks)
        elif layout == "serial-binary" or layout == "serial-text":
            usual: Wire = "binary" if layout == "serial-binary" else "text-xyzt"
            prepared = preparing.dump(recording, labels, preparing.Dump(wire or usual, chips_n, rate_hz, probe, marks))
        else:
            options = {"force_axis": str(force_axis)} if layout == "eflesh" else {}
            options |= {"rows_late": str(rows_late)} if layout == "ini" and rows_late is not None else {}
            prepared = preparing.foreign(recording, layout, labels, options)
        header = adding.add(root, scene, prepared, allow_copy=allow_copy)
    typer.echo(f"added {scene}/{header.capture} (board {board}, skin {skin}); now: dvc repro (or: report@{scene})")
    if scene not in running:
        typer.echo(f"switched scene {scene} on in {PLAN}, beside {', '.join(running) or 'no other'}")


@app.command()
def fetch(
    source: Annotated[str | None, Argument(help="lab, ini, eflesh or eflash7; without one, lists them.")] = None,
    origin: Annotated[str | None, Option("--from", help="A git mirror or a folder, in place of its home.")] = None,
    yes: Annotated[bool, Option("--yes", help="Agree to use what has no licence.")] = False,
) -> None:
    """Fetch public recordings from their home, check them, and add them to their scene."""
    root = checkout()
    from pipeline.manage import fetch as fetching

    def agree(question: str) -> bool:
        return yes or (sys.stdin.isatty() and typer.confirm(question))

    fetching.fetch(root, source, origin, agree=agree, say=typer.echo)


@app.command()
def remove(scene: str, capture: str) -> None:
    """Take a recorded capture out of a scene again."""
    root = checkout()
    from pipeline.manage import add as adding

    adding.remove(root, scene, capture)
    typer.echo(f"removed {scene}/{capture}; now: dvc repro")


@app.command()
def merge() -> None:
    """Settle captures, plan and dvc.lock where a git merge of two people's recordings leaves them in conflict."""
    root = checkout()
    from pipeline.manage import merge as merging

    typer.echo(merging.merge(root))


@app.command()
def publish() -> None:
    """Write to MLflow what is not there yet, from the models of the scenes that run."""
    root = checkout()
    from pipeline.scenes import read_scene
    from pipeline.stages.report import read_curves
    from pipeline.tracking import publish as write

    for name in checked_plan().scenes:
        scene, results = read_scene(root, name), root / "data/results" / name
        arms = {arm: root / "data/models" / name / arm for arm in scene.model_stages}
        written = [results / f"{stage}.json" for stage in (*scene.curves.values(), *scene.analyses)]
        missing = [path for path in (*arms.values(), *written) if not path.exists()]
        if missing:
            typer.echo(f"{name}: {missing[0].relative_to(root)} is not there yet; run dvc repro first")
            continue
        counts = write(arms, read_curves(scene, results), root / "reports" / name, scene=name, root=root)
        typer.echo(f"{name}: MLflow runs {counts}")


@app.command()
def compare(
    scene: Annotated[str | None, Argument(help="A scene; without one, all that run.")] = None,
    against: Annotated[str, Option(help="A git revision, or a folder with reports.")] = "HEAD",
) -> None:
    """Compare fresh reports with the committed ones; exit status 1 if any value differs."""
    root = checkout()
    from pipeline.manage.compare import compare_scene

    names = [scene] if scene else checked_plan().scenes
    sys.exit(max((compare_scene(root, name, against, typer.echo) for name in names), default=0))


@app.command()
def verify_reports(
    names: Annotated[list[str] | None, Argument(metavar="[SCENE]...", help="Without any, all that run.")] = None,
    against: Annotated[Path | None, Option(help="Finished reports, in place of a rerun.")] = None,
) -> None:
    """Run scenes again in a clean copy of the last commit; exit status 1 if any value of their reports differs."""
    root = checkout()
    from pipeline.manage.verify import verify

    sys.exit(verify(root, names or list(checked_plan().scenes), against, typer.echo))


@app.command()
def check_cache() -> None:
    """Hold DVC's cache against its names; what was changed is set aside, and `dvc repro` makes it again."""
    root = checkout()
    from pipeline.manage import cache

    sys.exit(cache.check(root, typer.echo))


@app.command()
def readme(check: Annotated[bool, Option("--check", help="Only tell whether it is up to date.")] = False) -> None:
    """Fill in the generated parts of README.md and docs from the results in reports, whichever scenes run."""
    root = checkout()
    from pipeline.report.readme import fill_pages

    changed, shown = fill_pages(root, write=not check)
    if check and changed:
        typer.echo(f"behind reports and dvc.yaml: {', '.join(changed)}; run: reskin readme", err=True)
        sys.exit(1)
    typer.echo(f"rewritten: {', '.join(changed) or 'nothing'}; results shown: scenes {', '.join(shown)}")


@scenes.command("list")
def list_scenes() -> None:
    """Show the scenes of this checkout; a star marks those that `dvc repro` runs."""
    from pipeline import plan

    running = checked_plan().scenes
    for name in plan.scene_names(checkout()):
        typer.echo(f"{'*' if name in running else ' '} {name}")


@scenes.command()
def use(names: list[str]) -> None:
    """Let `dvc repro` run exactly these scenes."""
    from pipeline import plan
    from pipeline.manage import tidy as tidying

    plan.use(checkout(), names)
    typer.echo(f"dvc repro now runs: {', '.join(names)}")
    if stale := tidying.stale_outputs(checkout(), checked_plan()):
        typer.echo(f"switched off since it ran: {', '.join(stale)}; `reskin scenes tidy` removes their files")


@scenes.command()
def tidy() -> None:
    """Remove the files of experiments that were switched off since they ran, of the scenes that run."""
    from pipeline.manage import tidy as tidying

    stale = tidying.tidy(checkout(), checked_plan())
    for stage, paths in stale.items():
        typer.echo(f"removed {stage}: {', '.join(map(str, paths)) or 'no file of its own'}")
    if not stale:
        typer.echo("nothing is left over")


@scenes.command()
def check() -> None:
    """Fail if a scene or params.yaml is wrong, or the plan is not what the scenes ask for."""
    checked_plan()

"""The `reskin` command: words of the command line -> one call each. Knows no format and no model."""

import math
import signal
import subprocess
import sys
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from pipeline import adding, plan, preparing, tidying
from pipeline.core import io
from pipeline.core.config import read_yaml
from pipeline.core.errors import ParamsError, ReskinError
from pipeline.core.server import TrackingAway
from pipeline.params import read_scene

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="Learning for magnetic tactile skins. Run it in the checkout.",
)
scenes = typer.Typer(no_args_is_help=True, help="Choose which scenes `dvc repro` runs.")
app.add_typer(scenes, name="scenes")

ROOT = Path()
FULL_SIZE = "paper"  # the scene whose results the README shows first, where it was run


class Layout(StrEnum):
    """What `reskin add` can read."""

    CAPTURE = "capture"
    SERIAL_BINARY = "serial-binary"
    SERIAL_TEXT = "serial-text"
    LAB = "lab"
    INI = "ini"
    EFLESH = "eflesh"


class Wire(StrEnum):
    """The formats that boards send."""

    BINARY = "binary"
    BINARY_CLOCK = "binary-clock"
    TEXT_XYZT = "text-xyzt"
    TEXT_TXYZ = "text-txyz"


class Axis(StrEnum):
    """The direction that a one-axis gauge measured."""

    X = "x"
    Y = "y"
    Z = "z"


def main() -> None:
    """Run the command; show what a user did wrong as one sentence, without a traceback."""
    try:
        signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that what began is undone
        app()
    except ReskinError as error:
        typer.echo(f"error: {error}", err=True)
        sys.exit(error.exit_code)


@app.command()
def add(
    recording: Annotated[Path, typer.Argument(help="A file or a folder, as its layout has it.")],
    layout: Annotated[Layout, typer.Option(help="What wrote it.")],
    board: Annotated[str, typer.Option(help="The circuit board's name.")],
    skin: Annotated[str, typer.Option(help="The skin's name; a skin belongs to one board.")],
    scene: Annotated[str, typer.Option(help="The scene that it joins.")],
    name: Annotated[str | None, typer.Option(help="The capture's name; made from the labels if not given.")] = None,
    probe: Annotated[Path | None, typer.Option(help="capture, serial-*: the robot's log (CSV).")] = None,
    chips_n: Annotated[int, typer.Option("--chips", help="serial-*: chips in a frame.", min=1, max=64)] = 5,
    rate_hz: Annotated[float, typer.Option("--rate-hz", help="serial-*: frames a second.")] = 400.0,
    wire: Annotated[Wire | None, typer.Option(help="serial-*: format, if not binary or text-xyzt.")] = None,
    mark: Annotated[
        list[str] | None,
        typer.Option(help="capture, serial-*: STREAM_S,PROBE_S, one event on both clocks; may be repeated."),
    ] = None,
    rows_late: Annotated[int, typer.Option(help="ini: rows by which fields lag behind truths.", min=0, max=5)] = 0,
    force_axis: Annotated[Axis, typer.Option(help="eflesh: the gauge's direction.")] = Axis.Z,
    allow_copy: Annotated[
        bool, typer.Option("--allow-copy", help="Accept bytes that are there under another label.")
    ] = False,
) -> None:
    """Add a recording to a scene; then `dvc repro` uses it."""
    labels = preparing.Labels(board, skin, name)
    marks = preparing.parse_marks(mark or [])
    if layout is Layout.CAPTURE:
        prepared = preparing.native(recording, labels, probe, marks)
    elif layout in (Layout.SERIAL_BINARY, Layout.SERIAL_TEXT):
        usual = Wire.BINARY if layout is Layout.SERIAL_BINARY else Wire.TEXT_XYZT
        dump = preparing.Dump((wire or usual).value, chips_n, rate_hz, probe, marks)
        prepared = preparing.dump(recording, labels, dump)
    else:
        options = {"force_axis": force_axis.value} if layout is Layout.EFLESH else {}
        options |= {"rows_late": str(rows_late)} if layout is Layout.INI else {}
        prepared = preparing.foreign(recording, layout.value, labels, options)  # type: ignore[arg-type]
    header = adding.add(ROOT, scene, prepared, allow_copy=allow_copy)
    typer.echo(f"added {scene}/{header.capture} (board {board}, skin {skin}); now: dvc repro")


@app.command()
def remove(scene: str, capture: str) -> None:
    """Take a recorded capture out of a scene again."""
    adding.remove(ROOT, scene, capture)
    typer.echo(f"removed {scene}/{capture}; now: dvc repro")


@app.command()
def record(
    port: Annotated[str, typer.Option(help="The serial port, such as /dev/ttyACM0 or COM3.")],
    board: Annotated[str, typer.Option(help="The circuit board's name.")],
    skin: Annotated[str, typer.Option(help="The skin's name.")],
    out: Annotated[Path, typer.Option(help="The capture's folder; must be new.")],
    wire: Annotated[Wire, typer.Option(help="What the firmware sends.")] = Wire.BINARY,
    chips_n: Annotated[int, typer.Option("--chips", help="Chips in a frame.", min=1, max=64)] = 5,
    baud: Annotated[int, typer.Option(help="Baud rate; USB ports ignore it.", min=1)] = 115200,
    seconds: Annotated[float, typer.Option(help="How long; without it, until Ctrl-C.", min=0.0)] = math.inf,
) -> None:
    """Record what a board sends; label it with the robot's log when adding it."""
    from pipeline.capture.port import PortSettings
    from pipeline.recording import record_capture

    settings = PortSettings(baud, wire.value, chips_n, seconds, bytes_max_n=None, silence_s=5.0, no_frame_s=5.0)
    done = record_capture(port, out, board=board, skin=skin, settings=settings)
    counts = ", ".join(f"{key} {count}" for key, count in done.account.items() if count)
    typer.echo(f"recorded {out} ({done.ended} after {done.duration_s:.1f} s): {counts}")


@app.command()
def decode(
    stream: Annotated[Path, typer.Argument(help="A file of bytes as they came from a port.")],
    out: Annotated[Path, typer.Option(help="The Parquet file to write.")],
    wire: Annotated[Wire, typer.Option(help="What the firmware sent.")] = Wire.BINARY,
    chips_n: Annotated[int, typer.Option("--chips", help="Chips in a frame.", min=1, max=64)] = 5,
) -> None:
    """Decode a dump of a port to one row a frame, and account for every byte."""
    from pipeline.capture.dump import decode_dump

    table, account = decode_dump(io.read_bytes(stream), wire.value, chips_n, str(stream))
    io.write_table(out, table)
    typer.echo(f"decoded {out}: " + ", ".join(f"{key} {count}" for key, count in account.items()))


@app.command()
def predict(
    log: Annotated[Path, typer.Argument(help="A log as an SD card holds it: t_s,T0,Bx0,By0,Bz0,T1,...; degC and uT.")],
    model: Annotated[Path, typer.Option(help="A trained model (.safetensors), its card (.json) beside it.")],
    out: Annotated[Path, typer.Option(help="The CSV to write: t_s,x_mm,y_mm,F_N,contact.")],
) -> None:
    """Turn a board's log into contacts, places and forces; it begins with a second without contact."""
    from pipeline.predicting import predict as write

    counts = write(log, model, out)
    typer.echo(f"predicted {out}: " + ", ".join(f"{key} {count:.6g}" for key, count in counts.items()))


@app.command()
def publish() -> None:
    """Write to MLflow what is not there yet, from the models of the scenes that run."""
    from pipeline.stages.publish import read_curves
    from pipeline.tracking import publish as write

    for scene in plan.check(ROOT).scenes:
        asked, answers = read_scene(plan.scene_file(ROOT, scene), ROOT / plan.PARAMS), ROOT / "data/answers" / scene
        arms = {arm: ROOT / "data/models" / scene / arm for arm in asked.modelled}
        written = [answers / f"{stage}.json" for stage in (*asked.curves.values(), *asked.experiments)]
        missing = [path for path in (*arms.values(), *written) if not path.exists()]
        if missing:
            typer.echo(f"{scene}: {missing[0].relative_to(ROOT)} is not there yet; run dvc repro first")
            continue
        try:
            curves = read_curves(asked, answers)
            counts = write(arms, curves, ROOT / "reports" / scene, scene=scene, root=ROOT)
        except TrackingAway as away:
            typer.echo(f"error: {away}", err=True)
            sys.exit(3)
        typer.echo(f"{scene}: MLflow runs {counts}")


@app.command()
def compare(
    scene: Annotated[str | None, typer.Argument(help="A scene; without one, all that run.")] = None,
    against: Annotated[str, typer.Option(help="A git revision, a folder or a numbers.json.")] = "HEAD",
) -> None:
    """Hold fresh numbers against the committed ones; exit status 1 if any differs by more than it may."""
    from pipeline.comparing import compare_scene, table_of, verdict  # pandas, for this command only

    worst = 0
    for name in [scene] if scene else plan.check(ROOT).scenes:
        try:
            done = compare_scene(ROOT, name, against)
        except ReskinError as error:
            typer.echo(f"error: {error}", err=True)
            worst = max(worst, error.exit_code)
            continue
        if table := table_of(done):
            typer.echo(table)
        typer.echo(verdict(name, against, done))
        worst = max(worst, 0 if done.reproduced else 1)
    sys.exit(worst)


@app.command()
def readme(check: Annotated[bool, typer.Option("--check", help="Only tell whether it is up to date.")] = False) -> None:
    """Fill in the generated parts of README.md from the results of the scenes that run."""
    from pipeline.reporting.readme import blocks_of, fill

    running = list(plan.check(ROOT).scenes)
    if not running:
        raise ParamsError(plan.PLAN, "scenes", "one or more", "none", "Try: reskin scenes use quick")
    scene = running[0]
    dag = subprocess.run(
        [sys.executable, "-m", "dvc", "dag", "--md"], capture_output=True, text=True, check=True
    ).stdout
    numbers = {file.parent.name: io.read_json(file) for file in sorted((ROOT / "reports").glob("*/numbers.json"))}
    recorded = [own for own in numbers.values() if own["provenance"]["source"] == "recorded"]
    results = [numbers[name] for name in dict.fromkeys([FULL_SIZE, scene]) if name in numbers]
    blocks = blocks_of(results, recorded, dag, read_yaml(ROOT / "dvc.yaml")["stages"])
    file = ROOT / "README.md"
    before = file.read_text(encoding="utf-8")
    after = fill(before, blocks)
    if check and after != before:
        typer.echo("README.md is behind reports and dvc.yaml; run: reskin readme", err=True)
        sys.exit(1)
    if not check:
        io.write_text(file, after)


@scenes.command("list")
def list_scenes() -> None:
    """Show the scenes of this checkout; a star marks those that `dvc repro` runs."""
    running = plan.check(ROOT).scenes
    for name in plan.scene_names(ROOT):
        typer.echo(f"{'*' if name in running else ' '} {name}")


@scenes.command()
def use(names: list[str]) -> None:
    """Let `dvc repro` run exactly these scenes."""
    plan.use(ROOT, names)
    typer.echo(f"dvc repro now runs: {', '.join(names)}")
    if stale := tidying.left_over(ROOT, plan.check(ROOT)):
        typer.echo(f"switched off since it ran: {', '.join(stale)}; `reskin scenes tidy` removes their files")


@scenes.command()
def tidy() -> None:
    """Remove the files of questions that were switched off since they ran, of the scenes that run."""
    stale = tidying.tidy(ROOT, plan.check(ROOT))
    for stage, paths in stale.items():
        typer.echo(
            f"removed {stage}: {', '.join(str(path.relative_to(ROOT)) for path in paths) or 'no file of its own'}"
        )
    if not stale:
        typer.echo("nothing is left over")


@scenes.command()
def check() -> None:
    """Fail if a scene or params.yaml is wrong, or the plan is not what the scenes ask for."""
    plan.check(ROOT)


if __name__ == "__main__":
    main()

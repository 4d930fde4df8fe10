"""The `reskin` command, with the subcommands ports, template, record, emulate, live, decode, predict and export.

In a checkout of the project, the subcommands of `pipeline.cli` are added. Each command imports its dependencies when it
runs, so that `reskin --help` is quick.
"""

import importlib
import math
import signal
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, Literal, NoReturn

import typer
from typer import Argument, Option

from reskin.errors import ParamsError, ReskinError, explaining

CHECKOUT_COMMANDS = (  # commands of `pipeline.cli`, which help and error texts name outside a checkout
    "add", "check-cache", "compare", "fetch", "merge", "model", "new", "publish", "readme", "remove", "scenes", "score",
    "summary", "verify-reports",
)  # fmt: skip

BOARD, RECORDINGS, PIPELINE, MAINTENANCE = (
    "Board",
    "Recordings",
    "Pipeline",
    "Maintenance",
)  # titles of command groups in `reskin --help`

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="Learning for magnetic tactile skins: read boards, record, see contacts live, estimate contacts from logs.",
    epilog=f"In a checkout of the project also: {', '.join(CHECKOUT_COMMANDS)}.",
)

Wire = Literal["binary", "binary-clock", "text-xyzt", "text-txyz"]
Chips = Annotated[int, Option("--chips", help="Number of chips in a frame.", min=1, max=64)]
SOURCE = "A capture folder, `nominal` (a simulated skin), or the YAML file of a simulated scene."
ON_FAULT = (
    "NAME=flag keeps the estimates of readings with that fault, such as stuck=flag; NAME=drop hides them. May be "
    "repeated. The names are listed in params.yaml, section faults."
)
LABELS = "grid:NXxNY:STEP_MM or line:N:STEP_MM: prompts for each place. Or a CSV to which a robot's program appends."
SCAN = (
    "Order in which places are pressed. With prompts (--labels grid, line): random (default) or snake; otherwise any "
    "note, which is written to the header."
)
GAUGE = "Port of a force gauge that sends lines of Fz, or Fx Fy Fz, in N; PORT@BAUD if its rate is not 9600."
BOARD_NAME = "With nominal: name of the simulated board. Each name gives another board, with another skin."
ROBOT = (
    "With nominal: a robot presses the skin at the paper's 65 places, twice, and appends times, places and forces to "
    "this CSV file, for `reskin record --labels`."
)
SIMULATED = (
    "Mark the capture as simulated. Use it for a port of `reskin emulate`, which looks like that of a real board."
)
FAULT = (
    "NAME[@START_S[+SECONDS]], such as stuck@8+2. Default: begins after 3 s, lasts 1 s. May be repeated. Names: "
    "failed-read, zeros, chip-reset, stuck, slow-chips, saturated, int16-wrap, magnet, too-hot, crlf, clock-jump, "
    "repeated, dropped, torn, wrong-baud, stall, unplug."
)
MODEL = (
    "A trained network, a model from `model make` (.safetensors with its JSON card), a saved calibration, or, if the "
    "option is given twice, a model and its calibration. Default: the universal model for the paper's board."
)
EXTERNAL = "For a moving board: size of the external field's changes in uT (docs/live.md). Universal model only."
NEW_DAY = "The calibration was made on an earlier day, so the skin may now slide differently (docs/live.md)."
USUAL_COUNTS = {  # counts of `predict` that are not faults
    "rate_hz", "duration_s", "readings_n", "quiet_start_s", "noise_uT", "contact_readings_n", "contacts_n",
    "force_max_N", "bytes_n", "frames_n", "frame_bytes_n", "rows_read_n", "rows_n",
}  # fmt: skip
LOG = "An SD card's log (t_s,T0,Bx0,By0,Bz0,T1,...; degC, uT), a folder from `record`, or a file from `decode`."


def main() -> None:
    """Run the `reskin` command; print a `ReskinError` without a traceback."""
    try:
        # Exit with status 128 + SIGTERM. `sys.exit` raises SystemExit, so that `finally` and `with` blocks clean up.
        signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
        with explaining("reskin"):
            add_checkout_commands()
            app(args=with_default_simulation(sys.argv[1:]))
    except ReskinError as error:
        fail(error)


def with_default_simulation(arguments: Sequence[str]) -> list[str]:
    """Insert `nominal` after an option --emulate that has no value, because Typer has no options with optional values.

    >>> with_default_simulation(["live", "--emulate", "--http-port", "8000"])
    ['live', '--emulate', 'nominal', '--http-port', '8000']
    """
    completed = []
    for argument, following in zip(arguments, [*arguments[1:], "-"], strict=True):
        completed.append(argument)
        if argument == "--emulate" and following.startswith("-"):
            completed.append("nominal")
    return completed


def fail(error: ReskinError) -> NoReturn:
    typer.echo(f"error: {error}", err=True)
    sys.exit(error.exit_code)


def add_checkout_commands() -> None:
    """Add the commands of `pipeline.cli` if the working directory is a checkout of the project."""
    here = Path.cwd()
    if (here / "dvc.yaml").is_file() and (here / "pipeline/cli.py").is_file():
        sys.path.insert(0, str(here))
        app.add_typer(importlib.import_module("pipeline.cli").app)
        app.info.epilog = "Stages of dvc.yaml: python -m pipeline STAGE --scene NAME ..."
    elif sys.argv[1:2] and sys.argv[1] in CHECKOUT_COMMANDS:
        raise ParamsError(
            f"reskin {sys.argv[1]} must be run in a checkout of the project, a folder with dvc.yaml and pipeline/. "
            f"{here} is not a checkout: change to one first."
        )


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(version("reskin"))
        raise typer.Exit


@app.callback()
def common_options(
    version: Annotated[
        bool, Option("--version", help="Show the version.", callback=_show_version, is_eager=True)
    ] = False,
) -> None:
    """Declare the options that come before a command."""


@app.command("ports", rich_help_panel=BOARD)
def find_ports(
    names: Annotated[list[str] | None, Argument(help="Ports to search. Default: all ports of this machine.")] = None,
    hunt: Annotated[bool, Option("--hunt", help="Find the board by unplugging it and plugging it in.")] = False,
    rate: Annotated[bool, Option("--rate", help="Measure frame rates, and explain what limits them.")] = False,
    seconds: Annotated[float, Option(help="With --rate: duration of the measurement.", min=0.5)] = 5.0,
    osr: Annotated[int, Option(help="With --rate: setting OSR of the chips.", min=0, max=3)] = 0,
    dig_filt: Annotated[
        int, Option("--dig-filt", help="With --rate: setting DIG_FILT of the chips.", min=0, max=7)
    ] = 2,
) -> None:
    """Find connected boards, and print the port, wire format, number of chips, frame rate and scale of each."""
    from reskin.board import find
    from reskin.physics.chip import conversion_s

    if hunt:
        names = [find.find_replugged_port(typer.echo)]
    for board in find.scan_ports(names, listening_s=seconds if rate else find.LISTENING_S):
        typer.echo(board.describe_rate(conversion_s(osr, dig_filt)) if rate else board)


@app.command(rich_help_panel=RECORDINGS)
def template(
    out: Annotated[Path, Argument(help="The CSV file to write; it must not exist.")],
    chips_n: Chips = 5,
) -> None:
    """Write a CSV with a header line only, to fill with your own recording: one row per reading; see data/README.md."""
    from reskin import io
    from reskin.recordings.readers.table import NEEDED, columns_of

    if out.exists():
        raise ParamsError(f"{out}: the file exists. Choose another name.")
    io.write_text(out, ",".join(columns_of(chips_n)) + "\n")
    typer.echo(f"wrote {out}. Fill in {', '.join(NEEDED)} and fields in uT, then run reskin add --layout table")


@app.command(rich_help_panel=BOARD)
def record(
    port: Annotated[
        str | None, Option(help="/dev/ttyACM0, COM3 or socket://host:port. Default: the only connected board.")
    ] = None,
    board: Annotated[str | None, Option(help="Name of the circuit board; can be given later, to `reskin add`.")] = None,
    skin: Annotated[str | None, Option(help="Name of the skin; can be given later, to `reskin add`.")] = None,
    out: Annotated[Path | None, Option(help="New folder for the capture. Default: captures/DATE-TIME.")] = None,
    wire: Annotated[Wire | None, Option(help="With --port: wire format. Default: binary.")] = None,
    chips_n: Annotated[
        int | None, Option("--chips", help="With --port: number of chips. Default: 5.", min=1, max=64)
    ] = None,
    baud: Annotated[int, Option(help="Baud rate; USB ports ignore it.", min=1)] = 115200,
    seconds: Annotated[float, Option(help="Duration. Default: until Ctrl-C.", min=0.0)] = math.inf,
    scan: Annotated[str | None, Option(help=SCAN)] = None,
    labels: Annotated[str | None, Option(help=LABELS)] = None,
    gauge: Annotated[str | None, Option(help=GAUGE)] = None,
    dwell_s: Annotated[
        float, Option("--dwell", help="Seconds for which a label is valid after you press Enter.", min=0.1)
    ] = 1.0,
    simulated: Annotated[bool, Option("--simulated", help=SIMULATED)] = False,
) -> None:
    """Record a board, with labels if requested. `reskin add` can add labels from a robot's log later."""
    from reskin.board.find import DetectedBoard, find_board
    from reskin.live.record import label_source, record_board

    label_of = label_source(labels, gauge, scan, dwell_s=dwell_s, say=typer.echo)
    if port is None:
        if wire is not None or chips_n is not None:
            raise ParamsError(
                "--wire and --chips need --port. Add --port, or omit --wire and --chips to detect the board."
            )
        detected = find_board()
        typer.echo(str(detected))
    else:
        detected = DetectedBoard(port, None, wire or "binary", chips_n or 5)
    given = {"board": board, "skin": skin, "scan": scan}
    names = {key: name for key, name in given.items() if name is not None}
    result = record_board(
        detected, label_of, folder=out, seconds=seconds, baud=baud, names=names,
        source="simulated" if simulated else "recorded",
    )  # fmt: skip
    typer.echo(result.summary)
    if result.error is not None:
        raise typer.Exit(2)


def _announce_simulation(source: str) -> None:
    """Print on stderr that the program is simulating a board, because there is no other output for some seconds."""
    if source == "nominal" or Path(source).is_file():
        typer.echo("simulating the board; the first time, the simulation is also compiled: please wait", err=True)


@app.command(rich_help_panel=BOARD)
def emulate(
    source: Annotated[str, Argument(help=SOURCE)],
    port: Annotated[str, Option(help="pty, tcp, tcp:PORT, or ./NAME (creates a link to a pseudo-terminal).")] = "pty",
    speed: Annotated[float, Option(help="Speed relative to the source; inf: as fast as possible.", min=0.01)] = 1.0,
    fault: Annotated[list[str] | None, Option(help=FAULT)] = None,
    loop: Annotated[bool, Option("--loop", help="Start again at the end.")] = False,
    true_places: Annotated[
        bool, Option("--true-places", help="Print the true place and force of each simulated touch.")
    ] = False,
    board: Annotated[str | None, Option(help=BOARD_NAME)] = None,
    robot: Annotated[Path | None, Option(help=ROBOT)] = None,
) -> None:
    """Emulate a board: send the frames of a capture or a simulation through a port, with faults if requested."""
    from reskin.live.emulator import RobotLog, TouchPrinter, inject, make_port, parse_fault, play, read_script

    faults = [parse_fault(text) for text in fault or ()]
    _announce_simulation(source)
    script = read_script(source, board=board, robot=robot is not None)
    for spec in faults:
        script = inject(script, spec)
    listeners: list[Callable[[int], None]] = []
    if true_places:
        listeners.append(TouchPrinter(script, source, typer.echo))
    if robot is not None:
        listeners.append(RobotLog(script, robot, speed))

    def on_sent(piece_i: int) -> None:
        for listener in listeners:
            listener(piece_i)

    emulated, stop = make_port(port), threading.Event()
    typer.echo(f"{emulated.name}: {len(script)} frames in {script.duration_s:.1f} s, {script.wire}; Ctrl-C: stop")
    started_s = time.monotonic()
    try:
        sent_n = play(script, emulated, stop, speed=speed, loop=loop, on_sent=on_sent)
        typer.echo(f"sent {sent_n} bytes in {time.monotonic() - started_s:.1f} s")
    except KeyboardInterrupt:
        typer.echo("stopped")
    finally:
        emulated.unplug()


@app.command(rich_help_panel=BOARD)
def live(
    port: Annotated[list[str] | None, Option(help="Port of a board; may be repeated. Default: all boards.")] = None,
    model: Annotated[list[Path] | None, Option(help=f"{MODEL} The estimates of several networks are averaged.")] = None,
    replay: Annotated[str | None, Option(help="Folder of a capture to play, instead of a board.")] = None,
    emulate: Annotated[
        str | None,
        Option(help="Simulation to play, instead of a board: nominal (default), or the YAML of a simulated scene."),
    ] = None,
    host: Annotated[
        str, Option(help="Address to listen on. 0.0.0.0: other machines can connect; the printed URL then has a token.")
    ] = "127.0.0.1",
    http_port: Annotated[int, Option(help="TCP port of the page.", min=1, max=65535)] = 8765,
    on_fault: Annotated[list[str] | None, Option(help=ON_FAULT)] = None,
    external_uT: Annotated[float, Option("--external-uT", help=EXTERNAL)] = 0.0,
    new_day: Annotated[bool, Option("--new-day", help=NEW_DAY)] = False,
    skins: Annotated[Path, Option(help="Folder in which the page saves calibrations of skins.")] = Path("skins"),
) -> None:
    """Show boards live in the browser: chip readings, contact, force, traces and alarms."""
    from contextlib import ExitStack

    from reskin.board.find import find_boards
    from reskin.live.emulator import playing, read_script
    from reskin.live.health import LIVE_POLICY
    from reskin.live.server import serve
    from reskin.live.session import open_sessions
    from reskin.live.skins import SkinFolder
    from reskin.predicting import read_models
    from reskin.recordings.fault_policy import override
    from reskin.recordings.recorder import CAPTURES

    fault_policy = override(LIVE_POLICY, on_fault or (), "--on-fault")
    given = [name for name, value in (("--port", port), ("--replay", replay), ("--emulate", emulate)) if value]
    if len(given) > 1:
        raise ParamsError(f"live: use only one of {', '.join(given)}.")
    models, skin_folder = read_models(model or (), external_uT, new_day=new_day), SkinFolder(skins)
    with ExitStack() as stack:
        description, emulated = "a board", None
        if source := replay or emulate:
            _announce_simulation(source)
            script = read_script(source)
            emulated = stack.enter_context(playing(script))
            port, description = [emulated.port], f"{script.source}: {source}, played"
        sessions = open_sessions(
            port or [found.port for found in find_boards()], models, description, fault_policy, skins=skin_folder,
            model_name=", ".join(file.name for file in model or ()), emulated=emulated,
        )  # fmt: skip
        where = f"skins are saved in {skins.absolute()}, recordings in {CAPTURES.absolute()}"
        serve(sessions, host=host, http_port=http_port, say=typer.echo, where=where)


@app.command(rich_help_panel=RECORDINGS)
def decode(
    stream: Annotated[Path, Argument(help="A file with the raw bytes from a port.")],
    out: Annotated[Path, Option(help="The Parquet file to write.")],
    wire: Annotated[Wire, Option(help="Wire format.")] = "binary",
    chips_n: Chips = 5,
) -> None:
    """Decode the raw bytes of a serial port to a table of frames, and count lost bytes."""
    from reskin import io
    from reskin.recordings.decode import decode_dump

    table, counts = decode_dump(io.read_bytes(stream), wire, chips_n, str(stream))
    io.write_table(out, table)
    typer.echo(f"wrote {out}: " + ", ".join(f"{key} {count}" for key, count in counts.items()))


@app.command(rich_help_panel=RECORDINGS)
def predict(
    log: Annotated[Path, Argument(help=LOG)],
    out: Annotated[Path, Option(help="The CSV to write: t_s,x_mm,y_mm,F_N,contact.")],
    model: Annotated[list[Path] | None, Option(help=MODEL)] = None,
    rate_hz: Annotated[
        float, Option("--rate-hz", help="Frames per second, for a file from `decode` without a clock.")
    ] = 400.0,
    external_uT: Annotated[float, Option("--external-uT", help=EXTERNAL)] = 0.0,
    new_day: Annotated[bool, Option("--new-day", help=NEW_DAY)] = False,
) -> None:
    """Estimate contacts, places and forces from a log that begins with at least 0.5 s without contact."""
    from reskin.predicting import predict as write
    from reskin.predicting import warnings

    counts = write(log, model, out, rate_hz=rate_hz, external_uT=external_uT, new_day=new_day)
    typer.echo(f"wrote {out}: {_describe_log(counts)}")
    for sentence in warnings(counts):
        typer.echo(sentence)


def _describe_log(counts: Mapping[str, Any]) -> str:
    """Describe the log that `predict` read: its contacts, then all faults and doubts that occurred."""
    described = (
        f"{counts['readings_n']} readings in {counts['duration_s']:.1f} s ({counts['rate_hz']:.1f} Hz), "
        f"{counts['contacts_n']} contacts in {counts['contact_readings_n']} of them"
    )
    if "force_max_N" in counts:
        described += f", up to {counts['force_max_N']:.2f} N"
    faults = {key: n for key, n in counts.items() if key not in USUAL_COUNTS and not isinstance(n, list) and n}
    return "; ".join([described, *(f"{key} {n:.6g}" for key, n in faults.items())])


@app.command(rich_help_panel=RECORDINGS)
def export(
    files: Annotated[list[Path], Argument(help=f"Recordings. {LOG[:-1]}, or a table in data/indentations.")],
    out: Annotated[Path, Option(help="The folder to create.")],
    to: Annotated[Literal["lerobot"], Option(help="Format: lerobot, a LeRobot dataset v3.0.")] = "lerobot",
    task: Annotated[str, Option(help="What the robot does, in natural language.")] = "press the skin",
    fps: Annotated[int | None, Option(help="Frames per second. Default: each reading is a frame.")] = None,
    rate_hz: Annotated[
        float | None, Option("--rate-hz", help="Readings per second, for files without times.", min=1.0)
    ] = None,
) -> None:
    """Export recordings as a dataset for robot learning (docs/robots.md)."""
    from reskin.robots.dataset import export_lerobot

    counts = export_lerobot(files, out, task=task, fps=fps, rate_hz=rate_hz)
    typer.echo(f"wrote {out}: " + ", ".join(f"{key} {count:.6g}" for key, count in counts.items()))


if __name__ == "__main__":
    main()

"""The `reskin` command, with the subcommands ports, template, record, emulate, live, decode, predict and export.

If the command is run in a checkout of the project, the subcommands of `pipeline.cli` are available too. Each subcommand
imports its dependencies only when it runs, so that `reskin --help` is quick.
"""

import importlib
import math
import os
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

# Commands of `pipeline.cli`, which can be run only in a checkout of the project. Outside a checkout, the list is needed
# for the help, and for the error message if a user runs one of these commands.
CHECKOUT_COMMANDS = (
    "add", "fetch", "model", "new", "publish", "readme", "remove", "scenes", "verify",
)  # fmt: skip

BOARD, RECORDINGS, PIPELINE, MAINTENANCE = (
    "Board",
    "Recordings",
    "Pipeline",
    "Maintenance",
)  # titles of the groups of commands in `reskin --help`

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="Learning for magnetic tactile skins: read boards, record, see contacts live, estimate contacts from logs.",
    epilog=f"In a checkout of the project, there are also the commands {', '.join(CHECKOUT_COMMANDS)}.",
)

WIRE = (
    "Format in which the board sends readings: binary, binary-clock, text-xyzt, text-txyz, or that of other firmware: "
    "text: with the columns of a line, such as text:Bx0,By0,Bz0,Bx1,By1,Bz1, or a YAML file (docs/live.md)."
)
Chips = Annotated[int, Option("--chips", help="Number of chips in a frame.", min=1, max=64)]
SOURCE = "The folder of a capture, `nominal` (a simulated skin), or the YAML file of a simulated scene."
ON_FAULT = (
    "Whether estimates are shown for readings with the fault NAME. NAME=flag shows them, for example stuck=flag. "
    "NAME=drop hides them. The names of the faults are in section faults of params.yaml. The option can be repeated."
)
LABELS = (
    "Where the places of the presses come from. grid:NXxNY:STEP_MM and line:N:STEP_MM: the command asks you to press "
    "the places of a grid or a line, one after the other. Name of a CSV file: a robot's program writes its presses to "
    "this file, and the command reads them."
)
SCAN = (
    "Order of the presses. With --labels grid or line, the command asks for the places in this order: random (default) "
    "or snake. Otherwise, write any description. It is stored in the capture's header and has no other effect."
)
GAUGE = (
    "Port of a force gauge. The gauge must send lines of text with Fz, or with Fx Fy Fz, in N. If its baud rate is not "
    "9600, use PORT@BAUD."
)
BOARD_NAME = "Only with source nominal: name of the simulated board. Each name gives another board with another skin."
ROBOT = (
    "Only with source nominal: a simulated robot presses the skin at the paper's 65 places, twice. It appends the "
    "times, places and forces to this CSV file, which `reskin record --labels` can read."
)
SIMULATED = (
    "State in the header of the capture that it is simulated. Use this option for a port of `reskin emulate`, because "
    "it cannot be distinguished from the port of a real board."
)
MODEL = (
    "A trained network, a universal model from `reskin model make` (.safetensors, with its JSON card), or a saved "
    "calibration. Give the option twice for a universal model and its calibration. Default: the universal model for "
    "the paper's board."
)
EXTERNAL = (
    "Expected change of the external field in uT, for a board that moves (docs/live.md). Only the universal model has "
    "this option."
)
USUAL_COUNTS = {  # counts in the result of `predict` that do not indicate a fault
    "rate_hz", "duration_s", "readings_n", "quiet_start_s", "noise_uT", "contact_readings_n", "contacts_n",
    "force_max_N", "accuracy_pct", "accuracy_registered_pct", "rms_force_N",
    "bytes_n", "frames_n", "frame_bytes_n", "rows_read_n", "rows_n",
}  # fmt: skip
LOG = (
    "A log from an SD card (columns t_s,T0,Bx0,By0,Bz0,T1,... in s, degC and uT), a folder that `reskin record` wrote, "
    "or a file that `reskin decode` wrote."
)
LOG_OR_TABLE = f"{LOG[:-1]}; or a table with labels, which is scored."


def main() -> None:
    """Run the `reskin` command. If it raises a `ReskinError`, only the message is printed, without a traceback."""
    try:
        # If the process is terminated (SIGTERM), exit with status 128 + SIGTERM. `sys.exit` raises SystemExit, so that
        # `finally` and `with` blocks clean up.
        signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
        with explaining("reskin"):
            add_checkout_commands()
            app(args=with_default_simulation(sys.argv[1:]))
    except ReskinError as error:
        fail(error)


def with_default_simulation(arguments: Sequence[str]) -> list[str]:
    """Insert the value `nominal` after an option --emulate that has no value.

    This is needed because Typer does not support options whose value can be omitted.

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
        commands = importlib.import_module("pipeline.cli")
        used, own = (Path(str(file)).resolve().parents[1] for file in (__file__, commands.__file__))
        if used != own and sys.argv[1:2] and sys.argv[1] in CHECKOUT_COMMANDS:
            raise ParamsError(
                f"this checkout ({own}) cannot be run with the library of {used}. Run make here, then use the command "
                "in .venv/bin."
            )
        app.add_typer(commands.app)
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
    """Declare the options that are given before the name of a subcommand."""


@app.command("ports", rich_help_panel=BOARD)
def find_ports(
    names: Annotated[list[str] | None, Argument(help="Ports to search. Default: all ports of this machine.")] = None,
    hunt: Annotated[
        bool, Option("--hunt", help="Find the port of a board: you are asked to unplug it and to plug it in again.")
    ] = False,
    rate: Annotated[
        bool, Option("--rate", help="Measure the frame rate of each board, and explain what limits it.")
    ] = False,
    seconds: Annotated[float, Option(help="With --rate: duration of the measurement in s.", min=0.5)] = 5.0,
    osr: Annotated[int, Option(help="With --rate: value of the chips' setting OSR (oversampling).", min=0, max=3)] = 0,
    dig_filt: Annotated[
        int,
        Option("--dig-filt", help="With --rate: value of the chips' setting DIG_FILT (digital filter).", min=0, max=7),
    ] = 2,
) -> None:
    """Find connected boards. For each board, print its port, wire format, number of chips, frame rate and scale."""
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
    """Write a CSV file that contains only a header line. Fill it with your own recording, one row for each reading.

    The columns are described in data/README.md.
    """
    from reskin import io
    from reskin.recordings.readers.table import NEEDED, columns_of

    if out.exists():
        raise ParamsError(f"{out}: the file exists. Choose another name.")
    io.write_text(out, ",".join(columns_of(chips_n)) + "\n")
    typer.echo(
        f"wrote {out}. Fill in columns {', '.join(NEEDED)} and fields in uT, then run `reskin add --layout table`"
    )


@app.command(rich_help_panel=BOARD)
def record(
    port: Annotated[
        str | None, Option(help="/dev/ttyACM0, COM3 or socket://host:port. Default: the only connected board.")
    ] = None,
    board: Annotated[
        str | None, Option(help="Name of the circuit board. You can also give it later, to `reskin add`.")
    ] = None,
    skin: Annotated[str | None, Option(help="Name of the skin. You can also give it later, to `reskin add`.")] = None,
    out: Annotated[Path | None, Option(help="Folder to create for the capture. Default: captures/DATE-TIME.")] = None,
    wire: Annotated[str | None, Option(help=f"With --port. {WIRE} Default: binary.")] = None,
    chips_n: Annotated[
        int | None, Option("--chips", help="With --port: number of chips of the board. Default: 5.", min=1, max=64)
    ] = None,
    baud: Annotated[int, Option(help="Baud rate of the port. USB ports ignore it.", min=1)] = 115200,
    seconds: Annotated[
        float, Option(help="Duration of the recording in s. By default, recording ends when you press Ctrl-C.", min=0.0)
    ] = math.inf,
    scan: Annotated[str | None, Option(help=SCAN)] = None,
    labels: Annotated[str | None, Option(help=LABELS)] = None,
    gauge: Annotated[str | None, Option(help=GAUGE)] = None,
    dwell_s: Annotated[
        float, Option("--dwell", help="Time in s for which a label is valid after you press Enter.", min=0.1)
    ] = 1.0,
    simulated: Annotated[bool, Option("--simulated", help=SIMULATED)] = False,
) -> None:
    """Record the readings of a board in a new folder.

    With --labels, the places and forces of presses are recorded too. Labels from the log of a robot can also be added
    later, with `reskin add`.
    """
    from reskin.board.find import DetectedBoard, find_board
    from reskin.board.other_firmware import CustomWire, read_wire
    from reskin.live.record import label_source, record_board

    label_of = label_source(labels, gauge, scan, dwell_s=dwell_s, say=typer.echo)
    if port is None:
        if wire is not None or chips_n is not None:
            raise ParamsError(
                "--wire and --chips can only be used with --port. Add --port. Or omit --wire and --chips: the board is "
                "then detected."
            )
        detected = find_board()
        typer.echo(str(detected))
    else:
        given_wire = read_wire(wire or "binary")
        own_n = given_wire.chips_n if isinstance(given_wire, CustomWire) else 5
        detected = DetectedBoard(port, None, given_wire, chips_n or own_n)
    result = record_board(
        detected, label_of, folder=out, seconds=seconds, baud=baud,
        names={"board": board, "skin": skin, "scan": scan}, source="simulated" if simulated else "recorded",
    )  # fmt: skip
    typer.echo(result.summary)
    if result.error is not None:
        raise typer.Exit(2)


def _announce_simulation(source: str) -> None:
    """Print on stderr that the program is simulating a board.

    The simulation takes some seconds. Without this message, the user would see no output during this time.
    """
    if source == "nominal" or Path(source).is_file():
        typer.echo("simulating the board, which takes some seconds, and longer the first time: please wait", err=True)


@app.command(rich_help_panel=BOARD)
def emulate(
    source: Annotated[str, Argument(help=SOURCE)],
    port: Annotated[
        str,
        Option(
            help="Kind of port to create: pty (a pseudo-terminal), ./NAME (a pseudo-terminal with a link of this "
            "name), tcp or tcp:PORT (a TCP server)."
        ),
    ] = "pty",
    speed: Annotated[
        float,
        Option(
            help="Speed relative to the speed of the source. With inf, frames are sent as fast as possible.", min=0.01
        ),
    ] = 1.0,
    loop: Annotated[bool, Option("--loop", help="After the last frame, start again with the first frame.")] = False,
    true_places: Annotated[
        bool, Option("--true-places", help="Print the true place and the true force of each simulated touch.")
    ] = False,
    board: Annotated[str | None, Option(help=BOARD_NAME)] = None,
    robot: Annotated[Path | None, Option(help=ROBOT)] = None,
) -> None:
    """Emulate a board: create a port, and send the frames of a capture or of a simulation through it.

    Programs can read this port like the port of a real board. Press Ctrl-C to unplug the board.
    """
    from reskin.live.emulator import RobotLog, TouchPrinter, make_port, play, read_script

    _announce_simulation(source)
    script = read_script(source, board=board, robot=robot is not None)
    listeners: list[Callable[[range], None]] = []
    if true_places:
        listeners.append(TouchPrinter(script, source, typer.echo))
    if robot is not None:
        listeners.append(RobotLog(script, robot, speed))

    def on_sent(pieces: range) -> None:
        for listener in listeners:
            listener(pieces)

    emulated, stop = make_port(port), threading.Event()
    typer.echo(
        f"{emulated.name}: {len(script)} frames in {script.duration_s:.1f} s, {script.wire}; press Ctrl-C to stop"
    )
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
    port: Annotated[
        list[str] | None, Option(help="Port of a board. The option can be repeated. Default: all connected boards.")
    ] = None,
    model: Annotated[
        list[Path] | None, Option(help=f"{MODEL} If several networks are given, their estimates are averaged.")
    ] = None,
    replay: Annotated[str | None, Option(help="Show a recording instead of a board: the folder of a capture.")] = None,
    emulate: Annotated[
        str | None,
        Option(help="Show a simulation instead of a board: nominal (default), or the YAML file of a simulated scene."),
    ] = None,
    host: Annotated[
        str,
        Option(
            help="Address at which the page is served. With 0.0.0.0, other machines can connect. The printed URL then "
            "contains a token, without which the page cannot be opened."
        ),
    ] = "127.0.0.1",
    http_port: Annotated[int, Option(help="TCP port at which the page is served.", min=1, max=65535)] = 8765,
    on_fault: Annotated[list[str] | None, Option(help=ON_FAULT)] = None,
    external_uT: Annotated[float, Option("--external-uT", help=EXTERNAL)] = 0.0,
    wire: Annotated[str | None, Option(help=f"{WIRE} Default: detected among the known ones.")] = None,
    skins: Annotated[Path, Option(help="Folder in which the page saves the calibrations of skins.")] = Path("skins"),
) -> None:
    """Show boards live on a page in the browser: readings of the chips, contacts, forces, traces over time and alarms.

    On this page, you can also calibrate, record and save skins.
    """
    from contextlib import ExitStack

    from reskin.board.find import find_boards
    from reskin.board.other_firmware import custom_wire
    from reskin.live.emulator import playing, read_script
    from reskin.live.health import LIVE_POLICY
    from reskin.live.models import SkinFolder
    from reskin.live.server import serve
    from reskin.live.session import open_sessions
    from reskin.predicting import read_models
    from reskin.recordings.fault_policy import override
    from reskin.recordings.recorder import CAPTURES

    fault_policy = override(LIVE_POLICY, on_fault or (), "--on-fault")
    given = [name for name, value in (("--port", port), ("--replay", replay), ("--emulate", emulate)) if value]
    if len(given) > 1:
        raise ParamsError(f"live: use only one of {', '.join(given)}.")
    custom = custom_wire(wire)
    models, skin_folder = read_models(model or (), external_uT), SkinFolder(skins)
    with ExitStack() as stack:
        description, emulated = "a board", None
        if source := replay or emulate:
            _announce_simulation(source)
            script = read_script(source)
            emulated = stack.enter_context(playing(script))
            port, description = [emulated.port], f"{script.source}: {source}, played"
        sessions = open_sessions(
            port or [found.port for found in find_boards(wire=custom)], models, description, fault_policy,
            skins=skin_folder, wire=custom, emulated=emulated,
            model_name=", ".join(file.name for file in model or ()),
        )  # fmt: skip
        _warn_of_absent_ports(port or ())
        where = f"skins are saved in {skins.absolute()}, recordings in {CAPTURES.absolute()}"
        serve(sessions, host=host, http_port=http_port, say=typer.echo, where=where)


def _warn_of_absent_ports(ports: Sequence[str]) -> None:
    """Print a warning for each serial port that does not exist. The page waits for such a port."""
    from reskin.board.port import found_ports, port_names

    absent = [port for port in ports if "://" not in port and not os.path.exists(port)]
    known = {name.casefold() for name in port_names()} if absent else set()  # Windows ignores the case of names
    if missing := [port for port in absent if port.casefold() not in known]:
        typer.echo(f"warning: {', '.join(missing)}: no such port. The page waits for it. {found_ports()}", err=True)


@app.command(rich_help_panel=RECORDINGS)
def decode(
    stream: Annotated[Path, Argument(help="A file with the raw bytes that were read from a port.")],
    out: Annotated[Path, Option(help="The file to write: CSV if its name ends in .csv, otherwise Parquet.")],
    wire: Annotated[str, Option(help=WIRE)] = "binary",
    chips_n: Chips = 5,
) -> None:
    """Decode raw bytes that were read from a port; write a table with one row per frame, and count the lost bytes."""
    from reskin.board.other_firmware import CustomWire, read_wire
    from reskin.recordings.decode import decode_file

    form = read_wire(wire)
    counts = decode_file(stream, out, form, form.chips_n if isinstance(form, CustomWire) else chips_n)
    typer.echo(f"wrote {out}: " + ", ".join(f"{key} {count}" for key, count in counts.items()))


@app.command(rich_help_panel=RECORDINGS)
def predict(
    log: Annotated[Path, Argument(help=LOG_OR_TABLE)],
    out: Annotated[Path, Option(help="The CSV file to write, with columns t_s,x_mm,y_mm,F_N,contact.")],
    model: Annotated[list[Path] | None, Option(help=MODEL)] = None,
    rate_hz: Annotated[
        float,
        Option(
            "--rate-hz",
            help="Frames per second. This option is used only if the log is a file of `reskin decode` that contains no "
            "times.",
        ),
    ] = 400.0,
    external_uT: Annotated[float, Option("--external-uT", help=EXTERNAL)] = 0.0,
) -> None:
    """Estimate contacts, places and forces from a log, and write them to a CSV file.

    The log must begin with at least 0.5 s without contact, from which the no-load reading is taken.
    """
    from reskin.predicting import predict as write
    from reskin.predicting import warnings

    counts = write(log, model, out, rate_hz=rate_hz, external_uT=external_uT)
    typer.echo(f"wrote {out}: {_describe_log(counts)}")
    for sentence in warnings(counts):
        typer.echo(sentence)


def _describe_log(counts: Mapping[str, Any]) -> str:
    """Describe the log that `predict` read: first its contacts, then the counts of faults and of doubtful estimates.

    Counts that are 0 are omitted.
    """
    if "accuracy_pct" in counts:
        place, shifted = counts["accuracy_pct"], counts["accuracy_registered_pct"]
        described = f"{counts['readings_n']} readings with labels, {place:.0f} % within 1 mm in x and y"
        described += f" ({shifted:.0f} % if all places are shifted by the mean error)"
        if "rms_force_N" in counts:
            described += f", RMS error of the force {counts['rms_force_N']:.2f} N"
    else:
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
    files: Annotated[
        list[Path],
        Argument(help=f"The recordings to export. Each is one of these: {LOG[:-1]}, or a table in data/indentations."),
    ],
    out: Annotated[Path, Option(help="The folder to create for the dataset.")],
    to: Annotated[Literal["lerobot"], Option(help="Format of the dataset; lerobot is LeRobot v3.0.")] = "lerobot",
    task: Annotated[
        str, Option(help="Description of what the robot does, which is written to the dataset.")
    ] = "press the skin",
    fps: Annotated[
        int | None, Option(help="Frames per second of the dataset. Default: each reading becomes a frame.")
    ] = None,
    rate_hz: Annotated[
        float | None, Option("--rate-hz", help="Readings per second of recordings that contain no times.", min=1.0)
    ] = None,
) -> None:
    """Export recordings as a dataset with which robot policies can be trained (docs/python.md)."""
    from reskin.robots.dataset import export_lerobot

    counts = export_lerobot(files, out, task=task, fps=fps, rate_hz=rate_hz)
    typer.echo(f"wrote {out}: " + ", ".join(f"{key} {count:.6g}" for key, count in counts.items()))


if __name__ == "__main__":
    main()

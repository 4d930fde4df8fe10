"""The `reskin` command: ports, record, decode, emulate, live, predict, template.

In a checkout of the project, the commands of `pipeline.cli` join it. A command imports what it needs when it runs, so
that `reskin --help` is quick.
"""

import importlib
import math
import signal
import sys
import threading
import time
from pathlib import Path
from typing import Annotated, Literal, NoReturn

import typer
from typer import Argument, Option

from reskin.errors import ParamsError, ReskinError, explaining
from reskin.packages import explain, show_version

CHECKOUT = ("dvc.yaml", "pipeline/cli.py")  # files of a checkout of the project
OF_CHECKOUT = (  # commands of `pipeline.cli`
    "add", "check-cache", "compare", "fetch", "merge", "publish", "readme", "remove", "scenes", "verify-reports",
)  # fmt: skip


app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="Learning for magnetic tactile skins: read boards, record, see contacts live, turn logs into contacts.",
    epilog=f"In a checkout of the project also: {', '.join(OF_CHECKOUT)}.",
)

Wire = Literal["binary", "binary-clock", "text-xyzt", "text-txyz"]
Speed = Annotated[float, Option(help="Times its own rate; inf: as fast as it is taken.", min=0.01)]
Baud = Annotated[int, Option(help="Baud rate; USB ports ignore it.", min=1)]
SOURCE = "A capture's folder, nominal (a simulated skin), or the YAML file of a simulated scene."
ON_FAULT = "NAME=drop|flag|refuse: are readings that a fault has hit shown? May be repeated, such as stuck=flag."
LABELS = "grid:NXxNY:STEP_MM or line:N:STEP_MM asks you to press places (Enter); or a CSV that a robot appends to."
GAUGE = "Port of a force gauge that sends lines of Fz, or Fx Fy Fz, in N; @BAUD behind it, if not 9600."
FAULT = "NAME[@START_S[+SECONDS]], such as stuck@3+1; may be repeated. A wrong name lists them all."
MODEL = "A trained model (.safetensors), its card (.json) beside it, or a saved skin; else the map of simulated skins."
LOGS = "A log of an SD card (t_s,T0,Bx0,By0,Bz0,T1,...; degC, uT), a folder of `record`, a file of `decode`."
Chips = Annotated[int, Option("--chips", help="Chips in a frame.", min=1, max=64)]
Version = Annotated[bool, Option("--version", help="Show the version.", callback=show_version, is_eager=True)]


def main() -> None:
    """Run the command; show what a user did wrong as one sentence, without a traceback."""
    try:
        signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that what began is undone
        with explaining("reskin"):
            add_checkout_commands()
            app()
    except ModuleNotFoundError as error:
        fail(explain(error))
    except ReskinError as error:
        fail(error)


def fail(error: ReskinError) -> NoReturn:
    typer.echo(f"error: {error}", err=True)
    sys.exit(error.exit_code)


def add_checkout_commands() -> None:
    """Add the commands of the checkout that the working directory is; its own code runs, wherever `reskin` is from."""
    here = Path.cwd()
    if all((here / file).is_file() for file in CHECKOUT):
        sys.path.insert(0, str(here))
        app.add_typer(importlib.import_module("pipeline.cli").app)
        app.info.epilog = None
    elif sys.argv[1:2] and sys.argv[1] in OF_CHECKOUT:
        rule = "a checkout of the project, with dvc.yaml in it"
        raise ParamsError("reskin", "the working directory", rule, here, "Change to the checkout first.")


@app.callback()
def begin(version: Version = False) -> None:
    """Take the options that stand before a command."""


@app.command("ports")
def find_ports(
    names: Annotated[list[str] | None, Argument(help="Ports to listen to; without any, all of this machine.")] = None,
    hunt: Annotated[bool, Option("--hunt", help="Find the board by unplugging it and plugging it in again.")] = False,
) -> None:
    """Find boards: which port, what they send, how often, and the scale of their chips."""
    from reskin.board import find

    for found in find.find_boards([find.hunt(typer.echo)] if hunt else names):
        typer.echo(found)


@app.command()
def template(
    out: Annotated[Path, Argument(help="The CSV file to write; must be new.")],
    chips_n: Annotated[int, Option("--chips", help="Chips in a frame.", min=1, max=64)] = 5,
) -> None:
    """Write the first line of a recording in layout `table`; which columns may go stands in data/README.md."""
    from reskin import io
    from reskin.errors import ParamsError
    from reskin.recordings.readers.table import NEEDED, columns_of

    if out.exists():
        raise ParamsError(out, "the file", "new", "one that is there", "Choose another name.")
    io.write_text(out, ",".join(columns_of(chips_n)) + "\n")
    typer.echo(f"wrote {out}: {', '.join(NEEDED)} and fields in uT are needed. Then: reskin add --layout table")


@app.command()
def record(
    port: Annotated[
        str | None, Option(help="/dev/ttyACM0, COM3, socket://host:port; not given: the one there.")
    ] = None,
    board: Annotated[str | None, Option(help="The circuit board's name; `reskin add` asks for it anyhow.")] = None,
    skin: Annotated[str | None, Option(help="The skin's name, likewise.")] = None,
    out: Annotated[Path | None, Option(help="The capture's folder; new. Not given: captures/DATE-TIME.")] = None,
    wire: Annotated[Wire | None, Option(help="What the firmware sends; with --port, binary if not given.")] = None,
    chips_n: Annotated[int | None, Option("--chips", help="With --port, 5 if not given.", min=1, max=64)] = None,
    baud: Baud = 115200,
    seconds: Annotated[float, Option(help="How long; without it, until Ctrl-C.", min=0.0)] = math.inf,
    scan: Annotated[str | None, Option(help="The order of the rig's places: random, snake, or your words.")] = None,
    labels: Annotated[str | None, Option(help=LABELS)] = None,
    gauge: Annotated[str | None, Option(help=GAUGE)] = None,
    dwell_s: Annotated[float, Option("--dwell", help="How long each prompt's label holds, in s.", min=0.1)] = 1.0,
) -> None:
    """Record what a board sends, and labels beside it; or label it with the robot's log when adding it."""
    from reskin.board.find import Found, the_board
    from reskin.live.record import label_source, record_board

    source = label_source(labels, gauge, scan, dwell_s=dwell_s, say=typer.echo)
    if port is None:
        found = the_board()
        typer.echo(str(found))
    else:
        found = Found(port, None, wire or "binary", chips_n or 5)
    given = {"board": board, "skin": skin, "scan": scan}
    names = {key: name for key, name in given.items() if name is not None}
    done = record_board(found, source, folder=out, seconds=seconds, baud=baud, names=names)
    typer.echo(done.summary)
    if done.error is not None:
        raise typer.Exit(2)


@app.command()
def emulate(
    source: Annotated[str, Argument(help=SOURCE)],
    port: Annotated[str, Option(help="pty, tcp, tcp:PORT, or ./NAME of a link to a pseudo-terminal.")] = "pty",
    speed: Speed = 1.0,
    fault: Annotated[list[str] | None, Option(help=FAULT)] = None,
    loop: Annotated[bool, Option("--loop", help="Begin again when it has ended.")] = False,
) -> None:
    """Be a board: send a capture or a simulated scene, with faults if asked, to whoever reads the port."""
    from reskin.live.emulator import inject, make_port, parse_fault, play, read_script

    faults = [parse_fault(text) for text in fault or ()]
    script = read_script(source)
    for one in faults:
        script = inject(script, one)
    emulated, stop = make_port(port), threading.Event()
    typer.echo(f"{emulated.name}: {len(script)} frames of {script.duration_s:.1f} s, {script.wire}; Ctrl-C ends it")
    started_s = time.monotonic()
    try:
        sent_n = play(script, emulated, stop, speed=speed, loop=loop)
        typer.echo(f"sent {sent_n} bytes in {time.monotonic() - started_s:.1f} s")
    except KeyboardInterrupt:
        typer.echo("stopped")
    finally:
        emulated.unplug()


@app.command()
def live(
    port: Annotated[list[str] | None, Option(help="A board's port, or several; not given: all that are there.")] = None,
    model: Annotated[
        list[Path] | None, Option(help="Trained models, or one skin that was saved; else the map of simulated skins.")
    ] = None,
    replay: Annotated[str | None, Option(help="In place of a board: the folder of a capture.")] = None,
    emulate: Annotated[str | None, Option(help="In place of a board: nominal, or a simulated scene's YAML.")] = None,
    host: Annotated[str, Option(help="Where the page listens; elsewhere than here, behind a token.")] = "127.0.0.1",
    http_port: Annotated[int, Option(help="The page's port.", min=1, max=65535)] = 8765,
    on_fault: Annotated[list[str] | None, Option(help=ON_FAULT)] = None,
) -> None:
    """Show boards at work in the browser: chips, contact, force, traces, and what is wrong."""
    from contextlib import ExitStack

    from reskin.board.find import the_boards
    from reskin.errors import ParamsError
    from reskin.live.emulator import playing, read_script
    from reskin.live.health import LIVE_POLICY
    from reskin.live.server import serve
    from reskin.live.session import open_sessions
    from reskin.predicting import read_models
    from reskin.recordings.fault_policy import override

    fault_policy = override(LIVE_POLICY, on_fault or (), "--on-fault")
    given = [name for name, value in (("--port", port), ("--replay", replay), ("--emulate", emulate)) if value]
    if len(given) > 1:
        raise ParamsError(f"live: give only one of {', '.join(given)}.")
    models = read_models(model or ())
    with ExitStack() as stack:
        shown = "a board"
        if source := replay or emulate:
            script = read_script(source)
            port, shown = [stack.enter_context(playing(script))], f"{script.source}: {source}, played"
        sessions = open_sessions(port or [found.port for found in the_boards()], models, shown, fault_policy)
        serve(sessions, host=host, http_port=http_port, say=typer.echo)


@app.command()
def decode(
    stream: Annotated[Path, Argument(help="A file of bytes as they came from a port.")],
    out: Annotated[Path, Option(help="The Parquet file to write.")],
    wire: Annotated[Wire, Option(help="What the firmware sent.")] = "binary",
    chips_n: Chips = 5,
) -> None:
    """Decode a dump of a port to one row a frame, and account for every byte."""
    from reskin import io
    from reskin.board.decode import decode_dump

    table, account = decode_dump(io.read_bytes(stream), wire, chips_n, str(stream))
    io.write_table(out, table)
    typer.echo(f"decoded {out}: " + ", ".join(f"{key} {count}" for key, count in account.items()))


@app.command()
def predict(
    log: Annotated[Path, Argument(help=LOGS)],
    out: Annotated[Path, Option(help="The CSV to write: t_s,x_mm,y_mm,F_N,contact.")],
    model: Annotated[Path | None, Option(help=MODEL)] = None,
    rate_hz: Annotated[float, Option("--rate-hz", help="Parquet without a device clock: frames a second.")] = 400.0,
) -> None:
    """Turn a board's log into contacts, places and forces; it begins with a second without contact."""
    from reskin.predicting import predict as write

    counts = write(log, model, out, rate_hz=rate_hz)
    typer.echo(f"predicted {out}: " + ", ".join(f"{key} {count:.6g}" for key, count in counts.items()))


if __name__ == "__main__":
    main()

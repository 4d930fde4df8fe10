"""Faults of MLflow: a server that is missing, does not respond or dies during a run, and a locked database."""

import http.server
import re
import shlex
import shutil
import signal
import socket
import sqlite3
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from pipeline.tracking import TrackingUnavailable, probe
from reskin import io
from tests.faults.harness import NOT_RUN, SCENE, Checkout, Result, Row, fault, judge


def _report(checkout: Checkout, first: Result, again: Result | None) -> Row:
    """Judge stage publish: it must succeed soon, with one warning; a later `reskin publish` must send all runs."""
    row, warned_n = judge(checkout, first, again or NOT_RUN, fails=False), first.output.count("warning:")
    row.lost, row.next_run = "nothing", "same as after 'tracking server refuses'"
    if again:
        counts = re.findall(r"MLflow runs (\{.*\})", again.output)
        row.next_run = f"`reskin publish`: {counts[-1] if counts else again.output.strip()[-200:]}"
        row.faults += [] if counts else ["`reskin publish` does not send the runs later"]
    row.faults += [f"{warned_n} warnings instead of one"] if warned_n != 1 else []
    row.faults += [f"exit status {first.status}"] if first.status else []
    took_s, undisturbed_s = (_took_s(each) for each in (checkout, checkout.template))
    row.message += f" (stage publish: {took_s:.0f} s; undisturbed {undisturbed_s:.0f} s)"
    row.faults += ["the stage takes much longer than undisturbed"] if took_s > 2 * undisturbed_s + 60 else []
    return row


def _took_s(checkout: Checkout) -> float:
    return float(io.read_json(checkout.folder / f".reskin/costs/{SCENE}/publish.json")["seconds"])


def _publish_to(checkout: Checkout, uri: str) -> Row:
    direct = {"no_proxy": "*", "NO_PROXY": "*"}  # otherwise, a proxy may respond instead of the server
    return _report(checkout, checkout.run(*checkout.command("publish"), MLFLOW_TRACKING_URI=uri, **direct), None)


@fault(
    "tracking server refuses",
    "MLFLOW_TRACKING_URI names a port on which no program listens; stage `publish` runs",
)
def refused(checkout: Checkout) -> Row:
    (checkout.folder / "mlflow.db").unlink()
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    first = checkout.run(*checkout.command("publish"), MLFLOW_TRACKING_URI=f"http://127.0.0.1:{port}")
    return _report(checkout, first, checkout.run("reskin", "publish"))


BLACK_HOLE = "10.255.255.1"
IN_BLACK_HOLE = (  # a network namespace in which packets to the only neighbour are discarded
    "ip link set lo up && ip link add hole0 type veth peer name hole1 && ip address add 10.255.255.2/24 dev hole0 && "
    "ip link set hole1 up && ip link set hole0 up && "
    f"ip neighbour add {BLACK_HOLE} lladdr 02:00:00:00:00:01 dev hole0 && exec "
)


@fault(
    "tracking server black-holed, nothing comes back",
    f"a network that discards all packets to {BLACK_HOLE}, as a firewall may do",
)
def no_route(checkout: Checkout) -> Row:
    command = ("unshare", "--net", "sh", "-c", IN_BLACK_HOLE + shlex.join(checkout.command("publish")))
    return _report(
        checkout,
        checkout.run(*command, MLFLOW_TRACKING_URI=f"http://{BLACK_HOLE}:5000", no_proxy="*", NO_PROXY="*"),
        None,
    )


@fault("tracking server black-holed, silent", "a socket that accepts connections and never responds")
def silent(checkout: Checkout) -> Row:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return _publish_to(checkout, f"http://127.0.0.1:{server.getsockname()[1]}")


class OnlyHealth(http.server.BaseHTTPRequestHandler):
    """HTTP server that responds to /health and leaves all other requests unanswered."""

    def do_GET(self) -> None:
        if self.path == "/health":
            self.send_response(200)
            self.end_headers()
        else:
            time.sleep(3600)

    do_POST = do_GET

    def log_message(self, *_: object) -> None:
        pass


@fault(
    "tracking server hangs after its health check",
    "a server that responds to /health only",
)
def hangs(checkout: Checkout) -> Row:
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), OnlyHealth)
    server.daemon_threads = True
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        return _publish_to(checkout, f"http://127.0.0.1:{server.server_port}")
    finally:
        server.shutdown()


@contextmanager
def _mlflow_server(checkout: Checkout, port: int) -> Iterator[subprocess.Popen[bytes]]:
    """Run an MLflow server on the store of this checkout."""
    other = Checkout(checkout.folder, checkout.folder.with_suffix(".server"))
    store, artifacts = f"sqlite:///{checkout.folder}/team.db", f"{checkout.folder}/team"
    server = other.start(
        "mlflow", "server", "--backend-store-uri", store, "--artifacts-destination", artifacts, "--port", str(port),
        "--workers", "1",
    )  # fmt: skip
    try:
        until_s = time.monotonic() + 180
        while time.monotonic() < until_s:
            try:
                probe(f"http://127.0.0.1:{port}")
                break
            except TrackingUnavailable:
                time.sleep(0.2)
        yield server
    finally:
        subprocess.run(["kill", "-9", "--", f"-{server.pid}"], check=False, stderr=subprocess.DEVNULL)
        server.wait()


def _signal_server_in_mid_run(checkout: Checkout, number: signal.Signals) -> Row:
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    uri = f"http://127.0.0.1:{port}"
    with _mlflow_server(checkout, port) as server:
        start_s = time.monotonic()
        publishing = checkout.start(*checkout.command("publish"), MLFLOW_TRACKING_URI=uri)
        process = checkout.stage("publish")
        checkout.until(lambda: _finished_n(checkout.folder / "team.db") >= 3, process)
        subprocess.run(["kill", f"-{number.value}", "--", f"-{server.pid}"], check=True)
        first = checkout.end(publishing, start_s)
    written_n = _finished_n(checkout.folder / "team.db")
    with _mlflow_server(checkout, port):
        row = _report(checkout, first, checkout.run("reskin", "publish", MLFLOW_TRACKING_URI=uri))
    row.next_run += f", {written_n} runs were in the store before"
    return row


def _finished_n(store: Path) -> int:
    try:
        with closing(sqlite3.connect(f"file:{store}?mode=ro", uri=True, timeout=1)) as reading:
            return int(reading.execute("select count(*) from runs where status = 'FINISHED'").fetchone()[0])
    except sqlite3.Error:
        return 0


@fault(
    "tracking server dies in mid-run",
    "SIGKILL to `mlflow server` once 3 runs are written; it is started again for the next run",
)
def dies(checkout: Checkout) -> Row:
    return _signal_server_in_mid_run(checkout, signal.SIGKILL)


@fault(
    "tracking server stops answering in mid-run",
    "SIGSTOP to `mlflow server` once 3 runs are written",
)
def stops(checkout: Checkout) -> Row:
    return _signal_server_in_mid_run(checkout, signal.SIGSTOP)


@fault(
    "MLflow's SQLite held by another program",
    "BEGIN EXCLUSIVE on `mlflow.db` during the whole run",
)
def locked(checkout: Checkout) -> Row:
    with closing(sqlite3.connect(checkout.folder / "mlflow.db")) as other:
        other.execute("BEGIN EXCLUSIVE")
        return _report(checkout, checkout.run(*checkout.command("publish")), None)


@fault(
    "MLflow's SQLite held in mid-run",
    "BEGIN EXCLUSIVE on a new `mlflow.db` once 3 runs are written, until the run has ended",
)
def locked_in_mid_run(checkout: Checkout) -> Row:
    store = checkout.folder / "mlflow.db"
    store.unlink()
    shutil.rmtree(checkout.folder / "mlartifacts")
    start_s = time.monotonic()
    publishing = checkout.start(*checkout.command("publish"))
    checkout.until(lambda: _finished_n(store) >= 3, checkout.stage("publish"))
    with closing(sqlite3.connect(store, timeout=30)) as other:
        other.execute("BEGIN EXCLUSIVE")
        first = checkout.end(publishing, start_s)
    return _report(checkout, first, checkout.run("reskin", "publish"))

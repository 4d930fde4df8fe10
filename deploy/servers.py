"""Servers of a team as context managers: PostgreSQL, MLflow on it, and for tests an S3-compatible store.

The servers are child processes of this process and end with it.
"""

import ctypes
import http.client
import os
import secrets
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from urllib.parse import urlsplit
from urllib.request import urlopen

START_MAX_s = 120.0
STOP_MAX_s = 20.0
LOOPBACK = "127.0.0.1"
DATABASE, OWNER = "mlflow", "mlflow"
DEBIAN = Path("/usr/lib/postgresql")  # Debian and Ubuntu install the server's programs by version, outside the PATH
PR_SET_PDEATHSIG = 1
UNPRIVILEGED = "postgres"  # PostgreSQL refuses to run as root; its package creates this user


class ServerError(RuntimeError):
    """A server cannot be started or has stopped; the message says why."""


def free_port() -> int:
    """Return a free TCP port of the loopback address."""
    with socket.create_server((LOOPBACK, 0)) as server:
        return int(server.getsockname()[1])


@contextmanager
def postgres(folder: Path, port: int) -> Iterator[str]:
    """Run PostgreSQL on loopback, with its files in `folder`; yield the URI of its database."""
    programs = _programs()
    user = UNPRIVILEGED if os.geteuid() == 0 else None
    folder.mkdir(parents=True, exist_ok=True)
    data, password = folder / "data", folder / "password"
    if not password.exists():
        password.touch(mode=0o600)
        password.write_text(secrets.token_urlsafe(16))
    if user:
        for path in (folder, password):
            shutil.chown(path, user)
    if not (data / "PG_VERSION").exists():
        words = ["initdb", "--pgdata", data, "--username", OWNER, "--auth", "scram-sha-256", "--pwfile", password]
        _run([str(programs / words[0]), *map(str, words[1:]), "--encoding", "UTF8"], folder, user)
    words = ["-D", data, "-p", port, "-c", f"listen_addresses={LOOPBACK}", "-c", f"unix_socket_directories={folder}"]
    command = [str(programs / "postgres"), *map(str, words)]
    # SIGINT is a fast shutdown: it disconnects clients and leaves the files consistent.
    with running("PostgreSQL", command, folder / "postgres.log", stop=signal.SIGINT, user=user) as alive:
        at = {"PGPASSWORD": password.read_text()}
        ask = [str(programs / "psql"), "-h", LOOPBACK, "-p", str(port), "-U", OWNER, "-qtA"]

        def answers(*words: str) -> bool:
            done = subprocess.run([*ask, *words], env={**os.environ, **at}, capture_output=True, check=False)
            return done.returncode == 0

        _wait("PostgreSQL", lambda: answers("-d", "postgres", "-c", "select 1"), alive)
        if not answers("-d", DATABASE, "-c", "select 1"):
            assert answers("-d", "postgres", "-c", f"create database {DATABASE}")
        yield f"postgresql+psycopg2://{OWNER}:{at['PGPASSWORD']}@{LOOPBACK}:{port}/{DATABASE}"


@contextmanager
def mlflow(folder: Path, database: str, port: int, *, host: str = LOOPBACK) -> Iterator[str]:
    """Run an MLflow server on a database, artifacts in `folder/artifacts`; yield its address on this machine."""
    folder.mkdir(parents=True, exist_ok=True)
    words = ["-m", "mlflow", "server", "--artifacts-destination", folder / "artifacts", "--host", host, "--port", port]
    names = [name for name in {host, socket.gethostname(), "localhost", LOOPBACK} if name != "0.0.0.0"]
    allowed = ",".join(part for name in sorted(names) for part in (name, f"{name}:*"))  # MLflow refuses other names
    # The database's URI is a variable, because every user could read its password on the command line.
    variables = {"MLFLOW_BACKEND_STORE_URI": database, "MLFLOW_DISABLE_TELEMETRY": "true"}
    variables |= {"MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false"}  # eight processes of 240 MB that nobody uses
    command = [sys.executable, *map(str, words), "--workers", "1", "--allowed-hosts", allowed]
    with running("MLflow", command, folder / "mlflow.log", variables=variables) as alive:
        address = f"http://{LOOPBACK if host == '0.0.0.0' else host}:{port}"
        _wait("MLflow", lambda: responds(f"{address}/health"), alive)
        yield address


@contextmanager
def s3(folder: Path, port: int) -> Iterator[str]:
    """Run moto's server, an S3-compatible store in memory, for tests; yield its address."""
    folder.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-c", "from moto.server import main; main()", "-H", LOOPBACK, "-p", str(port)]
    with running("moto", command, folder / "s3.log") as alive:
        address = f"http://{LOOPBACK}:{port}"
        _wait("moto", lambda: responds(f"{address}/moto-api/"), alive)
        yield address


def responds(url: str) -> bool:
    """Return whether an HTTP server responds with success."""
    try:
        with urlopen(url, timeout=2.0):
            return True
    except (OSError, http.client.HTTPException):
        return False


def listens(address: str) -> bool:
    """Return whether a server accepts connections at an address."""
    at = urlsplit(address)
    try:
        socket.create_connection((at.hostname or "", at.port or 0), timeout=1.0).close()
        return True
    except OSError:
        return False


@contextmanager
def running(
    name: str, command: list[str], log: Path, *, stop: signal.Signals = signal.SIGTERM, user: str | None = None,
    variables: Mapping[str, str] | None = None,
) -> Iterator[Callable[[], None]]:  # fmt: skip
    """Run a program and its children until the block ends; yield a function that raises if it has died."""
    with log.open("ab") as output:
        process = subprocess.Popen(
            command, stdout=output, stderr=output, stdin=subprocess.DEVNULL, start_new_session=True, cwd=log.parent,
            env={**os.environ, **(variables or {})}, user=user, group=user, extra_groups=[] if user else None,
            preexec_fn=partial(_end_with_parent, stop),
        )  # fmt: skip

    def alive() -> None:
        if process.poll() is not None:
            last = " ".join(log.read_text(errors="replace").split())[-400:]
            raise ServerError(f"{name} has stopped (exit status {process.returncode}). {log}: {last}")

    try:
        yield alive
    finally:
        process.send_signal(stop)
        try:
            process.wait(STOP_MAX_s)
        except subprocess.TimeoutExpired:
            pass
        _kill_group(process)


def _end_with_parent(stop: signal.Signals) -> None:
    """Make a server end with its parent process, even if the parent is killed (Linux)."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, int(stop))


def _kill_group(process: subprocess.Popen[bytes]) -> None:
    """Kill the remaining children of a program."""
    try:
        os.killpg(process.pid, signal.SIGKILL)
    except ProcessLookupError:
        pass
    process.wait()


def _wait(name: str, ready: Callable[[], bool], alive: Callable[[], None]) -> None:
    end_s = time.monotonic() + START_MAX_s
    while not ready():
        alive()
        if time.monotonic() > end_s:
            raise ServerError(f"{name} did not answer within {START_MAX_s:g} s. See its log.")
        time.sleep(0.1)


def _programs() -> Path:
    """Return the folder of PostgreSQL's programs."""
    versions = sorted(DEBIAN.glob("*/bin/postgres"), key=lambda file: int(file.parts[-3]))
    found = shutil.which("postgres") or (str(versions[-1]) if versions else None)
    if found is None:
        raise ServerError("PostgreSQL is not installed. Try: apt-get install postgresql")
    return Path(found).resolve().parent


def _run(command: list[str], folder: Path, user: str | None) -> None:
    done = subprocess.run(
        command, cwd=folder, capture_output=True, text=True, user=user, group=user, extra_groups=[] if user else None
    )
    if done.returncode:
        raise ServerError(f"{Path(command[0]).name} failed: {' '.join(done.stderr.split())[-400:]}")

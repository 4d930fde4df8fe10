"""Servers of a team, each until its block ends: PostgreSQL, MLflow on it, and for tests an S3-compatible store.

In: folders and ports. Out: addresses that answer. Programs are children of this process and end with it. Refuses to
know what is kept there.
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
DEBIAN = Path("/usr/lib/postgresql")  # Debian and Ubuntu keep programs of the server by version, and not on the PATH
PR_SET_PDEATHSIG = 1
UNPRIVILEGED = "postgres"  # PostgreSQL refuses to run as root; its package makes this user


class ServerError(RuntimeError):
    """A server that cannot be started; the message says why."""


def free_port() -> int:
    """Find a TCP port of the loopback address that nobody uses."""
    with socket.create_server((LOOPBACK, 0)) as server:
        return int(server.getsockname()[1])


@contextmanager
def postgres(folder: Path, port: int) -> Iterator[str]:
    """Run PostgreSQL on its files in `folder`, made at the first start, on loopback; give the URI of its database."""
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
    # SIGINT: the clients' sessions are cut, the files are left whole.
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
    """Run an MLflow server on a database, artifacts in `folder/artifacts`; give its address on this machine."""
    folder.mkdir(parents=True, exist_ok=True)
    words = ["-m", "mlflow", "server", "--artifacts-destination", folder / "artifacts", "--host", host, "--port", port]
    names = [name for name in {host, socket.gethostname(), "localhost", LOOPBACK} if name != "0.0.0.0"]
    allowed = ",".join(part for name in sorted(names) for part in (name, f"{name}:*"))  # MLflow refuses other names
    # By variable: a password on the command line is everybody's to read.
    variables = {"MLFLOW_BACKEND_STORE_URI": database, "MLFLOW_DISABLE_TELEMETRY": "true"}
    variables |= {"MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false"}  # eight processes of 240 MB that we have no use for
    command = [sys.executable, *map(str, words), "--workers", "1", "--allowed-hosts", allowed]
    with running("MLflow", command, folder / "mlflow.log", variables=variables) as alive:
        address = f"http://{LOOPBACK if host == '0.0.0.0' else host}:{port}"
        _wait("MLflow", lambda: responds(f"{address}/health"), alive)
        yield address


@contextmanager
def s3(folder: Path, port: int) -> Iterator[str]:
    """Run moto's server, which speaks S3 and keeps all in memory: for tests; give its address."""
    folder.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-c", "from moto.server import main; main()", "-H", LOOPBACK, "-p", str(port)]
    with running("moto", command, folder / "s3.log") as alive:
        address = f"http://{LOOPBACK}:{port}"
        _wait("moto", lambda: responds(f"{address}/moto-api/"), alive)
        yield address


def responds(url: str) -> bool:
    """Whether an HTTP server answers with success."""
    try:
        with urlopen(url, timeout=2.0):
            return True
    except (OSError, http.client.HTTPException):
        return False


def listens(address: str) -> bool:
    """Whether anything accepts connections at an address."""
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
    """Run a program and its children until the block ends, however it ends; give what raises if it has died."""
    with log.open("ab") as said:
        process = subprocess.Popen(
            command, stdout=said, stderr=said, stdin=subprocess.DEVNULL, start_new_session=True, cwd=log.parent,
            env={**os.environ, **(variables or {})}, user=user, group=user, extra_groups=[] if user else None,
            preexec_fn=partial(_end_with_parent, stop),
        )  # fmt: skip

    def alive() -> None:
        if process.poll() is not None:
            last = " ".join(log.read_text(errors="replace").split())[-400:]
            raise ServerError(f"{name}: the server must stay up; got exit status {process.returncode}. {log}: {last}")

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
    """Let a server end with what started it, even if that is killed (Linux)."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, int(stop))


def _kill_group(process: subprocess.Popen[bytes]) -> None:
    """End what is left of a program's children."""
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
            raise ServerError(f"{name}: the server must answer within {START_MAX_s:g} s; got no answer. See its log.")
        time.sleep(0.1)


def _programs() -> Path:
    """Find where PostgreSQL's own programs lie."""
    versions = sorted(DEBIAN.glob("*/bin/postgres"), key=lambda file: int(file.parts[-3]))
    found = shutil.which("postgres") or (str(versions[-1]) if versions else None)
    if found is None:
        raise ServerError("PostgreSQL: the server must be installed; got none. Try: apt-get install postgresql")
    return Path(found).resolve().parent


def _run(command: list[str], folder: Path, user: str | None) -> None:
    done = subprocess.run(
        command, cwd=folder, capture_output=True, text=True, user=user, group=user, extra_groups=[] if user else None
    )
    if done.returncode:
        raise ServerError(f"{Path(command[0]).name}: must end well; got: {' '.join(done.stderr.split())[-400:]}")

"""Whether the tracking server answers within seconds, and how long it may take. Knows nothing of what is written."""

import http.client
import os
import sqlite3
import time
import urllib.error
import urllib.request
from contextlib import closing

from pipeline.core.errors import ReskinError

VARIABLE = "MLFLOW_TRACKING_URI"
TIMEOUT_S = 2.0
SQLITE = "sqlite:///"
LOCK_TIMEOUT_S = 5.0  # a UI that reads, or another publication that writes a run, is done long before
PATIENCE_S, PATIENCE_PER_RUN_S = 60.0, 2.0  # a server of one's own network takes 0.1 s a run


class TrackingAway(ReskinError):
    """The tracking server does not answer; the message says what to do."""

    exit_code = 3


def server_uri() -> str | None:
    """The tracking server that the user named, if any; without one the embedded store is used."""
    return os.environ.get(VARIABLE) or None


class Patience:
    """A limit on all that is written at once: a server that answers too slowly must not hold up a result."""

    def __init__(self, runs_n: int) -> None:
        self.limit_s = PATIENCE_S + PATIENCE_PER_RUN_S * runs_n
        self.until_s = time.monotonic() + self.limit_s

    def check(self) -> None:
        """Raise `TrackingAway` if it is used up."""
        if time.monotonic() > self.until_s:
            raise TrackingAway(
                f"MLflow took longer than {self.limit_s:.0f} s. Results are kept; `reskin publish` goes on from there."
            )


def probe(uri: str | None) -> None:
    """Raise `TrackingAway` if a server (http, https) does not answer within two seconds, or a SQLite file is held."""
    if uri is not None and uri.startswith(SQLITE):
        _probe_sqlite(uri.removeprefix(SQLITE))
    if uri is None or not uri.startswith(("http://", "https://")):
        return
    try:
        with urllib.request.urlopen(f"{uri.rstrip('/')}/health", timeout=TIMEOUT_S):
            return
    except (urllib.error.URLError, http.client.HTTPException, OSError, ValueError) as error:
        reason = getattr(error, "reason", error) or type(error).__name__
        raise TrackingAway(
            f"MLflow at {uri} does not answer ({reason}). Results are made all the same; "
            "`reskin publish` sends them when it is back."
        ) from None


def _probe_sqlite(file: str) -> None:
    if not os.path.exists(file):
        return
    try:
        with closing(sqlite3.connect(file, timeout=LOCK_TIMEOUT_S)) as store:
            store.execute("BEGIN IMMEDIATE")
            store.rollback()
    except sqlite3.Error as error:  # MLflow itself would try ten times, for minutes
        raise TrackingAway(
            f"MLflow's store {file} cannot be written ({error}; waited up to {LOCK_TIMEOUT_S:.0f} s). "
            "Results are kept. Does another program hold it? Then `reskin publish` sends them."
        ) from None

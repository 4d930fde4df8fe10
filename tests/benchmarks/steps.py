"""A run in steps, each with its seconds and what was seen: a table in Markdown, printed as it grows."""

import os
import platform
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
HEAD = "| step | seconds | result |\n|---|---|---|\n"


class Steps:
    """Rows of a table: what was done, how long it took, what was seen."""

    def __init__(self) -> None:
        self.rows: list[str] = []
        words = ["git", "rev-parse", "--short=12", "HEAD"]
        self._commit = subprocess.check_output(words, cwd=ROOT, text=True).strip()

    @contextmanager
    def step(self, what: str) -> Iterator[Callable[[str], None]]:
        """Time a block; what it is given is called with what was seen. A step that fails is a row too."""
        seen, start_s = [], time.monotonic()
        try:
            yield seen.append
        except BaseException as error:
            seen.append(f"FAILED: {type(error).__name__}: {' '.join(str(error).split())[:200]}")
            raise
        finally:
            self.rows.append(f"| {what} | {time.monotonic() - start_s:.1f} | {'; '.join(seen)} |")
            print(self.rows[-1], flush=True)

    def write(self, file: Path, title: str) -> None:
        """Write the table, under what made it and where."""
        machine = f"{platform.machine()}, {os.cpu_count()} shared cores, Python {platform.python_version()}"
        file.parent.mkdir(parents=True, exist_ok=True)
        words = f"{title} Commit {self._commit}, {machine}, load {os.getloadavg()[0]:.1f} at the end.\n\n"
        file.write_text(words + HEAD + "\n".join(self.rows) + "\n")


def end_on_signals() -> None:
    """Let SIGTERM end this process as Ctrl-C does, so that what it started ends with it."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))


def require(condition: bool, what: str) -> None:
    """Fail a step where an `assert` could be switched off."""
    if not condition:
        raise AssertionError(what)

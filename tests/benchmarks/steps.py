"""Time the steps of a long run and print a Markdown table, one row per step as soon as it ends."""

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
    """Table of steps: description, seconds and result of each step."""

    def __init__(self) -> None:
        self.rows: list[str] = []
        words = ["git", "rev-parse", "--short=12", "HEAD"]
        self._commit = subprocess.check_output(words, cwd=ROOT, text=True).strip()

    @contextmanager
    def step(self, what: str) -> Iterator[Callable[[str], None]]:
        """Time a block and add a row, even if the block fails. The block passes its results to the yielded function."""
        results, start_s = [], time.monotonic()
        try:
            yield results.append
        except BaseException as error:
            results.append(f"FAILED: {type(error).__name__}: {' '.join(str(error).split())[:200]}")
            raise
        finally:
            self.rows.append(f"| {what} | {time.monotonic() - start_s:.1f} | {'; '.join(results)} |")
            print(self.rows[-1], flush=True)

    def write(self, file: Path, title: str) -> None:
        """Write a line with the title, the commit and the machine, followed by the table."""
        machine = f"{platform.machine()}, {os.cpu_count()} shared cores, Python {platform.python_version()}"
        file.parent.mkdir(parents=True, exist_ok=True)
        words = f"{title} Commit {self._commit}, {machine}, load {os.getloadavg()[0]:.1f} at the end.\n\n"
        file.write_text(words + HEAD + "\n".join(self.rows) + "\n")


def end_on_signals() -> None:
    """Make SIGTERM end this process as Ctrl-C does, so that the code that stops its child processes runs."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))


def require(condition: bool, what: str) -> None:
    """Raise an AssertionError unless the condition is true; unlike `assert`, this also works under `python -O`."""
    if not condition:
        raise AssertionError(what)

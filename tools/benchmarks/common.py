"""What the benchmarks share: times of calls and programs, Markdown tables, and steps."""

import os
import platform
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]


def best_s(call: Callable[[], object], repeats_n: int = 3) -> float:
    """Return the shortest of several run times of a call."""
    times_s = []
    for _ in range(repeats_n):
        start_s = time.perf_counter()
        call()
        times_s.append(time.perf_counter() - start_s)
    return min(times_s)


def run(command: Sequence[str], folder: Path, **environment: str) -> dict[str, float]:
    """Run a program; return CPU and wall seconds, including child processes, and the largest peak memory."""
    start_s = time.monotonic()
    with subprocess.Popen(
        command, cwd=folder, env={**os.environ, **environment}, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
    ) as started:
        assert started.stderr is not None
        output = started.stderr.read()
        _, status, usage = os.wait4(started.pid, 0)
        started.returncode = os.waitstatus_to_exitcode(status)
    if status:
        raise RuntimeError(f"{' '.join(command)} failed:\n{output.decode(errors='replace')[-3000:]}")
    return {
        "wall_s": round(time.monotonic() - start_s, 1), "cpu_s": round(usage.ru_utime + usage.ru_stime, 2),
        "peak_MB": round(usage.ru_maxrss * 1024 / 1e6),
    }  # fmt: skip


def disk_MB(folder: Path) -> float:
    """Return the disk space that the files in a folder use."""
    return round(sum(file.lstat().st_blocks * 512 for file in folder.rglob("*")) / 1e6)


def describe_machine() -> str:
    """Describe this machine with the standard library alone."""
    return f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}"


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Format rows as a Markdown table; missing values become dashes."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    lines = [names, ["---"] * len(names), *([str(row.get(name, "–")) for name in names] for row in rows)]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


class Steps:
    """The steps of a long run, printed as they end: description, seconds and result."""

    @contextmanager
    def step(self, what: str) -> Iterator[Callable[[str], None]]:
        """Time a block and add a row, even if the block fails. The block passes its results to the yielded function."""
        results: list[str] = []
        start_s = time.monotonic()
        try:
            yield results.append
        except BaseException as error:
            results.append(f"FAILED: {type(error).__name__}: {' '.join(str(error).split())[:200]}")
            raise
        finally:
            print(what, f"{time.monotonic() - start_s:.1f}", "; ".join(results), sep=" | ", flush=True)


def end_on_signals() -> None:
    """Make SIGTERM end this process as Ctrl-C does, so that the code that stops its child processes runs."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))

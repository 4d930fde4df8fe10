"""Time `make repro` for a new user: clone into an empty folder, create the environment, run all stages.

Run `python3 tests/benchmarks/time_repro.py --times 3 --out reports/time.json`. The program clones the last commit and
uses no cache except that of pip. It creates the environment once and runs the stages `--times` times without cached
results: before each run, all untracked files except the environment are removed. It needs only Python and git. Run
nothing else on the machine meanwhile.
"""

import argparse
import json
import os
import platform
import resource
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def run(command: list[str], folder: Path) -> dict[str, float]:
    """Run a command; return its wall and CPU seconds, including all of its child processes."""
    before, start_s = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    # DVC waits for every stage, and make waits for DVC, so RUSAGE_CHILDREN includes make, DVC and all stages.
    subprocess.run(command, cwd=folder, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {"wall_s": round(time.monotonic() - start_s, 1), "cpu_s": round(cpu_s, 1)}


def size_MB(folder: Path) -> float:
    """Return the disk space that the files in a folder use."""
    return round(sum(file.lstat().st_blocks * 512 for file in folder.rglob("*")) / 1e6)


def measure(folder: Path, times: int) -> Iterator[dict[str, object]]:
    """Clone the last commit; return the seconds to create the environment and to run all stages, repeatedly."""
    subprocess.run(["git", "clone", "--quiet", str(ROOT), str(folder)], check=True)
    environment = run(["make", ".venv/.installed"], folder)
    environment_MB = size_MB(folder / ".venv")
    for i in range(times):
        if i:
            subprocess.run(["git", "checkout", "--quiet", "."], cwd=folder, check=True)
            subprocess.run(["git", "clean", "-fdxq", "-e", ".venv", "-e", "*.egg-info"], cwd=folder, check=True)
        stages = run(["make", "repro"], folder)
        yield {
            "environment": environment, "stages": stages, "environment_MB": environment_MB, "all_MB": size_MB(folder),
        }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--times", type=int, default=3)
    parser.add_argument("--out", type=Path, default=ROOT / "reports/time.json")
    parser.add_argument("--keep", type=Path, help="keep the clone in this folder, with the results of the last run")
    arguments = parser.parse_args()
    commit = subprocess.run(
        ["git", "rev-parse", "--short=12", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    runs = []
    folder = arguments.keep or Path(tempfile.mkdtemp()) / "clone"
    try:
        for i, found in enumerate(measure(folder, arguments.times), 1):
            runs.append(found)
            print(f"{i}/{arguments.times}: {found}", flush=True)
    finally:
        if arguments.keep is None:
            shutil.rmtree(folder.parent)
    machine = f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}"
    arguments.out.write_text(
        json.dumps({"git": commit.stdout.strip(), "machine": machine, "runs": runs}, indent=2) + "\n"
    )


if __name__ == "__main__":
    main()

"""Time `make repro` for a new user: clone the last commit into an empty folder, create the environment, run all stages.

No cache is used except that of pip. The environment is created once. Before each further run of the stages, all other
untracked files are removed. Run nothing else on the machine meanwhile.
"""

import argparse
import json
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path

from tools.benchmarks.common import ROOT, describe_machine, disk_MB, run


def measure(folder: Path, times: int) -> Iterator[dict[str, object]]:
    subprocess.run(["git", "clone", "--quiet", str(ROOT), str(folder)], check=True)
    environment = run(["make", ".venv/.installed"], folder)
    environment_MB = disk_MB(folder / ".venv")
    for i in range(times):
        if i:
            subprocess.run(["git", "checkout", "--quiet", "."], cwd=folder, check=True)
            subprocess.run(["git", "clean", "-fdxq", "-e", ".venv", "-e", "*.egg-info"], cwd=folder, check=True)
        stages = run(["make", "repro"], folder)
        yield {
            "environment": environment, "stages": stages, "environment_MB": environment_MB, "all_MB": disk_MB(folder),
        }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--times", type=int, default=3)
    parser.add_argument("--out", type=Path, default=ROOT / "reports/time.json")
    parser.add_argument("--keep", type=Path, help="keep the clone in this folder, with the results of the last run")
    given = parser.parse_args()
    commit = subprocess.check_output(["git", "rev-parse", "--short=12", "HEAD"], cwd=ROOT, text=True).strip()
    folder = given.keep or Path(tempfile.mkdtemp()) / "clone"
    runs = []
    try:
        for found in measure(folder, given.times):
            runs.append(found)
            print(found, flush=True)
    finally:
        if given.keep is None:
            shutil.rmtree(folder.parent)
    given.out.write_text(json.dumps({"git": commit, "machine": describe_machine(), "runs": runs}, indent=2) + "\n")


if __name__ == "__main__":
    main()

"""Time the installation for a new user who has only Python, from an empty environment to the first live page.

The program builds the wheel, creates an empty environment, installs the wheel without extras, and runs `reskin live
--emulate nominal` in an empty folder until the page loads: twice, because Numba compiles in the first run. Packages
come from pip's index or cache.
"""

import argparse
import json
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
import urllib.request
from pathlib import Path

from tools.benchmarks.common import ROOT, disk_MB, run

PAGE_S = 600.0  # time limit for loading the page
PIP = ("-m", "pip", "--quiet", "--disable-pip-version-check")


def page_loads(url: str) -> bool:
    try:
        with urllib.request.urlopen(url, timeout=1.0) as page:
            return b"live.js" in page.read()
    except OSError:
        return False


def seconds_to_page(reskin: Path, folder: Path) -> float:
    """Start `reskin live` on a simulated skin; return the seconds until its page loads."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    command = [str(reskin), "live", "--emulate", "nominal", "--http-port", str(port)]
    start_s = time.monotonic()
    process = subprocess.Popen(command, cwd=folder, env=environment, stdout=subprocess.DEVNULL)
    try:
        while not page_loads(f"http://127.0.0.1:{port}/"):
            if process.poll() is not None or time.monotonic() - start_s > PAGE_S:
                sys.exit(f"{' '.join(command)}: the page did not load within {PAGE_S:g} s")
            time.sleep(0.05)
        return round(time.monotonic() - start_s, 1)
    finally:
        process.terminate()
        process.wait()


def measure(folder: Path, python: str, constraint: Path | None) -> dict[str, object]:
    shutil.copytree(ROOT / "reskin", folder / "source/reskin", ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE", "MANIFEST.in", "CHANGELOG.md", "CITATION.cff"):
        shutil.copy(ROOT / name, folder / "source")
    environment = run([python, "-m", "venv", str(folder / "venv")], folder)
    new_python = str(folder / "venv/bin/python")
    built = run([new_python, *PIP, "wheel", "--no-deps", "--wheel-dir", "dist", "./source"], folder)
    wheel = next((folder / "dist").glob("*.whl"))
    limits = [] if constraint is None else ["--constraint", str(constraint.resolve())]
    installed = run([new_python, *PIP, "install", *limits, str(wheel)], folder)
    packages = json.loads(subprocess.check_output([new_python, "-m", "pip", "list", "--format", "json"]))
    (folder / "empty").mkdir()
    return {
        "venv": environment, "wheel": built, "install": installed, "packages_n": len(packages),
        "wheel_MB": round(wheel.stat().st_size / 1e6, 1), "environment_MB": disk_MB(folder / "venv"),
        "pages_s": [seconds_to_page(folder / "venv/bin/reskin", folder / "empty") for _ in range(2)],
        "load_1min": round(os.getloadavg()[0], 1),
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--python", default=sys.executable)
    parser.add_argument("--constraint", type=Path)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        print(json.dumps(measure(Path(folder), given.python, given.constraint), indent=2))


if __name__ == "__main__":
    main()

"""Time the installation for a new user who has only Python, from an empty environment to the first live page.

Run `python3 tests/benchmarks/time_install.py [--python FILE] [--constraint FILE]`. The program builds the wheel,
creates an empty environment, installs the wheel without extras, and runs `reskin live --emulate nominal` in an empty
folder until the page loads. The last step is timed twice, because Numba compiles in the first run. Seconds and MB are
printed as JSON. Packages come from pip's index or cache.
"""

import argparse
import json
import os
import resource
import shutil
import socket
import subprocess
import sys
import tempfile
import time
import urllib.request
from pathlib import Path

from time_repro import run, size_MB  # a module in the folder of this script

ROOT = Path(__file__).resolve().parents[2]
PAGE_S = 600.0  # time limit for loading the page
PIP = ("-m", "pip", "--quiet", "--disable-pip-version-check")


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def page_loads(url: str) -> bool:
    try:
        with urllib.request.urlopen(url, timeout=1.0) as page:
            return b"live.js" in page.read()
    except OSError:
        return False


def seconds_to_page(reskin: Path, folder: Path) -> dict[str, float]:
    """Start `reskin live` on a simulated skin; return the wall and CPU seconds until its page loads."""
    port, begun_s, before = free_port(), time.monotonic(), resource.getrusage(resource.RUSAGE_CHILDREN)
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    command = [str(reskin), "live", "--emulate", "nominal", "--http-port", str(port)]
    process = subprocess.Popen(command, cwd=folder, env=environment, stdout=subprocess.DEVNULL)
    try:
        while not page_loads(f"http://127.0.0.1:{port}/"):
            if process.poll() is not None or time.monotonic() - begun_s > PAGE_S:
                sys.exit(f"{' '.join(command)}: the page did not load within {PAGE_S:g} s")
            time.sleep(0.05)
        wall_s = time.monotonic() - begun_s
    finally:
        process.terminate()
        process.wait()
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {"wall_s": round(wall_s, 1), "cpu_s": round(cpu_s, 1)}


def measure(folder: Path, python: str, constraint: Path | None) -> dict[str, object]:
    """Build the wheel, install it and open the page, all in an empty folder; return seconds and MB."""
    bytecode = shutil.ignore_patterns("__pycache__")
    shutil.copytree(ROOT / "reskin", folder / "source/reskin", ignore=bytecode)
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
        "python": subprocess.check_output([new_python, "-V"], text=True).split()[1],
        "venv": environment, "wheel": built, "install": installed,
        "wheel_MB": round(wheel.stat().st_size / 1e6, 1), "environment_MB": size_MB(folder / "venv"),
        "packages_n": len(packages), "load_1min": round(os.getloadavg()[0], 1),
        "pages": [seconds_to_page(folder / "venv/bin/reskin", folder / "empty") for _ in range(2)],
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--python", default=sys.executable)
    parser.add_argument("--constraint", type=Path)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        print(json.dumps(measure(Path(folder), arguments.python, arguments.constraint), indent=2))


if __name__ == "__main__":
    main()

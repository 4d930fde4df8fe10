"""Are the committed reports what their code makes? In: scenes, or finished reports. Out: words, and an exit status.

A scene runs again from nothing in a clone of the last commit: no cache of stages or trainings is there. Refuses to know
tolerances (`evaluation.reproduced`), and what a stage does.
"""

import csv
import io as text
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from pipeline.adding import RAW
from pipeline.comparing import read_committed, tell
from pipeline.core import io
from pipeline.core.errors import SchemaError
from pipeline.core.stage import say
from pipeline.evaluation.reproduced import compare
from pipeline.registry import REGISTRY

VERIFIED = ".reskin/verified"  # what the last reruns reported, for a look and for `--against` elsewhere
FOR_PROGRAMS = "scores"  # its cells are numbers; those of the others are for people, and stand in numbers.json
QUIET = {"MLFLOW_DISABLE_TELEMETRY": "true", "DVC_NO_ANALYTICS": "1", "OMP_NUM_THREADS": "1"}  # as the Makefile does
Echo = Callable[[str], None]


def verify(root: Path, names: Sequence[str], against: Path | None, echo: Echo) -> int:
    """Tell of each scene how its rerun, or `against`, compares with the commit; return the exit status."""
    committed = {name: _committed(root, name) for name in names}  # first: hours later is late to find none
    if against is None:
        rerun(root, names)
    worst = 0
    for name in names:
        fresh = root / VERIFIED / name if against is None else _reports_in(against, name)
        old, new = committed[name], {"numbers": io.read_json(fresh / "numbers.json"), "tables": _tables_of(fresh)}
        for part, title in (("numbers", name), ("tables", f"{name}, cells of tables")):
            worst = max(worst, tell(title, "HEAD", partial(compare, old[part], new[part]), echo))
    return worst


def _committed(root: Path, name: str) -> dict[str, Any]:
    """Read what the last commit holds of a scene's reports."""
    numbers, folder = read_committed(root, name, "HEAD"), f"./reports/{name}/tables"
    listed = _git(root, "ls-tree", "-r", "--name-only", "HEAD", f"{folder}/").splitlines()
    tables = {Path(file).stem: _git(root, "show", f"HEAD:./{file}") for file in listed if file.endswith(".csv")}
    return {"numbers": numbers, "tables": {stem: _cells(stem, words) for stem, words in tables.items()}}


def _reports_in(folder: Path, name: str) -> Path:
    """Find a scene's finished reports in a folder: `reports/<scene>` itself, or what is around it."""
    found = [
        place for place in (folder, folder / name, folder / "reports" / name) if (place / "numbers.json").is_file()
    ]
    if not found:
        raise SchemaError(folder, "the folder", f"one that holds {name}/numbers.json", "none", f"Name reports/{name}.")
    return found[0]


def _tables_of(folder: Path) -> dict[str, Any]:
    files = sorted((folder / "tables").glob("*.csv"))
    return {file.stem: _cells(file.stem, file.read_text(encoding="utf-8")) for file in files}


def _cells(stem: str, words: str) -> list[dict[str, Any]]:
    """Read a table's rows; numbers stay texts but in what is for programs, as `compare` looks past numbers in texts."""
    rows = list(csv.DictReader(text.StringIO(words)))
    return [{key: _number(cell) for key, cell in row.items()} for row in rows] if stem == FOR_PROGRAMS else rows


def _number(cell: str) -> int | float | str:
    for kind in (int, float):
        try:
            return kind(cell)
        except ValueError:
            continue
    return cell


def rerun(root: Path, names: Sequence[str]) -> None:
    """Run scenes in a clone of the last commit, and keep what they report."""
    if changed := _git(root, "status", "--porcelain", "--untracked-files=no"):
        say(f"warning: {len(changed.splitlines())} files differ from the last commit, which is what runs")
    with tempfile.TemporaryDirectory(prefix="reskin-verify-", ignore_cleanup_errors=True) as temporary:
        clone = Path(temporary) / "clone"
        _git(root, "clone", "--quiet", ".", str(clone))
        (clone / ".venv").symlink_to(sys.prefix)  # where run.sh looks first
        _bring_recordings(root, clone, names)
        environment = {**QUIET, **os.environ, "PYTHONPATH": str(clone)}
        _run(clone, environment, "pipeline.cli", "scenes", "use", *names, quiet=True)
        for name in names:
            shutil.rmtree(clone / "reports" / name, ignore_errors=True)  # what does not run cannot pass
        # Forced: no cache of this machine stands in for a stage. What only tells others of results is left out.
        _run(clone, environment, "dvc", "repro", "--quiet", "--force", *(f"report@{name}" for name in names))
        for name in names:
            with io.replacing(root / VERIFIED / name) as folder:
                shutil.copytree(clone / "reports" / name, folder)


def _bring_recordings(root: Path, clone: Path, names: Sequence[str]) -> None:
    """Copy the recordings of these scenes, which git does not hold."""
    shutil.copy(root / REGISTRY, clone / REGISTRY)
    for name in names:
        if (root / RAW / name).is_dir() and any((root / RAW / name).glob("*.dvc")):
            shutil.copytree(root / RAW / name, clone / RAW / name, dirs_exist_ok=True)


def _run(clone: Path, environment: Mapping[str, str], *words: str, quiet: bool = False) -> None:
    to = subprocess.DEVNULL if quiet else None
    command = [sys.executable, "-m", *words]
    with subprocess.Popen(command, cwd=clone, env=environment, stdout=to, process_group=0) as running:
        try:
            running.wait()
        except BaseException:
            os.killpg(running.pid, signal.SIGTERM)  # DVC's stages too: they would go on in a folder that is no more
            raise
    if running.returncode:
        remedy = "See above: it fails in a clean copy of the last commit."
        raise SchemaError(" ".join(words), "the rerun", "one that ends", f"exit status {running.returncode}", remedy)


def _git(root: Path, *words: str) -> str:
    done = subprocess.run(["git", *words], cwd=root, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SchemaError(
            f"git {words[0]}", "the checkout", "one of git", done.stderr.strip()[-300:], "Clone the project."
        )
    return done.stdout

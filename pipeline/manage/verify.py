"""Command `reskin verify`: run scenes again in a clone of the last commit, and compare their numbers.

No cached results are used.
"""

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from pipeline.manage.registry import RAW, REGISTRY
from pipeline.scenes import scene_file
from pipeline.stage import say
from pipeline.tracking import PUBLISH
from reskin import io
from reskin.errors import SchemaError

VERIFIED = ".reskin/verified"  # reports of the last reruns, for inspection
QUIET = {
    "MLFLOW_DISABLE_TELEMETRY": "true",
    "DVC_NO_ANALYTICS": "1",
    "OMP_NUM_THREADS": "1",
}  # the Makefile sets the same variables


def verify(root: Path, names: Sequence[str], echo: Callable[[str], None]) -> int:
    """Run scenes again, and compare numbers.json with the last commit; return exit status 1 if any value differs."""
    for name in names:
        scene_file(root, name)
    # Committed numbers are read first, so that a missing file is found before the rerun, which takes hours.
    committed = {name: json.loads(_git(root, "show", f"HEAD:./reports/{name}/numbers.json")) for name in names}
    rerun(root, names)
    status = 0
    for name in names:
        old, new = flatten(committed[name]), flatten(io.read_json(root / VERIFIED / name / "numbers.json"))
        differing = [key for key in {**old, **new} if old.get(key) != new.get(key)]
        for key in differing:
            echo(f"{name}: {key}: committed {old.get(key, 'missing')}, now {new.get(key, 'missing')}")
        echo(f"{name}: {len(differing)} of {len({**old, **new})} values differ from those of the last commit")
        status |= bool(differing)
    return status


def flatten(value: Any, name: str = "") -> dict[str, str]:
    """Return each number, boolean and text of a nested value as JSON, by its name.

    >>> flatten({"table2": {"mean": 80.0}, "boards": ["b0"]})
    {'table2.mean': '80.0', 'boards[0]': '"b0"'}
    """
    if isinstance(value, Mapping):
        parts = {f"{name}.{key}" if name else str(key): part for key, part in value.items()}
    elif isinstance(value, list):
        parts = {f"{name}[{i}]": part for i, part in enumerate(value)}
    else:
        return {name: json.dumps(value)}
    return {key: leaf for part_name, part in parts.items() for key, leaf in flatten(part, part_name).items()}


def rerun(root: Path, names: Sequence[str]) -> None:
    """Run scenes in a clone of the last commit, and keep the new reports."""
    if changed := _git(root, "status", "--porcelain", "--untracked-files=no"):
        say(
            f"warning: {len(changed.splitlines())} files differ from the last commit. The files of the last commit are "
            "used, without these changes."
        )
    with tempfile.TemporaryDirectory(prefix="reskin-verify-", ignore_cleanup_errors=True) as temporary:
        clone = Path(temporary) / "clone"
        _git(root, "clone", "--quiet", ".", str(clone))
        _bring_recordings(root, clone, names)
        path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"  # for stages, which call `python`
        environment = {**QUIET, **os.environ, PUBLISH: "0", "PYTHONPATH": str(clone), "PATH": path}
        _run(clone, environment, "pipeline", "scenes", "use", *names, quiet=True)
        for name in names:
            _clear(clone / "reports" / name)  # otherwise committed reports could be mistaken for new ones
        # --force: every stage runs, even if this machine's cache contains its outputs.
        _run(clone, environment, "dvc", "repro", "--quiet", "--force", *(f"report@{name}" for name in names))
        for name in names:
            with io.replacing(root / VERIFIED / name) as folder:
                shutil.copytree(clone / "reports" / name, folder)


def _clear(reports: Path) -> None:
    """Remove the reports of a scene, except choice.json, which audits of other scenes read."""
    for path in reports.glob("*"):
        if path.is_dir():
            shutil.rmtree(path)
        elif path.name != "choice.json":
            path.unlink()


def _bring_recordings(root: Path, clone: Path, names: Sequence[str]) -> None:
    """Copy the recordings of these scenes, because git does not contain them."""
    shutil.copy(root / REGISTRY, clone / REGISTRY)
    for name in names:
        if (root / RAW / name).is_dir() and any((root / RAW / name).glob("*.dvc")):
            shutil.copytree(root / RAW / name, clone / RAW / name, dirs_exist_ok=True)


def _run(clone: Path, environment: Mapping[str, str], *arguments: str, quiet: bool = False) -> None:
    stdout = subprocess.DEVNULL if quiet else None
    command = [sys.executable, "-m", *arguments]
    with subprocess.Popen(command, cwd=clone, env=environment, stdout=stdout, process_group=0) as process:
        try:
            process.wait()
        except BaseException:
            os.killpg(process.pid, signal.SIGTERM)  # also ends DVC's stages, which would continue in a deleted folder
            raise
    if process.returncode:
        raise SchemaError(
            f"`{' '.join(arguments)}` failed in a clone of the last commit (exit status {process.returncode}). The "
            "messages above say why."
        )


def _git(root: Path, *arguments: str) -> str:
    completed = subprocess.run(["git", *arguments], cwd=root, capture_output=True, text=True, check=False)
    if completed.returncode:
        raise SchemaError(f"git {arguments[0]} failed: {completed.stderr.strip()[-300:]}")
    return completed.stdout

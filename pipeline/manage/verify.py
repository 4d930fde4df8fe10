"""Command `reskin verify-reports`: run scenes again in a clone of the last commit, and compare their reports.

No cached results are used.
"""

import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

from pipeline.manage.add import RAW
from pipeline.manage.compare import Echo, print_comparison, read_folder, read_revision
from pipeline.manage.registry import REGISTRY
from pipeline.scenes import scene_file
from pipeline.stage import say
from pipeline.tracking import PUBLISH
from reskin import io
from reskin.errors import SchemaError

VERIFIED = ".reskin/verified"  # reports of the last reruns, for inspection and for `--against` on another machine
QUIET = {
    "MLFLOW_DISABLE_TELEMETRY": "true",
    "DVC_NO_ANALYTICS": "1",
    "OMP_NUM_THREADS": "1",
}  # the Makefile sets the same variables


def verify(root: Path, names: Sequence[str], against: Path | None, echo: Echo) -> int:
    """Compare new reports of scenes with the reports in the last commit; return the exit status.

    The new reports are those in folder `against` or, if this is None, the reports of a rerun.
    """
    for name in names:
        scene_file(root, name)
    # Committed reports are read first, so that errors in them are found before the rerun, which takes hours.
    committed = {name: read_revision(root, name, "HEAD") for name in names}
    if against is None:
        rerun(root, names)
    fresh = {name: read_folder(against or root / VERIFIED / name, name) for name in names}
    return max(print_comparison(name, committed[name], fresh[name], echo) for name in names)


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

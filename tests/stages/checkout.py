"""A copy of this checkout to run whole stories in: code and configuration, no data, no git, this environment."""

import os
import shutil
import subprocess
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
LEFT_OUT = {".git", ".venv", ".reskin", "data", "reports", "mlflow.db", "mlartifacts", ".ci"}
WARM = ("python", "tests/stages/warm.py")  # all stages, without the imports of each
ENVIRONMENT = {
    "OMP_NUM_THREADS": "1", "MLFLOW_DISABLE_TELEMETRY": "true", "DVC_NO_ANALYTICS": "1",
    "RESKIN_EXECUTOR": "here",  # a worker spends longer on its imports than on such trainings
    "PYTHONDONTWRITEBYTECODE": "",  # stages start a hundred times: what Python compiled is kept, wherever they run
}  # fmt: skip


def copy_checkout(folder: Path) -> Path:
    """Copy what a story needs, compiled code too; DVC works without git there."""
    for path in ROOT.iterdir():
        if path.name in LEFT_OUT or path.name.endswith(".egg-info"):
            continue
        if path.is_dir():
            shutil.copytree(path, folder / path.name, ignore=shutil.ignore_patterns("cache", "tmp"))
        else:
            shutil.copy(path, folder)
    (folder / "dvc.lock").unlink(missing_ok=True)
    (folder / "reports/tuning").mkdir(parents=True)
    shutil.copy(ROOT / "reports/tuning/choice.json", folder / "reports/tuning")  # the audit compares recipes with it
    (folder / "data").mkdir()
    (folder / "data/captures.yaml").write_text("captures: {}\n")
    (folder / ".venv").symlink_to(ROOT / ".venv")
    config = folder / ".dvc/config"
    config.write_text(config.read_text().replace("[core]", "[core]\n    no_scm = true"))
    return folder


def run(folder: Path, *words: str, check: bool = True, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run a program of the environment in the copy; its own code is the copy's."""
    program = str(folder / ".venv/bin" / words[0])
    variables = {**os.environ, **ENVIRONMENT, "PYTHONPATH": str(folder), **environment}
    variables.pop("MLFLOW_TRACKING_URI", None) if "MLFLOW_TRACKING_URI" not in environment else None
    done = subprocess.run([program, *words[1:]], cwd=folder, capture_output=True, text=True, env=variables, check=False)
    if check and done.returncode:
        raise AssertionError(f"{' '.join(words)} failed:\n{done.stdout[-3000:]}\n{done.stderr[-3000:]}")
    return done

"""A copy of this checkout to run whole stories in: code and configuration, no data, no git, this environment."""

import compileall
import os
import shutil
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
LEFT_OUT = {".git", ".venv", ".reskin", "data", "reports", "mlflow.db", "mlartifacts", ".ci"} | {
    ".mypy_cache", ".ruff_cache", ".import_linter_cache", ".pytest_cache", ".hypothesis",
}  # fmt: skip
OF_TESTS = ("*.opt-jaxtyping*.pyc", "*-pytest-*.pyc")  # compiled for this process, which no stage reads
ENVIRONMENT = {
    "OMP_NUM_THREADS": "1", "MLFLOW_DISABLE_TELEMETRY": "true", "DVC_NO_ANALYTICS": "1",
    "RESKIN_EXECUTOR": "here",  # a worker spends longer on its imports than on such trainings
    "PYTHONDONTWRITEBYTECODE": "",  # stages start a hundred times: what Python compiled is kept, wherever they run
}  # fmt: skip


DONE, FAILED = "these stages ended", "these stages did not end"  # warm.py says


@cache
def compile_modules() -> None:
    """Compile the project for the programs of all copies; what pytest compiles, only pytest reads."""
    for package in ("pipeline", "reskin"):
        compileall.compile_dir(ROOT / package, quiet=1)


def copy_checkout(folder: Path) -> Path:
    """Copy what a story needs, compiled code too; DVC works without git there."""
    compile_modules()
    folder.mkdir(parents=True, exist_ok=True)
    for path in ROOT.iterdir():
        if path.name in LEFT_OUT or path.name.endswith(".egg-info"):
            continue
        if path.is_dir():
            shutil.copytree(path, folder / path.name, ignore=shutil.ignore_patterns("cache", "tmp", *OF_TESTS))
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


def variables(folder: Path, **environment: str) -> dict[str, str]:
    """Give the environment of programs that run in the copy: its own code is the copy's, and its diary its own."""
    taken = {name: value for name, value in os.environ.items() if name != "MLFLOW_TRACKING_URI"}
    path = f"{folder / '.venv/bin'}{os.pathsep}{taken['PATH']}"  # stages run `python`
    return {**taken, **ENVIRONMENT, "PYTHONPATH": str(folder), "PATH": path, **environment}


@contextmanager
def warm_stages(folder: Path) -> Iterator[Callable[..., str]]:
    """Give what runs stages, all or those of these names, and says what they say; they share a process that is warm."""
    words = [str(folder / ".venv/bin/python"), "tests/stages/warm.py"]
    to, of = subprocess.PIPE, variables(folder)
    with subprocess.Popen(words, cwd=folder, stdin=to, stdout=to, stderr=subprocess.STDOUT, text=True, env=of) as warm:

        def run_stages(*names: str, end: bool = True) -> str:
            print(*names, file=warm.stdin, flush=True)
            said = []
            for line in warm.stdout:
                if line.strip() in (DONE, FAILED):
                    break
                said.append(line)
            if line.strip() != (DONE if end else FAILED):
                raise AssertionError(f"{names or 'stages'} must {'' if end else 'not '}end:\n{''.join(said)[-3000:]}")
            return "".join(said)

        yield run_stages
        warm.stdin.close()


def run(folder: Path, *words: str, check: bool = True, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run a program of the environment in the copy."""
    words = (str(folder / ".venv/bin" / words[0]), *words[1:])
    of = variables(folder, **environment)
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True, env=of, check=False)
    if check and done.returncode:
        raise AssertionError(f"{' '.join(words)} failed:\n{done.stdout[-3000:]}\n{done.stderr[-3000:]}")
    return done

"""Copies of this checkout in which tests run stages: with code, configuration and environment, without data and git."""

import compileall
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PROGRAMS = Path(sys.prefix) / "bin"  # the programs of the environment that runs the tests
NOT_COPIED = {".git", ".venv", ".reskin", "data", "reports", "mlflow.db", "mlartifacts", "mlruns", ".ci"} | {
    ".mypy_cache", ".ruff_cache", ".import_linter_cache", ".pytest_cache", ".hypothesis",
}  # fmt: skip
TEST_BYTECODE = ("*.opt-jaxtyping*.pyc", "*-pytest-*.pyc")  # bytecode of the tests, which stages do not read
ENVIRONMENT = {
    "OMP_NUM_THREADS": "1", "MLFLOW_DISABLE_TELEMETRY": "true", "DVC_NO_ANALYTICS": "1",
    "RESKIN_EXECUTOR": "here",  # no worker processes: starting them would take longer than these training runs
    "PYTHONDONTWRITEBYTECODE": "",  # write bytecode, because about a hundred processes import the code
}  # fmt: skip

DONE, FAILED = "all stages have succeeded", "a stage has failed"  # lines that warm.py prints


@cache
def compile_modules() -> None:
    """Compile all modules once for all copies, because stages cannot use the bytecode that pytest writes."""
    for package in ("pipeline", "reskin"):
        compileall.compile_dir(ROOT / package, quiet=1)


def copy_checkout(folder: Path) -> Path:
    """Copy the code and configuration of this checkout to a folder, in which DVC works without git."""
    compile_modules()
    folder.mkdir(parents=True, exist_ok=True)
    for path in ROOT.iterdir():
        if path.name in NOT_COPIED or path.name.endswith(".egg-info") or path.name.startswith(".venv-"):
            continue
        if path.is_dir():
            shutil.copytree(path, folder / path.name, ignore=shutil.ignore_patterns("cache", "tmp", *TEST_BYTECODE))
        else:
            shutil.copy(path, folder)
    (folder / "dvc.lock").unlink(missing_ok=True)
    (folder / "reports/tuning").mkdir(parents=True)
    # stage audit compares the recipes with those in this file
    shutil.copy(ROOT / "reports/tuning/choice.json", folder / "reports/tuning")
    (folder / "data").mkdir()
    (folder / "data/captures.yaml").write_text("captures: {}\n")
    config = folder / ".dvc/config"
    config.write_text(config.read_text().replace("[core]", "[core]\n    no_scm = true"))
    return folder


def copy_without_code(checkout: Path, folder: Path) -> Path:
    """Copy a checkout of `copy_checkout`, for tests that run no programs in it: most of its files are code."""
    ignore = shutil.ignore_patterns("*.py", "__pycache__", "tests", "docs", "page")
    return shutil.copytree(checkout, folder, symlinks=True, ignore=ignore)


def variables(folder: Path, **environment: str) -> dict[str, str]:
    """Return environment variables with which programs use the code and the MLflow store of the copy."""
    inherited = {name: value for name, value in os.environ.items() if name != "MLFLOW_TRACKING_URI"}
    # `python` in the commands of stages is then the Python that runs the tests.
    path = f"{PROGRAMS}{os.pathsep}{inherited['PATH']}"
    return {**inherited, **ENVIRONMENT, "PYTHONPATH": str(folder), "PATH": path, **environment}


@contextmanager
def warm_stages(folder: Path) -> Iterator[Callable[..., str]]:
    """Yield a function that runs stages (default: all) in forks of a preloaded process and returns the output."""
    command = [sys.executable, "tests/stages/warm.py"]
    with subprocess.Popen(
        command, cwd=folder, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        env=variables(folder),
    ) as warm:  # fmt: skip

        def run_stages(*names: str, succeed: bool = True) -> str:
            print(*names, file=warm.stdin, flush=True)
            output = []
            for line in warm.stdout:
                if line.strip() in (DONE, FAILED):
                    break
                output.append(line)
            if line.strip() != (DONE if succeed else FAILED):
                raise AssertionError(
                    f"stages {names or '(all)'} must {'succeed' if succeed else 'fail'}:\n{''.join(output)[-3000:]}"
                )
            return "".join(output)

        yield run_stages
        warm.stdin.close()


def run(folder: Path, *arguments: str, check: bool = True, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run a program of the virtual environment in the copy; return its output."""
    arguments = (str(PROGRAMS / arguments[0]), *arguments[1:])
    env = variables(folder, **environment)
    done = subprocess.run(arguments, cwd=folder, capture_output=True, text=True, env=env, check=False)
    if check and done.returncode:
        raise AssertionError(f"{' '.join(arguments)} failed:\n{done.stdout[-3000:]}\n{done.stderr[-3000:]}")
    return done

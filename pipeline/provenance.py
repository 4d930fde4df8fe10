"""Provenance of results: the checkout, the commit of the code, the machine, and the run times of stages."""

import os
import platform
import resource
import subprocess
import sys
from collections.abc import Iterable, Mapping
from importlib.metadata import version
from pathlib import Path

from reskin import io
from reskin.code import ROOT, files_of, normalised
from reskin.numerics import departures

EXPERIMENTS = (".dvc", "tmp", "exps")  # folder of DVC's temporary copies of a checkout, for `dvc exp`
PACKAGES = (ROOT / "pipeline", ROOT / "reskin")
NO_CODE = ("plan.yaml", "scenes")  # settings rather than code, although they are in package `pipeline`
COSTS = Path(".reskin/costs")
SECONDS = Path(".reskin/seconds")  # run times of numerical methods on this machine
COMPUTING = ("numpy", "scipy", "numba", "scikit-learn", "torch", "pandas")
CPUINFO = Path("/proc/cpuinfo")  # exists only on Linux
# Names of instruction sets, by the flag in /proc/cpuinfo.
INSTRUCTIONS = {"avx2": "AVX2", "avx512f": "AVX-512", "amx_tile": "AMX", "asimd": "NEON", "sve": "SVE"}


def home() -> Path:
    """Return the checkout with the caches: the working directory or, in a copy by `dvc exp`, the original checkout."""
    here = Path.cwd()
    originals = [parent for parent in here.parents if here.relative_to(parent).parts[:3] == EXPERIMENTS]
    return originals[-1] if originals else Path()


def is_experiment() -> bool:
    """Return whether the working directory is a copy of a checkout that `dvc exp` made."""
    return home() != Path()


def code_version() -> str:
    """Return the last commit that changed the two packages; `unknown` outside git.

    `+dirty` is appended if the packages have uncommitted changes. The newest commit (HEAD) is not used, because it may
    contain only results. Equal results would then seem to come from different code.
    """
    code_paths = (*map(str, PACKAGES), *(f":(exclude){PACKAGES[0] / name}" for name in NO_CODE))
    commit = _git("log", "-1", "--format=%h", "--abbrev=12", "--", *code_paths)
    if not commit:
        return "unknown"
    return commit + ("+dirty" if _git("status", "--porcelain", "--", *code_paths) else "")


def code_version_of(modules: Iterable[str]) -> str:
    """Return the last commit that changed the code of these modules; `unknown` outside git.

    Commits that change only other modules, comments or docstrings do not count. `+dirty` is appended if the code has
    uncommitted changes.
    """
    files = [str(file.relative_to(ROOT)) for name in modules for file in files_of(name)]
    edited = _git("status", "--porcelain", "--", *files) and any(
        _normalised_at("HEAD", file) != normalised(file, (ROOT / file).read_bytes().strip()) for file in files
    )
    for commit in _git("log", "--format=%H", "--", *files).splitlines():
        arguments = ("diff-tree", "--root", "--no-commit-id", "--name-only", "--relative", "-r", commit)
        names = _git(*arguments, "--", *files).splitlines()
        if any(_normalised_at(f"{commit}^", name) != _normalised_at(commit, name) for name in names):
            return commit[:12] + ("+dirty" if edited else "")
    return "unknown"


def _normalised_at(commit: str, file: str) -> bytes:
    return normalised(file, _git("show", f"{commit}:./{file}").encode())


def machine() -> str:
    """Describe the machine: processor and instruction sets, cores that this process may use, Python."""
    cores_n = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    cpuinfo = CPUINFO.read_text(encoding="utf-8", errors="replace") if CPUINFO.exists() else ""
    processor = processor_name(cpuinfo, os.environ, otherwise=platform.processor())
    return f"cpu {platform.machine()} {processor}, {cores_n} cores, Python {platform.python_version()}"


def processor_name(cpuinfo: str, environ: Mapping[str, str], *, otherwise: str) -> str:
    """Return the processor's model, its instruction sets, and the settings that differ from `reskin.numerics`.

    cpuinfo: content of Linux's /proc/cpuinfo. otherwise: the processor's name if `cpuinfo` has no model name.
    """
    lines = [line.partition(":") for line in cpuinfo.splitlines()]
    values = {
        name.strip().lower(): value.strip() for name, _, value in reversed(lines)
    }  # the lines are reversed, so that the values of the first processor are kept
    flags = set(values.get("flags", values.get("features", "")).split())
    model = values.get("model name") or otherwise or "unknown processor"
    plain = " ".join(model.replace("(R)", "").replace("(TM)", "").split())
    instructions = ", ".join(name for flag, name in INSTRUCTIONS.items() if flag in flags)
    details = "; ".join(part for part in (instructions, ", ".join(departures(environ))) if part)
    return f"{plain} ({details})" if details else plain


def versions() -> dict[str, str]:
    """Return the versions of the packages whose arithmetic affects results."""
    return {name: version(name) for name in COMPUTING}


def record_cost(folder: Path, stage: str, seconds: float) -> None:
    """Write the cost of a stage to `folder`, which is not an output of the stage, because equal runs differ in cost.

    A stage that DVC skips or restores keeps the cost of its last run.
    """
    usages = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    unit = 1 if sys.platform == "darwin" else 1024  # ru_maxrss is in bytes on macOS, in KiB elsewhere
    cost = {
        "seconds": round(seconds, 2),
        "cpu_s": round(sum(usage.ru_utime + usage.ru_stime for usage in usages), 2),  # includes the imports
        "peak_process_memory_MB": round(max(usage.ru_maxrss for usage in usages) * unit / 1e6, 1),
    }
    io.write_json(folder / f"{stage}.json", cost)


def read_costs(folder: Path) -> dict[str, dict[str, float]]:
    """Read the costs of the stages that ran here, by stage."""
    return {file.stem: io.read_json(file) for file in sorted(folder.glob("*.json"))}


def _git(*arguments: str) -> str:
    """Run git in the folder of the two packages, and return its output; empty if git fails or is not installed."""
    try:
        completed = subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=False)
    except OSError:
        return ""
    return completed.stdout.strip() if completed.returncode == 0 else ""

"""Provenance of results: the checkout, the commit of the code, the machine, and the run times of stages."""

import os
import platform
import resource
import subprocess
import sys
from collections.abc import Iterable, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

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


def clear_cost(folder: Path, stage: str) -> None:
    """Delete the times of training runs that the last run of a stage recorded."""
    io.remove(_trainings_file(folder, stage))


def record_trainings(folder: Path, stage: str, trained: Mapping[str, tuple[float, bool]], waited_s: float) -> None:
    """Add training runs to the record of the current run of a stage.

    trained: maps the key of a training run to its duration in seconds, and to whether its result is from an earlier
    run. waited_s: how long the stage waited for these training runs.
    """
    recorded = _read_trainings(folder, stage)
    reused = {key for key, (_, was_reused) in trained.items() if was_reused} - set(recorded["computed_s"])
    io.write_json(
        _trainings_file(folder, stage),
        {
            "waited_s": recorded["waited_s"] + waited_s,
            "computed_s": recorded["computed_s"] | {key: seconds for key, (seconds, _) in trained.items()},
            "reused": sorted({*recorded["reused"], *reused}),
        },
    )


def record_cost(folder: Path, stage: str, seconds: float) -> None:
    """Write the cost of a stage to `folder`, which is not an output of the stage, because equal runs differ in cost.

    A stage that DVC skips or restores keeps the cost of its last run.
    """
    usages = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    unit = 1 if sys.platform == "darwin" else 1024  # ru_maxrss is in bytes on macOS, in KiB elsewhere
    trained = _read_trainings(folder, stage)
    computed_s = trained["computed_s"]
    fresh_s = sum(seconds for key, seconds in computed_s.items() if key not in trained["reused"])
    io.write_json(
        folder / f"{stage}.json",
        {
            "seconds": round(seconds, 2),
            # Time of the stage without training runs. If training runs are parallel, the stage waits less than the sum
            # of their times. If it waits longer than the sum, for example for the imports of workers, the excess counts
            # as other time.
            "other_s": round(max(seconds - min(trained["waited_s"], fresh_s), 0.0), 2),
            "trainings_s": computed_s,
            "reused_n": len(trained["reused"]),
            "cpu_s": round(
                sum(usage.ru_utime + usage.ru_stime for usage in usages), 2
            ),  # includes the CPU time of imports
            "peak_process_memory_MB": round(max(usage.ru_maxrss for usage in usages) * unit / 1e6, 1),
        },
    )
    io.remove(_trainings_file(folder, stage))


def read_costs(folder: Path) -> dict[str, dict[str, Any]]:
    """Read the costs of the stages that ran here, by stage; files of an older format are skipped."""
    costs = {file.stem: io.read_json(file) for file in sorted(folder.glob("*.json"))}
    return {stage: cost for stage, cost in costs.items() if "trainings_s" in cost}


def total_cost_s(costs: Iterable[Mapping[str, Any]]) -> float:
    """Return the total cost of stages in seconds; a training run that two stages share counts once.

    Times of training runs are added as if they ran one after another; the elapsed time is shorter if they run in
    parallel.
    """
    stages = list(costs)
    trainings_s = {key: seconds for cost in stages for key, seconds in cost["trainings_s"].items()}
    return float(sum(cost["other_s"] for cost in stages) + sum(trainings_s.values()))


def _trainings_file(folder: Path, stage: str) -> Path:
    return folder / "running" / f"{stage}.json"


def _read_trainings(folder: Path, stage: str) -> dict[str, Any]:
    file = _trainings_file(folder, stage)
    return io.read_json(file) if file.exists() else {"waited_s": 0.0, "computed_s": {}, "reused": []}


def _git(*arguments: str) -> str:
    """Run git in the folder of the two packages, and return its output; empty if git fails or is not installed."""
    try:
        completed = subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=False)
    except OSError:
        return ""
    return completed.stdout.strip() if completed.returncode == 0 else ""

"""Estimate how long the running `dvc repro` still takes: `progress: 23 % after 1.2 min, about 4 min left`.

The costs of all stages come from the provenance.json of each scene's last report. The estimate scales them by the speed
of this run so far. The estimate includes the stages that DVC will probably run, because their settings, code or inputs
differ from dvc.lock, or because an output is missing.

No stage imports this module, so that a change of the module does not make results stale.
"""

import hashlib
import os
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from pipeline.manage.running import dvc_processes
from pipeline.progress import VARIABLE, stages_in_order
from pipeline.provenance import is_experiment
from reskin import io
from reskin.config import read_yaml

STATE = Path(".reskin/run.json")  # the current run: process, start, planned stages and started stages
LOCK = Path("dvc.lock")
CODE, DIGESTS = "code", "data/code"  # the stage that writes digests of modules, and its output
START_S = 1.5  # assumed time that each stage needs in addition, for the start of Python and for DVC's own work
SIDE_BY_SIDE_N = 2  # default number of parallel training runs
# The estimate combines the speed of the run of the last report with the speed of the current run. After this fraction
# of the work, both speeds have the same weight.
TRUSTED = 0.1


def progress() -> str | None:
    """Record that this stage starts; return a sentence on the progress of the run, or None if it is unknown."""
    stage = os.environ.get(VARIABLE, "").rpartition(":")[2]
    if not stage or is_experiment():
        return None
    try:
        processes = dvc_processes(Path())
        if not processes:
            return None
        run = _continue_run(stage, *min(processes.items()))
        io.write_json(STATE, run)
        return _sentence(stage, run, time.time())
    except Exception as error:  # a stage must not fail because the progress is unknown
        return f"the remaining time is unknown ({type(error).__name__} {error})"


def _continue_run(stage: str, process: int, command: str) -> dict[str, Any]:
    """Return the state of the run to which this stage belongs, with this stage as its last one."""
    run = io.read_json(STATE) if STATE.exists() else {}
    if run.get("process") != process or stage in run["started"]:
        run = {"process": process, "start_s": time.time(), "started": []}
    if not run["started"] or run["started"] == [CODE]:  # after stage code, the digests show which stages will run
        order = stages_in_order()
        later = _until_targets(order[order.index(stage) :], command)
        run["seconds"] = expected_seconds(Path(), [*run["started"], *planned(Path(), stage, later)])
    run["started"].append(stage)
    return run


def _until_targets(stages: Sequence[str], command: str) -> list[str]:
    """Return the stages that a command may run, such as `dvc repro report@mine`.

    These are the stages of the target's scene, up to the target.
    """
    targets = {word.rpartition(":")[2] for word in command.split()} & set(stages)
    if not targets:
        return list(stages)
    last = max(stages.index(target) for target in targets)
    items = {target.partition("@")[2] for target in targets}
    return [name for name in stages[: last + 1] if any(_same_scene(name.partition("@")[2], item) for item in items)]


def _same_scene(item: str, other: str) -> bool:
    """Return whether two items, such as `quick` and `quick-wear`, are of one scene; an empty item is of every scene."""
    return not item or not other or item == other or item.startswith(f"{other}-") or other.startswith(f"{item}-")


def _sentence(stage: str, run: Mapping[str, Any], now_s: float) -> str | None:
    seconds: Mapping[str, float] = run["seconds"]
    if None in seconds.values() or stage not in seconds:
        return None
    total_s = sum(seconds.values())
    done_s = sum(seconds.get(name, 0.0) for name in run["started"][:-1])
    left_s, elapsed_s = total_s - done_s, now_s - run["start_s"]
    trusted_s = TRUSTED * total_s
    left_s *= (elapsed_s + trusted_s) / (done_s + trusted_s)
    if not done_s:
        return f"progress: about {_duration(left_s)} left, if this machine is as fast as that of the last report"
    return f"progress: {100 * done_s / total_s:.0f} % after {_duration(elapsed_s)}, about {_duration(left_s)} left"


def _duration(seconds: float) -> str:
    """Write a duration in seconds, minutes or hours, rounded to two digits or fewer.

    >>> [_duration(s) for s in (0.4, 42, 61, 250, 4000, 40000)]
    ['0 s', '40 s', '1.0 min', '4.2 min', '67 min', '11 h']
    """
    if seconds < 55:
        return f"{5 * round(seconds / 5)} s"
    minutes = seconds / 60
    return f"{minutes:.1f} min" if minutes < 9.5 else f"{minutes:.0f} min" if minutes < 120 else f"{minutes / 60:.0f} h"


def planned(root: Path, stage: str, later: Sequence[str]) -> list[str]:
    """Return the stages that DVC will probably run: `stage`, and the stages in `later` that are not up to date.

    A stage that needs an output of another returned stage is included, although DVC skips it if the output does not
    change.
    """
    locked = read_yaml(root / LOCK)["stages"] if (root / LOCK).exists() else {}
    names, changing = [], [DIGESTS] if stage == CODE and not (root / DIGESTS).exists() else []
    for name in later:
        if name == stage or _is_stale(root, name, locked.get(name), changing):
            names.append(name)
            changing += [out["path"] for out in locked.get(name, {}).get("outs", ()) if name != CODE]
    return names


def _is_stale(root: Path, name: str, locked: Mapping[str, Any] | None, changing: Sequence[str]) -> bool:
    if locked is None or not all((root / out["path"]).exists() for out in locked.get("outs", ())):
        return True
    for dependency in locked.get("deps", ()):
        path = dependency["path"]
        if any(_overlap(path, other) for other in changing):
            return True
        if path.startswith(DIGESTS) and hashlib.md5((root / path).read_bytes()).hexdigest() != dependency["md5"]:
            return True
    settings = locked.get("params", {})
    return any(
        _value(read_yaml(root / file), key) != old for file, keys in settings.items() for key, old in keys.items()
    )


def _overlap(path: str, other: str) -> bool:
    return path == other or path.startswith(f"{other}/") or other.startswith(f"{path}/")


def _value(settings: Any, key: str) -> Any:
    """Return the value that DVC finds under a key such as `simulate.boards`; None if there is none."""
    for part in key.split("."):
        settings = settings.get(part) if isinstance(settings, Mapping) else None
    return settings


def expected_seconds(root: Path, stages: Iterable[str]) -> dict[str, float | None]:
    """Return the time that each stage takes if it reuses no training runs, according to the last report of its scene.

    The value of a stage is None if its scene has no report.
    """
    costs = {
        file.parent.name: io.read_json(file).get("runtime", {}).get("stages", {})
        for file in (root / "reports").glob("*/provenance.json")
    }
    return {name: _expected_s(name, costs) for name in stages}


def _expected_s(name: str, costs: Mapping[str, Mapping[str, Any]]) -> float | None:
    stage, _, item = name.partition("@")
    if not item:
        return START_S
    scenes = [scene for scene in costs if item == scene or item.startswith(f"{scene}-")]
    if not scenes:
        return None
    scene = max(scenes, key=len)
    part = item.removeprefix(scene).strip("-")
    cost = costs[scene].get(f"{stage}-{part}" if part else stage)
    if cost is None:  # not in the report: the stage runs later, or takes very little time
        return START_S
    return START_S + _without_reuse_s(cost)


def _without_reuse_s(cost: Mapping[str, Any]) -> float:
    """Return the time that a stage takes if it reuses no training runs.

    The stage's own elapsed time is limited to its processor time, because a busy machine makes the elapsed time longer.
    """
    own_s = min(cost["seconds"], cost["cpu_s"])
    reused = cost["reused_n"] / cost["trainings_n"] if cost["trainings_n"] else 0.0
    return float(own_s + reused * max(cost["computed_s"] - cost["seconds"], 0.0) / SIDE_BY_SIDE_N)


def announce() -> None:
    """Print the progress of the run to standard error, if it is known."""
    if sentence := progress():
        print(sentence, file=sys.stderr, flush=True)

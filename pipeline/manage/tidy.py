"""Find and remove the outputs of experiments that a scene no longer runs.

Only scenes in the plan are considered: other scenes may run again later, and their outputs may have taken hours.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML

from pipeline.manage.running import require_idle
from pipeline.plan import Plan
from pipeline.scenes import scene_names
from reskin import io
from reskin.config import read_yaml

LOCK = "dvc.lock"


def stale_outputs(root: Path, plan: Plan) -> dict[str, list[Path]]:
    """List the stages that ran here but are no longer in the plan, with those outputs that no planned stage writes.

    Stages in dvc.lock without outputs on disk are left out, because they ran only in other clones.
    """
    if not (root / LOCK).exists():
        return {}
    stages: Mapping[str, Any] = read_yaml(root / LOCK).get("stages", {})
    planned = {f"{stage}@{key}" for stage, keys in plan.stages.items() for key in keys}
    kept = {path for name, stage in stages.items() if name in planned for path in _outs(stage)}
    known = scene_names(root)
    return {
        name: [root / path for path in _outs(stage) if not _overlaps(path, kept)]
        for name, stage in stages.items()
        if name not in planned
        and _scene_of(name, known) in plan.scenes
        and any((root / path).exists() for path in _outs(stage))
    }


def tidy(root: Path, plan: Plan) -> dict[str, list[Path]]:
    """Delete stale outputs, and remove their stages from dvc.lock; return the deleted outputs by stage."""
    require_idle(root)
    stale = stale_outputs(root, plan)
    for paths in stale.values():
        for path in paths:
            io.remove(path)
    if stale:
        yaml = YAML()
        document = yaml.load((root / LOCK).read_text(encoding="utf-8"))
        for name in stale:
            del document["stages"][name]
        with io.replacing(root / LOCK) as temporary, temporary.open("w", encoding="utf-8") as stream:
            yaml.dump(document, stream)
    return stale


def _outs(stage: Mapping[str, Any]) -> list[Path]:
    return [Path(out["path"]) for out in stage.get("outs", [])]


def _overlaps(path: Path, others: Iterable[Path]) -> bool:
    """Return whether a path equals, contains or is inside one of the paths in `others`."""
    return any(path.is_relative_to(other) or other.is_relative_to(path) for other in others)


def _scene_of(stage: str, known: Iterable[str]) -> str:
    """Return the scene of `stage@scene` or `stage@scene-part`: the longest scene name that matches."""
    key = stage.partition("@")[2]
    return max((name for name in known if f"{key}-".startswith(f"{name}-")), key=len, default="")

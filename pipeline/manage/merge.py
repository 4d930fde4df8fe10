"""Resolve the git conflicts that arise when branches with different recordings are merged.

Conflicts are resolved in the files that commands write: registry (data/captures.yaml), plan, dvc.lock and reports.
Conflicts in files that people write (params.yaml, scenes, code) must be resolved by hand first.
"""

import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path
from shutil import which
from typing import Any

from pipeline import PLAN, plan
from pipeline.manage.registry import (
    REGISTRY,
    Entry,
    Registry,
    read_registry,
    with_entry,
    without_capture,
    write_registry,
)
from pipeline.plan import read_plan
from reskin import io
from reskin.config import parse
from reskin.errors import ParamsError

LOCK = "dvc.lock"
RESOLVED = (REGISTRY, PLAN, LOCK)
REPORTS = "reports/"  # our version of reports is kept until the next `dvc repro` writes them again
SIDES = (
    "1",
    "2",
    "3",
)  # git's numbers of the three versions of a file in conflict: the common ancestor, ours, and theirs
Versions = tuple[dict[str, Any], dict[str, Any], dict[str, Any]]


def merge(root: Path) -> str:
    """Resolve the conflicts of a merge; return a sentence about what was done and what remains to do."""
    unmerged = _unmerged(root)
    if by_hand := [name for name in unmerged if name not in RESOLVED and not name.startswith(REPORTS)]:
        raise ParamsError(
            f"{', '.join(by_hand)}: resolve the conflicts in these files by hand. Then add the files with `git add`, "
            "and run `reskin merge` again."
        )
    if not unmerged:
        raise ParamsError(
            "No file is in conflict, so there is nothing to resolve. Run git merge BRANCH or git pull first."
        )
    files = [root / name for name in RESOLVED if (root / name).exists()]
    with io.restoring(*files):
        if REGISTRY in unmerged:
            write_registry(root, merge_registries(*_registries(root, unmerged[REGISTRY])))
        plan.use(root, _scenes(root, unmerged.get(PLAN)))  # the plan also depends on captures
        changed_stages = _merge_lock(root, unmerged[LOCK]) if LOCK in unmerged else []
    deleted = {name for name in unmerged if name.startswith(REPORTS) and "2" not in unmerged[name]}
    for name in unmerged:
        if name.startswith(REPORTS):
            command = ["rm", "--quiet"] if name in deleted else ["checkout", "--ours"]
            _git(root, *command, "--", name)
    _git(root, "add", "--all", "--", *(name for name in unmerged if name not in deleted), PLAN)
    changed = f" {len(changed_stages)} stages that both branches ran may run again." if changed_stages else ""
    captures_n = sum(map(len, read_registry(root).captures.values()))
    return (
        f"resolved the conflicts in {', '.join(unmerged)}. The registry has {captures_n} captures.{changed} Now run: "
        "git commit, dvc pull, dvc repro"
    )


def merge_registries(base: Registry, ours: Registry, theirs: Registry) -> Registry:
    """Apply the changes from base to theirs to our registry; raise an error if their captures conflict with ours."""
    merged, before, after = ours, _entries(base), _entries(theirs)
    for (scene, name), entry in before.items():
        if after.get((scene, name)) != entry == _entries(ours).get((scene, name)):
            merged = without_capture(merged, scene, name)
    for (scene, name), entry in after.items():
        if entry not in (before.get((scene, name)), _entries(ours).get((scene, name))):
            merged = with_entry(merged, scene, name, entry, allow_copy=entry.copy_of is not None)
    return merged


def merge_stages(
    base: Mapping[str, Any], ours: Mapping[str, Any], theirs: Mapping[str, Any]
) -> tuple[dict[str, Any], list[str]]:
    """Merge the stages of dvc.lock, taking each entry from the side that changed it.

    If both sides changed an entry, ours is kept. Returns the merged stages, and the names of the entries that both
    sides changed.

    >>> merge_stages({"a": 1, "b": 1}, {"a": 2, "b": 1}, {"a": 3, "b": 3, "c": 3})
    ({'a': 2, 'b': 3, 'c': 3}, ['a'])
    """
    merged = {name: entry for name, entry in ours.items() if name in theirs or entry != base.get(name)}
    both = []
    for name, entry in theirs.items():
        if entry == base.get(name) or entry == ours.get(name):
            continue
        if ours.get(name) == base.get(name):
            merged[name] = entry
        else:
            both.append(name)
    return merged, both


def merge_scenes(base: Sequence[str], ours: Sequence[str], theirs: Sequence[str]) -> list[str]:
    """Return the scenes that run after the merge.

    These are the scenes of our branch, without the scenes that the other branch removed, and with the scenes that it
    added.
    """
    added = [name for name in theirs if name not in ours and name not in base]
    return [name for name in ours if name in theirs or name not in base] + added


def _entries(registry: Registry) -> dict[tuple[str, str], Entry]:
    return {(scene, name): entry for scene, entries in registry.captures.items() for name, entry in entries.items()}


def _registries(root: Path, blobs: Mapping[str, str]) -> tuple[Registry, Registry, Registry]:
    base, ours, theirs = (content or {"captures": {}} for content in _versions(root, blobs))
    return parse(Registry, base, REGISTRY), parse(Registry, ours, REGISTRY), parse(Registry, theirs, REGISTRY)


def _scenes(root: Path, blobs: Mapping[str, str] | None) -> list[str]:
    """Return the scenes of the merged plan, or of the plan on disk if there is no conflict (None)."""
    if blobs is None:
        return list(read_plan(root / PLAN).scenes)
    return merge_scenes(*(list(content.get("scenes", {})) for content in _versions(root, blobs)))


def _merge_lock(root: Path, blobs: Mapping[str, str]) -> list[str]:
    """Merge the versions of dvc.lock; return the names of stages that both sides changed."""
    from dvc.utils.serialize import dumps_yaml  # DVC's own format; imported here, because the import takes a second

    base, ours, theirs = _versions(root, blobs)
    stages, both = merge_stages(*(content.get("stages", {}) for content in (base, ours, theirs)))
    io.write_text(root / LOCK, dumps_yaml({**(ours or theirs), "stages": stages}))
    return both


def _versions(root: Path, blobs: Mapping[str, str]) -> Versions:
    """Read three versions of a YAML file (base, ours, theirs) from git; a missing version is an empty mapping."""
    from dvc.utils.serialize import loads_yaml

    base, ours, theirs = (
        loads_yaml(_git(root, "cat-file", "blob", blobs[side])) if side in blobs else {} for side in SIDES
    )
    return base, ours, theirs


def _unmerged(root: Path) -> dict[str, dict[str, str]]:
    """List the files in conflict: name -> side -> git's blob."""
    unmerged: dict[str, dict[str, str]] = {}
    for line in _git(root, "ls-files", "--unmerged", "-z").split("\0")[:-1]:
        entry, name = line.split("\t", 1)
        _, blob, side = entry.split()
        unmerged.setdefault(name, {})[side] = blob
    return unmerged


def _git(root: Path, *arguments: str) -> str:
    """Run git in the checkout, and return its output."""
    if not which("git"):
        raise ParamsError("reskin merge needs git, which is not installed. Install git.")
    completed = subprocess.run(["git", *arguments], cwd=root, capture_output=True, text=True, check=False)
    if completed.returncode:
        raise ParamsError(f"git {arguments[0]} failed: {' '.join(completed.stderr.split())[-300:]}")
    return completed.stdout

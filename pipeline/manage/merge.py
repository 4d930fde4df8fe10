"""Settles what `git merge` leaves in conflict where two people added recordings: registry, plan, dvc.lock, reports.

In: the three versions of a file that git keeps (their base, ours, theirs). Out: files with the work of both, staged.
Refuses to know what a recording holds, and to settle what people wrote by hand (params.yaml, scenes, code).
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
from pipeline.scenes import read_plan
from reskin import io
from reskin.config import parse
from reskin.errors import ParamsError

LOCK = "dvc.lock"
SETTLED = (REGISTRY, PLAN, LOCK)
REPORTS = "reports/"  # written by stages, so that ours stand until the next `dvc repro`
SIDES = ("1", "2", "3")  # base, ours, theirs, as git numbers them
Versions = tuple[dict[str, Any], dict[str, Any], dict[str, Any]]


def merge(root: Path) -> str:
    """Settle what both sides of a merge changed; say what was done, and what is left to do."""
    unmerged = _unmerged(root)
    if by_hand := [name for name in unmerged if name not in SETTLED and not name.startswith(REPORTS)]:
        remedy = "Mend them, `git add` them, and run this again."
        raise ParamsError("reskin merge", "what people wrote", "merged first", ", ".join(by_hand), remedy)
    if not unmerged:
        remedy = "First: git merge BRANCH, or git pull."
        raise ParamsError("reskin merge", "a merge", "under way, with files in conflict", "none", remedy)
    files = [root / name for name in SETTLED if (root / name).exists()]
    with io.restoring(*files):
        if REGISTRY in unmerged:
            write_registry(root, merge_registries(*_registries(root, unmerged[REGISTRY])))
        plan.use(root, _scenes(root, unmerged.get(PLAN)))  # anew, if only captures changed too
        both = _merge_lock(root, unmerged[LOCK]) if LOCK in unmerged else []
    gone = {name for name in unmerged if name.startswith(REPORTS) and "2" not in unmerged[name]}
    for name in unmerged:
        if name.startswith(REPORTS):
            words = ["rm", "--quiet"] if name in gone else ["checkout", "--ours"]
            _git(root, *words, "--", name)
    _git(root, "add", "--all", "--", *(name for name in unmerged if name not in gone), PLAN)
    changed = f" {len(both)} stages that both sides ran may run again." if both else ""
    captures_n = sum(map(len, read_registry(root).captures.values()))
    return f"settled {', '.join(unmerged)}: {captures_n} captures.{changed} Now: git commit, dvc pull, dvc repro"


def merge_registries(base: Registry, ours: Registry, theirs: Registry) -> Registry:
    """Do to our registry what they did to the base; raise if a capture of theirs cannot stand beside ours."""
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
    """Take each stage's entry of dvc.lock whole, from the side that changed it; if both did, ours, and name it.

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
    """Name the scenes that run: ours, without those that they switched off, and those that they switched on."""
    on = [name for name in theirs if name not in ours and name not in base]
    return [name for name in ours if name in theirs or name not in base] + on


def _entries(registry: Registry) -> dict[tuple[str, str], Entry]:
    return {(scene, name): entry for scene, entries in registry.captures.items() for name, entry in entries.items()}


def _registries(root: Path, blobs: Mapping[str, str]) -> tuple[Registry, Registry, Registry]:
    base, ours, theirs = (words or {"captures": {}} for words in _versions(root, blobs))
    return parse(Registry, base, REGISTRY), parse(Registry, ours, REGISTRY), parse(Registry, theirs, REGISTRY)


def _scenes(root: Path, blobs: Mapping[str, str] | None) -> list[str]:
    if blobs is None:
        return list(read_plan(root / PLAN).scenes)
    return merge_scenes(*(list(words.get("scenes", {})) for words in _versions(root, blobs)))


def _merge_lock(root: Path, blobs: Mapping[str, str]) -> list[str]:
    from dvc.utils.serialize import dumps_yaml  # late: DVC takes a second; so that the file looks as DVC writes it

    base, ours, theirs = _versions(root, blobs)
    stages, both = merge_stages(*(words.get("stages", {}) for words in (base, ours, theirs)))
    io.write_text(root / LOCK, dumps_yaml({**(ours or theirs), "stages": stages}))
    return both


def _versions(root: Path, blobs: Mapping[str, str]) -> Versions:
    """Read the three versions of a YAML file; one that a side does not have is empty."""
    from dvc.utils.serialize import loads_yaml

    base, ours, theirs = (
        loads_yaml(_git(root, "cat-file", "blob", blobs[side])) if side in blobs else {} for side in SIDES
    )
    return base, ours, theirs


def _unmerged(root: Path) -> dict[str, dict[str, str]]:
    """List files in conflict: name -> side -> the blob that git keeps of it."""
    found: dict[str, dict[str, str]] = {}
    for line in _git(root, "ls-files", "--unmerged", "-z").split("\0")[:-1]:
        words, name = line.split("\t", 1)
        _, blob, side = words.split()
        found.setdefault(name, {})[side] = blob
    return found


def _git(root: Path, *words: str) -> str:
    """Run git in the checkout, and give what it prints."""
    if not which("git"):
        raise ParamsError("reskin merge", "git", "installed", "none", "Install it.")
    done = subprocess.run(["git", *words], cwd=root, capture_output=True, text=True, check=False)
    if done.returncode:
        rule, got = "able to do it", " ".join(done.stderr.split())[-300:]
        raise ParamsError(f"git {words[0]}", "git", rule, got, "See above.")
    return done.stdout

"""The registry of recorded captures, `data/captures.yaml`.

For each scene, it lists the names, the layout and the fingerprints of the captures (recorded files) of the scene.
"""

import json
from pathlib import Path

from pipeline import SCENES
from pipeline.scenes import scene_names
from reskin import io
from reskin.config import Strict, parse, read_yaml
from reskin.errors import CaptureError, did_you_mean

REGISTRY = "data/captures.yaml"
RAW = "data/raw"  # folder of the captures, by scene
COMMENT = "# The recorded captures of this checkout, by scene; written by `reskin add` and `reskin remove`."


class Entry(Strict):
    """One recorded capture: its names, and fingerprints that identify copies."""

    board: str
    skin: str
    layout: str
    chips_n: int
    # SHA-256 of the readings and of the recorded byte stream. Two copies of a recording have at least one of them in
    # common.
    fingerprints: tuple[str, ...]
    copy_of: str | None


class Registry(Strict):
    """Content of the registry: the captures of each scene, by name."""

    captures: dict[str, dict[str, Entry]]


def read_registry(root: Path) -> Registry:
    """Read `data/captures.yaml`; raise `CaptureError` if captures contradict each other, for example after a merge."""
    registry = parse(Registry, read_yaml(root / REGISTRY), str(root / REGISTRY))
    for scene, captures in registry.captures.items():
        boards: dict[str, str] = {}
        seen: set[str] = set()
        for name, entry in captures.items():
            what = ""
            if boards.setdefault(entry.skin, entry.board) != entry.board:
                what = f"skin {entry.skin} is on two boards, {boards[entry.skin]} and {entry.board}"
            elif entry.copy_of is None and seen.intersection(entry.fingerprints):
                what = f"capture {name} has the same readings as another capture"
            if what:
                remedy = "Delete the line of the wrong capture, and add its recording again correctly."
                raise CaptureError(f"{root / REGISTRY}: in scene {scene}, {what}. {remedy}")
            seen.update(entry.fingerprints)
    return registry


def unregistered(root: Path) -> list[str]:
    """List the captures on disk, as SCENE/CAPTURE, that are in no list of the registry, for example after a merge."""
    registry, found = read_registry(root), []
    for scene in scene_names(root):
        folder = root / RAW / scene
        if folder.is_dir() and "simulate" not in read_yaml(root / SCENES / f"{scene}.yaml"):
            names = {path.name.removesuffix(".dvc") for path in folder.iterdir() if not path.name.startswith(".")}
            found += [f"{scene}/{name}" for name in sorted(names - registry.captures.get(scene, {}).keys())]
    return found


def with_entry(registry: Registry, scene: str, capture: str, entry: Entry, *, allow_copy: bool) -> Registry:
    """Return the registry with one more capture; raise `CaptureError` if it copies or contradicts another capture."""
    captures, where = registry.captures.get(scene, {}), f"capture {capture}"
    original = next(
        (name for name, other in captures.items() if set(other.fingerprints) & set(entry.fingerprints)), None
    )
    if original is not None:
        _refuse_copy(where, original, captures[original], entry, allow_copy)
    if capture in captures:
        raise CaptureError(
            f"scene {scene} already has a capture with the name {capture}. Choose another name with option --name."
        )
    for name, other in captures.items():
        if other.skin == entry.skin and other.board != entry.board:
            what, rule = f"the board of skin {entry.skin}", f"{other.board}, as in {name}"
            remedy = (
                "If the skin was moved to another board, choose a new name for the skin. Otherwise, networks could be "
                "trained and tested on the same skin."
            )
            raise CaptureError(where, what, rule, entry.board, remedy)
        if other.chips_n != entry.chips_n:
            what = f"it has {entry.chips_n} chips, but {name} in the same scene has {other.chips_n}"
            raise CaptureError(f"{where}: {what}. Add the capture to another scene.")
    added = entry.model_copy(update={"copy_of": original})
    return Registry(captures={**registry.captures, scene: {**captures, capture: added}})


def without_capture(registry: Registry, scene: str, capture: str) -> Registry:
    """Return the registry without a capture, and without the scene if the scene has no other capture."""
    if scene not in registry.captures:
        guess, known = did_you_mean(scene, registry.captures), ", ".join(sorted(registry.captures)) or "none"
        raise CaptureError(f"scene {scene} has no recorded captures.{guess} Scenes with recorded captures: {known}.")
    captures = registry.captures[scene]
    if capture not in captures:
        known = ", ".join(sorted(captures)) or "none"
        raise CaptureError(f"scene {scene} has no capture {capture}. Its captures: {known}.")
    remaining = {name: entry for name, entry in captures.items() if name != capture}
    others = {name: entries for name, entries in registry.captures.items() if name != scene}
    return Registry(captures=others | ({scene: remaining} if remaining else {}))


def write_registry(root: Path, registry: Registry) -> None:
    """Write `data/captures.yaml`, with one line for each capture, so that git merges the captures of two branches."""
    lines = [COMMENT, "captures:" if registry.captures else "captures: {}"]
    for scene, captures in registry.model_dump(mode="json")["captures"].items():
        lines.append(f"  {json.dumps(scene)}:")
        lines += [f"    {json.dumps(name)}: {json.dumps(entry)}" for name, entry in captures.items()]
    io.write_text(root / REGISTRY, "\n".join(lines) + "\n")


def _refuse_copy(where: str, original: str, before: Entry, entry: Entry, allow_copy: bool) -> None:
    """Raise `CaptureError` for a copy of `original`, unless the copy has another board or skin and is allowed."""
    relabelled = (before.board, before.skin) != (entry.board, entry.skin)
    if relabelled and allow_copy:
        return
    remedy = "Nothing has to be added, because the recording is in the scene already."
    if relabelled:
        remedy = (
            "If both are in the scene under different names, networks may be trained and tested on the same readings. "
            "To allow this, use option --allow-copy."
        )
    raise CaptureError(f"{where}: it has the same readings as {original}. {remedy}")

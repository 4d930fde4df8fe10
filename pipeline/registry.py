"""The recorded captures of this checkout: `data/captures.yaml`. In: YAML. Out: names, labels and hashes by scene.

Refuses to know what is in a capture.
"""

from pathlib import Path

from ruamel.yaml import YAML

from pipeline.capture.header import Header
from pipeline.core import io
from pipeline.core.config import Strict, parse, read_yaml
from pipeline.core.errors import CaptureError

REGISTRY = "data/captures.yaml"
COMMENT = "# The recorded captures of this checkout, by scene; written by `reskin add` and `reskin remove`.\n"


class Entry(Strict):
    """One recorded capture: its labels, and the hashes that tell a second copy."""

    board: str
    skin: str
    layout: str
    chips_n: int
    fingerprints: tuple[str, ...]  # of readings, and of the stream: one in common tells a copy
    copy_of: str | None


class Registry(Strict):
    """Captures by scene, then by name."""

    captures: dict[str, dict[str, Entry]]


def read_registry(root: Path) -> Registry:
    """Read and check `data/captures.yaml`."""
    return parse(Registry, read_yaml(root / REGISTRY), str(root / REGISTRY))


def with_capture(
    registry: Registry, scene: str, header: Header, fingerprints: tuple[str, ...], *, allow_copy: bool
) -> Registry:
    """Add a capture, or raise if it is there already or contradicts what is there."""
    captures, where = registry.captures.get(scene, {}), f"capture {header.capture}"
    twin = next((name for name, entry in captures.items() if set(entry.fingerprints) & set(fingerprints)), None)
    if twin is not None:
        _refuse_copy(where, twin, captures[twin], header, allow_copy)
    if header.capture in captures:
        raise CaptureError(where, "its name", "new to its scene", "one that is taken", "Choose another with --name.")
    for name, entry in captures.items():
        if entry.skin == header.skin and entry.board != header.board:
            what, rule = f"the board of skin {header.skin}", f"{entry.board}, as in {name}"
            remedy = "A skin that moves to another board gets a new name, or it would stand on both sides of a fold."
            raise CaptureError(where, what, rule, header.board, remedy)
        if entry.chips_n != header.chips_n:
            rule, remedy = f"the {entry.chips_n} of {name}", "Add it to a scene of its own."
            raise CaptureError(where, "chips", rule, header.chips_n, remedy)
    labels = {name: getattr(header, name) for name in ("board", "skin", "layout", "chips_n")}
    entry = Entry(**labels, fingerprints=fingerprints, copy_of=twin)
    return Registry(captures={**registry.captures, scene: {**captures, header.capture: entry}})


def without_capture(registry: Registry, scene: str, capture: str) -> Registry:
    """Take a capture out; a scene without captures goes too."""
    captures = registry.captures.get(scene, {})
    if capture not in captures:
        known = ", ".join(sorted(captures)) or "none"
        raise CaptureError(f"scene {scene}", "a capture", f"one of its own ({known})", capture, "Check the name.")
    left = {name: entry for name, entry in captures.items() if name != capture}
    others = {name: entries for name, entries in registry.captures.items() if name != scene}
    return Registry(captures=others | ({scene: left} if left else {}))


def write_registry(root: Path, registry: Registry) -> None:
    """Write `data/captures.yaml`."""
    yaml = YAML()
    with io.replacing(root / REGISTRY) as temporary, temporary.open("w", encoding="utf-8") as stream:
        stream.write(COMMENT)
        yaml.dump(registry.model_dump(mode="json"), stream)


def _refuse_copy(where: str, twin: str, entry: Entry, header: Header, allow_copy: bool) -> None:
    relabelled = (entry.board, entry.skin) != (header.board, header.skin)
    if relabelled and allow_copy:
        return
    remedy = "It is in the scene already."
    if relabelled:
        remedy = "Under two labels it would stand on both sides of a fold; to try that knowingly, add --allow-copy."
    raise CaptureError(where, "a recording", "new to its scene", f"the readings of {twin}", remedy)

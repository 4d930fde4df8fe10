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
    own = registry.captures.get(scene, {})
    where = f"capture {header.capture}"
    twin = next((name for name, entry in own.items() if set(entry.fingerprints) & set(fingerprints)), None)
    if twin is not None:
        _refuse_copy(where, twin, own[twin], header, allow_copy)
    if header.capture in own:
        raise CaptureError(where, "its name", "new to its scene", "one that is taken", "Choose another with --name.")
    for name, entry in own.items():
        if entry.skin == header.skin and entry.board != header.board:
            raise CaptureError(
                    where, f"the board of skin {header.skin}", f"{entry.board}, as in {name}", header.board,
                    "A skin that moves to another board gets a new name, or it would stand on both sides of a fold.",
                )  # fmt: skip
        if entry.chips_n != header.chips_n:
            raise CaptureError(
                where, "chips", f"the {entry.chips_n} of {name}", header.chips_n, "Add it to a scene of its own."
            )
    entry = Entry(
        board=header.board,
        skin=header.skin,
        layout=header.layout,
        chips_n=header.chips_n,
        fingerprints=fingerprints,
        copy_of=twin,
    )
    return Registry(captures={**registry.captures, scene: {**own, header.capture: entry}})


def without_capture(registry: Registry, scene: str, capture: str) -> Registry:
    """Take a capture out; a scene without captures goes too."""
    own = dict(registry.captures.get(scene, {}))
    if capture not in own:
        known = ", ".join(sorted(own)) or "none"
        raise CaptureError(f"scene {scene}", "a capture", f"one of its own ({known})", capture, "Check the name.")
    del own[capture]
    rest = {name: all_ for name, all_ in registry.captures.items() if name != scene}
    return Registry(captures=rest | ({scene: own} if own else {}))


def write_registry(root: Path, registry: Registry) -> None:
    """Write `data/captures.yaml`."""
    yaml = YAML()
    with io.replacing(root / REGISTRY) as temporary, temporary.open("w", encoding="utf-8") as stream:
        stream.write(
            "# The recorded captures of this checkout, by scene; written by `reskin add` and `reskin remove`.\n"
        )
        yaml.dump(registry.model_dump(mode="json"), stream)


def _refuse_copy(where: str, twin: str, entry: Entry, header: Header, allow_copy: bool) -> None:
    relabelled = (entry.board, entry.skin) != (header.board, header.skin)
    if relabelled and allow_copy:
        return
    remedy = "It is in the scene already."
    if relabelled:
        remedy = "Under two labels it would stand on both sides of a fold; to try that knowingly, add --allow-copy."
    raise CaptureError(where, "a recording", "new to its scene", f"the readings of {twin}", remedy)

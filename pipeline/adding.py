"""Adding a recording: somebody's files -> data/raw/<scene>/<capture>/, tracked, registered, planned. Or nothing at all.

Everything is read and checked in a temporary folder first; what fails leaves no trace. Refuses to know layouts
(`capture.readers`) and plans (`plan`).
"""

import re
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pipeline import io, plan
from pipeline.capture import header as headers
from pipeline.capture.folder import digest, write_capture
from pipeline.capture.header import Clock, Header
from pipeline.capture.readers import READERS
from pipeline.dataset.captures import check_losses, open_capture, read_header
from pipeline.errors import CaptureError, ParamsError, complain
from pipeline.params import read_params, read_scene
from pipeline.registry import REGISTRY, read_registry, with_capture, without_capture, write_registry

RAW = "data/raw"
INDENTATIONS = "data/indentations"
AddLayout = Literal["capture", "serial-binary", "serial-text", "lab", "ini", "eflesh"]
NATIVE_FILES = (headers.STREAM_FILE, headers.ARRIVALS_FILE, headers.PROBE_FILE)
RECORDINGS_OWN = Clock(kind="recording", rate_hz=None, marks=())


@dataclass(frozen=True)
class Labels:
    """What the user says of a recording; `None` where the recording itself may say."""

    board: str
    skin: str
    scene: str
    name: str | None


@dataclass(frozen=True)
class Dump:
    """What a bare serial dump does not say: wire format, chips, rate, and where the robot was."""

    wire: headers.Wire
    chips_n: int
    rate_hz: float
    probe: Path | None


Prepared = tuple[Header, Mapping[str, bytes | Path]]


def foreign(recording: Path, layout: Literal["lab", "ini", "eflesh"], labels: Labels, force_axis: str) -> Prepared:
    """Prepare somebody else's recording: its own files, untouched, under a header."""
    files = READERS[layout].collect(recording)
    chips_n = READERS[layout].count_chips(files)
    options = {"force_axis": force_axis} if layout == "eflesh" else {}
    return _header(labels, recording, layout=layout, chips_n=chips_n, special={"options": options}), files


def dump(recording: Path, labels: Labels, what: Dump) -> Prepared:
    """Prepare a bare dump of a port with the robot's log; frames get their time from a constant rate."""
    if what.probe is None:
        raise CaptureError(
            complain(
                recording,
                "a serial dump",
                "accompanied by its probe log",
                "none",
                "Add --probe PROBE.csv (columns in data/README.md).",
            )
        )
    _need_file(recording)
    _need_file(what.probe)
    clock = Clock(kind="rate", rate_hz=what.rate_hz, marks=())
    special = {"wire": what.wire, "clock": clock}
    header = _header(labels, recording, layout="native", chips_n=what.chips_n, special=special)
    return header, {headers.STREAM_FILE: recording, headers.PROBE_FILE: what.probe}


def native(recording: Path, labels: Labels, probe: Path | None) -> Prepared:
    """Prepare a capture folder that `reskin record` wrote; `probe` adds the robot's log to it."""
    found = read_header(recording)
    for what, said, written in (("board", labels.board, found.board), ("skin", labels.skin, found.skin)):
        if said != written:
            raise CaptureError(
                complain(recording, f"--{what}", f"{written!r}, as its header says", repr(said), "Which is right?")
            )
    # A recorder that was killed has not hashed its files into the header; they are there all the same.
    files = {name: recording / name for name in NATIVE_FILES if (recording / name).exists() or name in found.files}
    if probe is not None:
        _need_file(probe)
        files[headers.PROBE_FILE] = probe
    if headers.PROBE_FILE not in files:
        raise CaptureError(
            complain(recording, "a capture", "labelled by a probe log", "none", "Add --probe PROBE.csv.")
        )
    for name, file in files.items():
        _need_file(file)
        if file.parent == recording and found.files.get(name, io.sha256(file)) != io.sha256(file):
            raise CaptureError(
                complain(file, "the file", "unchanged since it was recorded", "another hash", "Record it again.")
            )
    return found.model_copy(update={"capture": labels.name or found.capture}), files


def add(root: Path, scene: str, prepared: Prepared, *, allow_copy: bool) -> Header:
    """Check a prepared recording, write it, track it with DVC, register it, and plan its scene; all, or nothing."""
    header, files = prepared
    settings = read_scene(_scene_file(root, scene))
    if settings.source != header.source:
        raise CaptureError(
            complain(
                f"capture {header.capture}", "source", f"{settings.source}, as scene {scene} is", header.source,
                "Simulated and recorded captures belong to different scenes.",
            )
        )  # fmt: skip
    params = read_params(root / plan.PARAMS)
    before = read_registry(root)
    target = root / RAW / scene / header.capture
    if target.exists():
        raise CaptureError(
            complain(target, "a new capture's folder", "free", "one that is there", "Choose another --name.")
        )
    with io.restoring(root / REGISTRY, root / plan.PARAMS), _forgetting_on_failure(target):
        complete = write_capture(target, header, files)
        after = with_capture(before, scene, complete, digest(complete), allow_copy=allow_copy)
        _read_through(target, params.lost_fraction_max)
        _dvc(root, "add", "--quiet", str(target.relative_to(root)))
        write_registry(root, after)
        plan.use(root, [*params.scenes, scene])
    return complete


def remove(root: Path, scene: str, capture: str) -> None:
    """Take a capture out again: its raw files, its readings, its entry, and its stage."""
    after = without_capture(read_registry(root), scene, capture)
    params = read_params(root / plan.PARAMS)
    write_registry(root, after)
    plan.use(root, [name for name in params.scenes if name != scene or scene in after.captures])
    _forget(root / RAW / scene / capture)
    io.remove(root / INDENTATIONS / scene / f"{capture}.parquet")


def _header(
    labels: Labels,
    recording: Path,
    *,
    layout: headers.Layout,
    chips_n: int,
    special: Mapping[str, Any],
) -> Header:
    for option, word in (("--board", labels.board), ("--skin", labels.skin), ("--name", labels.name)):
        if word is not None and not re.fullmatch(headers.NAME, word):
            raise CaptureError(complain(option, "a name", "1 to 64 of A-Z a-z 0-9 _ -", repr(word), "Choose another."))
    stem = re.sub(r"[^A-Za-z0-9_-]", "_", recording.resolve().stem)
    header = Header.model_construct(
        format="reskin-capture/1", capture=labels.name or f"{labels.board}_{labels.skin}_{stem}"[:64],
        board=labels.board, skin=labels.skin, source="recorded", layout=layout, wire=None, chips_n=chips_n,
        unit_b="uT", unit_force="N", unit_place="mm", firmware=None, clock=RECORDINGS_OWN,
        protocol=f"as recorded in {stem}", contacts_before_n=0, options={}, files={}, note="added by reskin add",
    )  # fmt: skip
    return headers.parse(headers.render(header.model_copy(update=dict(special))), str(recording))


def _read_through(folder: Path, limit: float) -> None:
    _, blocks, account = open_capture(folder)
    rows_n = sum(len(block) for block in blocks)
    check_losses(account, limit, folder.name)
    if rows_n == 0:
        raise CaptureError(
            complain(
                folder.name, "a capture", "one reading or more", f"none; counted {dict(account)}", "Check its files."
            )
        )


def _need_file(path: Path) -> None:
    if not path.is_file():
        raise CaptureError(complain(path, "the file", "there", "nothing", "Check the path."))


def _scene_file(root: Path, scene: str) -> Path:
    if scene not in plan.scene_names(root):
        known = ", ".join(plan.scene_names(root))
        raise ParamsError(
            complain("--scene", "a scene", f"one of {known}", scene, f"Or write {plan.SCENES}/{scene}.yaml.")
        )
    return root / plan.SCENES / f"{scene}.yaml"


@contextmanager
def _forgetting_on_failure(target: Path) -> Iterator[None]:
    try:
        yield
    except BaseException:
        _forget(target)  # Ctrl-C included: a half-added recording is worse than none
        raise


def _forget(target: Path) -> None:
    io.remove(target)
    io.remove(target.with_name(f"{target.name}.dvc"))
    if target.parent.is_dir():
        ignored = target.parent / ".gitignore"
        if ignored.exists():
            lines = [line for line in ignored.read_text(encoding="utf-8").splitlines() if line != f"/{target.name}"]
            io.write_text(ignored, "\n".join(lines) + "\n") if lines else io.remove(ignored)
        if not any(target.parent.iterdir()):
            target.parent.rmdir()


def _dvc(root: Path, *words: str) -> None:
    done = subprocess.run([sys.executable, "-m", "dvc", *words], cwd=root, capture_output=True, text=True, check=False)
    if done.returncode:
        raise CaptureError(
            complain("dvc " + " ".join(words), "DVC", "able to track it", done.stderr.strip()[-300:], "See above.")
        )

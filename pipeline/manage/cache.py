"""Is DVC's cache what it says? In: its objects, dvc.lock, .dvc files. Out: words, and what was changed is set aside.

DVC names an object by the MD5 of its content, and restores outputs from one that is read-only without reading it again:
what a failing disk changed comes back as if it were the result. Refuses to know what an output means.
"""

import hashlib
import re
import shutil
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from pipeline.manage.running import need_rest
from pipeline.manage.tidy import LOCK
from reskin import io
from reskin.config import read_yaml
from reskin.errors import SchemaError

ASIDE = ".reskin/damaged"
FOLDER = ".dir"  # how the name of an object ends that lists the files of a folder
OBJECT = re.compile(r"[0-9a-f]{30}(\.dir)?")  # other names are what a killed DVC left half-written
READ_ONLY = 0o444  # as DVC keeps objects

Use = tuple[str, Path]  # the command that brings an output back, and the output


def check(root: Path, echo: Callable[[str], None]) -> int:
    """Hold every object against its name; set aside what differs, and its copies among the outputs; 1 if any does."""
    need_rest(root)
    cache = _cache_of(root)
    files = (file for file in sorted(cache.glob("[0-9a-f][0-9a-f]/*")) if OBJECT.fullmatch(file.name))
    objects = {f"{file.parent.name}{file.name}": file for file in files}
    damaged = {name: file for name, file in objects.items() if _md5(file) != name.removesuffix(FOLDER)}
    uses = _uses(root, objects) if damaged else {}
    for name, file in damaged.items():
        rule, cure = "what its name says", _set_aside(root, name, file, uses.get(name, []))
        echo(f"error: {SchemaError(file, 'the content of the object', rule, 'another MD5', cure)}")
    echo(f"DVC's cache: {len(objects)} objects, {len(damaged)} of them damaged")
    return 1 if damaged else 0


def _set_aside(root: Path, name: str, file: Path, uses: Sequence[Use]) -> str:
    """Mend an object from an output that is whole; else take its copies away, so that what made them runs again."""
    changed, aside = _md5(file), root / ASIDE / name
    outputs = [(path, _md5(path)) for _, path in uses if path.is_file()]
    aside.parent.mkdir(parents=True, exist_ok=True)
    shutil.move(file, aside)  # kept: of a recording there may be nothing better
    for path, digest in outputs:
        if digest == name:
            with io.replacing(file) as temporary:
                shutil.copyfile(path, temporary)
                temporary.chmod(READ_ONLY)
            return f"It is mended from {path}."
    copies = [path for path, digest in outputs if digest == changed]
    for path in copies:
        io.remove(path)
    if not uses:
        return f"Nothing of dvc.lock needs it; it now lies in {aside}."
    gone = f", and no more in {', '.join(map(str, dict.fromkeys(copies)))}" if copies else ""
    return f"It now lies in {aside}{gone}. Run: {'; '.join(dict.fromkeys(how for how, _ in uses))}"


def _uses(root: Path, objects: Mapping[str, Path]) -> dict[str, list[Use]]:
    """List the outputs that hold each object, by its name; those of a folder too."""
    found: dict[str, list[Use]] = defaultdict(list)
    for how, path, name in _outputs(root):
        found[name].append((how, path))
        if name.endswith(FOLDER) and name in objects:
            try:
                listed: list[dict[str, Any]] = io.read_json(objects[name])
            except SchemaError:  # it is damaged itself, and is told of as such
                continue
            for entry in listed:
                found[entry["md5"]].append((how, path / entry["relpath"]))
    return found


def _outputs(root: Path) -> Iterator[tuple[str, Path, str]]:
    stages = read_yaml(root / LOCK).get("stages", {}) if (root / LOCK).exists() else {}
    for stage, entry in stages.items():
        for out in entry.get("outs", []):
            yield f"dvc repro {stage}", root / out["path"], out["md5"]
    for file in sorted((root / "data/raw").glob("*/*.dvc")):
        for out in read_yaml(file)["outs"]:
            yield f"dvc pull {file}, or add the recording again", file.parent / out["path"], out["md5"]


def _md5(file: Path) -> str:
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, "md5").hexdigest()


def _cache_of(root: Path) -> Path:
    from dvc.repo import Repo  # late: DVC takes a second

    with Repo(str(root)) as repo:
        return Path(repo.cache.local.path)

"""Check DVC's cache for damaged objects, and set them aside.

DVC names an object by the MD5 of its content. It restores outputs from a read-only object without checking the content
again. If a failing disk has damaged an object, the damaged object would therefore be restored as a result.
"""

import hashlib
import re
import shutil
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from pipeline.manage.running import require_idle
from pipeline.manage.tidy import LOCK
from reskin import io
from reskin.config import read_yaml
from reskin.errors import SchemaError

DAMAGED = ".reskin/damaged"  # the folder of objects that were set aside
FOLDER = ".dir"  # suffix of an object that lists the files of a folder
OBJECT = re.compile(r"[0-9a-f]{30}(\.dir)?")  # names of objects; killed DVC processes leave other files
READ_ONLY = 0o444  # the permissions that DVC gives objects


class Use(NamedTuple):
    """An output that contains an object of the cache, and the command that restores the output."""

    command: str
    path: Path


def check(root: Path, echo: Callable[[str], None]) -> int:
    """Check the MD5 of every object, and set damaged objects aside; return exit status 1 if any object is damaged."""
    require_idle(root)
    cache = _cache_of(root)
    files = (file for file in sorted(cache.glob("[0-9a-f][0-9a-f]/*")) if OBJECT.fullmatch(file.name))
    objects = {f"{file.parent.name}{file.name}": file for file in files}
    damaged = {name: file for name, file in objects.items() if _md5(file) != name.removesuffix(FOLDER)}
    uses = _uses(root, objects) if damaged else {}
    for name, file in damaged.items():
        outcome = _set_aside(root, name, file, uses.get(name, []))
        echo(f"error: {file} is damaged: its MD5 differs from its name. {outcome}")
    echo(f"DVC's cache: {len(objects)} objects, {len(damaged)} of them damaged")
    return 1 if damaged else 0


def _set_aside(root: Path, name: str, file: Path, uses: Sequence[Use]) -> str:
    """Move a damaged object away, and repair the cache; return a sentence that says what was done.

    The object is restored from an output that contains an intact copy. If there is no such output, the damaged copies
    are deleted from outputs, so that the stages of these outputs run again.
    """
    damaged_md5, aside = _md5(file), root / DAMAGED / name
    outputs = [(use.path, _md5(use.path)) for use in uses if use.path.is_file()]
    aside.parent.mkdir(parents=True, exist_ok=True)
    shutil.move(file, aside)  # moved rather than deleted, because it may be the only copy of a recording
    for path, digest in outputs:
        if digest == name:
            with io.replacing(file) as temporary:
                shutil.copyfile(path, temporary)
                temporary.chmod(READ_ONLY)
            return f"It was restored from {path}."
    copies = [path for path, digest in outputs if digest == damaged_md5]
    for path in copies:
        io.remove(path)
    if not uses:
        return f"No output in dvc.lock uses it. It was moved to {aside}."
    removed = f", and removed from {', '.join(map(str, dict.fromkeys(copies)))}" if copies else ""
    return f"It was moved to {aside}{removed}. Run: {'; '.join(dict.fromkeys(use.command for use in uses))}"


def _uses(root: Path, objects: Mapping[str, Path]) -> dict[str, list[Use]]:
    """List the outputs that contain each object, by the object's name; files in output folders count as outputs."""
    uses: dict[str, list[Use]] = defaultdict(list)
    for command, path, name in _outputs(root):
        uses[name].append(Use(command, path))
        if name.endswith(FOLDER) and name in objects:
            try:
                listed: list[dict[str, Any]] = io.read_json(objects[name])
            except SchemaError:  # this object, which lists the files of a folder, is damaged, and is reported as such
                continue
            for entry in listed:
                uses[entry["md5"]].append(Use(command, path / entry["relpath"]))
    return uses


def _outputs(root: Path) -> Iterator[tuple[str, Path, str]]:
    """Yield the command, the path and the object of every output in dvc.lock and in the .dvc files of recordings."""
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
    from dvc.repo import Repo  # imported here, because the import takes a second

    with Repo(str(root)) as repo:
        return Path(repo.cache.local.path)

"""Stage ingest_many: all captures of a recorded scene that has many -> indentations/<scene>/, one file a capture.

A stage each would cost more than the reading (docs/growth.md). What was read before, of the same bytes, by the same
code and settings, is taken over: a capture more costs itself. Refuses to know layouts: stage `ingest` reads each.
"""

import hashlib
import shutil
from pathlib import Path

from pipeline.provenance import home
from pipeline.stage import run, say
from pipeline.stages.ingest import ingest
from reskin import io
from reskin.config import Files, read_settings

KEPT = ".reskin/readings"  # a cache, and no output: DVC deletes those before a stage runs


def ingest_many(scene: str, files: Files, raw: Path, code: Path, lost_fraction_max: float, indentations: Path) -> None:
    """Read every capture of the plan, or take over what was read of it before."""
    settings, kept = read_settings("ingest_many", scene, files), home() / KEPT / scene
    rest_on = repr([settings.shared["faults"], lost_fraction_max]).encode() + io.read_bytes(code)
    captures, before = (
        settings.plan("captures"),
        {file.stem.partition("-")[0]: file for file in kept.glob("*-*.parquet")},
    )
    taken, read_n = set(), 0
    with io.replacing(indentations) as folder:
        folder.mkdir()
        for name in captures:
            key = _key(raw / name, rest_on)
            if key not in before or not _is_whole(before[key]):
                fresh = kept / f"{key}.parquet"
                ingest(scene, files, raw / name, lost_fraction_max, fresh)
                before[key], read_n = fresh.rename(kept / f"{key}-{io.sha256(fresh)}.parquet"), read_n + 1
            shutil.copyfile(before[key], folder / f"{name}.parquet")  # no link: what cuts one must not cut the other
            taken.add(before[key])
    for file in set(kept.glob("*.parquet")) - taken:
        io.remove(file)
    say(f"{scene}: {len(captures)} captures, {len(captures) - read_n} of them read before")


def _is_whole(kept: Path) -> bool:
    """Tell whether kept readings are as they were written; what was damaged is said, and read again."""
    if io.sha256(kept) == kept.stem.partition("-")[2]:
        return True
    say(f"warning: kept readings are damaged and are read again ({kept}: other content than was written)")
    io.remove(kept)
    return False


def _key(capture: Path, rest_on: bytes) -> str:
    """Name what readings of a capture rest on: its name and bytes, the code, the settings."""
    digest = hashlib.sha256(rest_on + capture.name.encode())
    for file in sorted(file for file in capture.rglob("*") if file.is_file()):
        digest.update(f"{file.relative_to(capture)} {io.sha256(file)}\n".encode())
    return digest.hexdigest()


if __name__ == "__main__":
    run(ingest_many)

"""Stages that turn captures (raw recordings) into a dataset: ingest, ingest_many, ingest_simulated, describe, split.

To ingest a capture means to decode its bytes, drop faulty readings, and write a table with one row per reading.
"""

import hashlib
import shutil
from pathlib import Path

from pipeline.description import describe as describe_capture
from pipeline.description import over_skins, without_rest
from pipeline.provenance import home
from pipeline.settings import Settings
from pipeline.stage import say
from reskin import io
from reskin.data.rows import Rows, Selection, load_rows
from reskin.data.splits import Split, draw_folds, render_folds
from reskin.recordings.fault_policy import FaultPolicy
from reskin.recordings.ingest import check_losses, open_capture

# Folder of the cache of stage ingest_many. The outputs of the stage cannot serve as a cache, because DVC deletes them
# before the stage runs.
CACHE = ".reskin/readings"
NO_ROWS = Rows.of_labels(boards=[], skins=[])


def ingest(settings: Settings, raw: Path, indentations: Path) -> None:
    """Ingest one recorded capture; raise an error if too large a part of its data was lost."""
    policy = settings.shared_section(FaultPolicy, "faults")
    header, blocks, counts = open_capture(raw, policy)
    io.write_readings(indentations, blocks, counts)
    try:
        check_losses(counts, settings.shared["lost_fraction_max"], str(raw))
    except ValueError:
        io.remove(indentations)
        raise
    counted = ", ".join(f"{name} {count}" for name, count in counts.items() if count)
    say(f"{settings.scene}/{header.capture} ({header.source}): {counted}")


def ingest_simulated(settings: Settings, raw: Path, indentations: Path) -> None:
    """Ingest all captures of one simulated protocol, in the same way as recorded captures."""
    with io.replacing(indentations) as folder:
        folder.mkdir()
        for capture in sorted(child for child in raw.iterdir() if child.is_dir()):
            ingest(settings, capture, folder / f"{capture.name}.parquet")


def ingest_many(settings: Settings, raw: Path, code: Path, indentations: Path) -> None:
    """Ingest all captures of a recorded scene in one stage.

    This stage is for scenes with many captures. With one DVC stage for each capture, the overhead of DVC would take
    longer than the ingestion itself. A capture is not ingested again if its bytes, the code and the settings are
    unchanged. Its readings are then copied from a cache (docs/teams.md).
    """
    cache = home() / CACHE / settings.scene
    policy = [settings.shared["faults"], settings.shared["lost_fraction_max"]]
    common_inputs = repr(policy).encode() + io.read_bytes(code)
    cached = {file.stem.partition("-")[0]: file for file in cache.glob("*-*.parquet")}
    used, read_n = set(), 0
    with io.replacing(indentations) as folder:
        folder.mkdir()
        for name in settings.captures:
            key = _cache_key(raw / name, common_inputs)
            if key not in cached or not _is_whole(cached[key]):
                fresh = cache / f"{key}.parquet"
                ingest(settings, raw / name, fresh)
                cached[key], read_n = fresh.rename(cache / f"{key}-{io.sha256(fresh)}.parquet"), read_n + 1
            # The file is copied rather than linked, so that an edit of the output does not change the cache.
            shutil.copyfile(cached[key], folder / f"{name}.parquet")
            used.add(cached[key])
    for file in set(cache.glob("*.parquet")) - used:
        io.remove(file)
    captures_n = len(settings.captures)
    say(f"{settings.scene}: ingested {captures_n} captures, {captures_n - read_n} of them from the cache")


def _is_whole(cached: Path) -> bool:
    """Return whether a cached file is undamaged: the digest of its content must equal the digest in its name.

    A damaged file is deleted, with a warning.
    """
    if io.sha256(cached) == cached.stem.partition("-")[2]:
        return True
    say(
        f"warning: the cached readings in {cached} are damaged, because the file has changed since it was written. "
        "The capture is ingested again."
    )
    io.remove(cached)
    return False


def _cache_key(capture: Path, common_inputs: bytes) -> str:
    """Return a digest of everything on which the readings of a capture depend.

    These are the name and the bytes of the capture, and the code and the settings (`common_inputs`).
    """
    digest = hashlib.sha256(common_inputs + capture.name.encode())
    for file in sorted(file for file in capture.rglob("*") if file.is_file()):
        digest.update(f"{file.relative_to(capture)} {io.sha256(file)}\n".encode())
    return digest.hexdigest()


def describe(settings: Settings, indentations: Path, description: Path) -> None:
    """Write a description of a scene's recordings: fields, noise, resolution and forces, summarised over all skins."""
    captures = [io.read_readings(indentations / f"{name}.parquet") for name in settings.captures_in(indentations)]
    ingest_counts = {
        readings.capture: io.read_ingest_counts(indentations / f"{readings.capture}.parquet") for readings in captures
    }
    described = {readings.capture: describe_capture(readings) for readings in captures}
    described |= {
        name: without_rest(described[name])
        for name, capture_counts in ingest_counts.items()
        if capture_counts.get("baseline_subtracted_rows_n")
    }
    summary = over_skins([(readings.skin, described[readings.capture]) for readings in captures])
    readings_n = sum(map(len, captures))
    counts = {"captures_n": len(captures), "readings_n": readings_n}
    counts["indentations_n"] = sum(capture_counts.get("indentations_n", 0) for capture_counts in ingest_counts.values())
    io.write_json(description, {"counts": counts, "source": captures[0].source, "over_skins": summary})
    say(f"{settings.scene}: {indentations}: described {readings_n} readings of {len(captures)} captures")


def split(settings: Settings, section: Split, indentations: Path, folds: Path) -> None:
    """Draw the folds of all experiments of a scene that hold out rows for testing, and write them to a file."""
    captures = settings.captures_in(indentations)
    if not settings.held_out:
        io.write_json(folds, render_folds(captures, NO_ROWS, []))
        return say(
            f"{settings.scene}: {len(captures)} captures; no folds, because no experiment of the scene holds rows out"
        )
    rows = load_rows([indentations / f"{name}.parquet" for name in captures], settings.section(Selection, "selection"))
    new_folds = draw_folds(rows, settings.held_out, section, settings.seed)
    io.write_json(folds, render_folds(captures, rows, new_folds))
    counts = f"{len(rows)} rows of {len(captures)} captures, {len(new_folds)} folds"
    say(f"{settings.scene}: {counts}; rows that are in no fold: {rows.dropped}")

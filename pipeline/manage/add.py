"""Add a recording to a scene.

The recording is copied to data/raw/<scene>/<capture>/, read completely and checked. It is then tracked with DVC and
listed in the registry (data/captures.yaml), and in the plan if its scene is planned. If anything fails or the command
is stopped, all changes are undone.
"""

import hashlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float64

from pipeline import PARAMS, PLAN, SCENES
from pipeline.catalogue import EXPERIMENTS
from pipeline.fitting.presses import pool, thin
from pipeline.manage.registry import (
    RAW,
    REGISTRY,
    Entry,
    Registry,
    read_registry,
    with_entry,
    without_capture,
    write_registry,
)
from pipeline.plan import read_plan, use
from pipeline.scenes import Scene, read_scene, read_shared, scene_file
from pipeline.settings import Settings, read_settings
from pipeline.stage import say
from reskin import config, io
from reskin.board.rates import REPEATED_MAX, RepeatCounter
from reskin.errors import CaptureError, ParamsError, ReskinError, SchemaError, did_you_mean
from reskin.recordings.fault_policy import FaultPolicy
from reskin.recordings.header import STREAM_FILE, Header, write_capture
from reskin.recordings.ingest import check_losses, open_capture
from reskin.recordings.preparing import CaptureNames, Prepared
from reskin.schema import Readings

INDENTATIONS = "data/indentations"
# Places of this number or more are in another unit than mm if their span is this fraction of that of the chips.
PLACES_MIN_N, SPAN_MIN = 9, 0.2
# Readings minus a no-load reading, both only noise, have the rms of the steps between readings, or less.
SIGNAL_STEPS_MIN = 1.05
COMPARED_N = 3  # the places of a new capture are compared with those of this number of the scene's latest captures
# With fewer presses, no orientation is reported. More presses are thinned out, because each is compared with each press
# of another capture.
COMPARED_PRESSES_MIN_N, COMPARED_PRESSES_MAX_N = 20, 1000
# Another orientation of the labels is reported if it explains at least the fraction EXPLAINED_MIN of the variance of
# the estimated places, and if this fraction exceeds that of the unchanged labels by at least GAIN_MIN.
EXPLAINED_MIN = GAIN_MIN = 0.5
ORIENTATIONS = {
    "as they are": [[1, 0], [0, 1]],
    "with x and y swapped": [[0, 1], [1, 0]],
    "with x mirrored": [[-1, 0], [0, 1]],
    "with y mirrored": [[1, 0], [0, -1]],
    "rotated by 90 degrees": [[0, -1], [1, 0]],
    "rotated by 180 degrees": [[-1, 0], [0, -1]],
    "rotated by 270 degrees": [[0, 1], [-1, 0]],
    "with x and y swapped and mirrored": [[0, -1], [-1, 0]],
}


def add(root: Path, scene: str, prepared: Prepared, *, allow_copy: bool) -> Header:
    """Check and write a prepared recording, track it with DVC, and register it; on failure, undo all of this.

    Prints numbers of readings and indentations, and warnings.
    """
    header, files = prepared
    copy = f"cp {SCENES}/ini.yaml {SCENES}/{scene}.yaml"
    remedy = f"To create it, run reskin new {scene} --boards ..., or copy a scene: {copy}."
    settings = read_scene(root, scene_file(root, scene, remedy=remedy).stem)
    if settings.source != header.source:
        create = "reskin new NEW --boards ..." + (" --simulated" if header.source == "simulated" else "")
        remedy = f"Choose a scene of the same source, or create one: {create}"
        raise ParamsError(f"scene {scene} is {settings.source}, but {header.capture} is {header.source}. {remedy}.")
    if settings.simulate is not None:
        remedy = "Create a scene for recordings of emulated boards: reskin new NAME --boards ... --simulated."
        raise ParamsError(f"scene {scene} simulates its own captures, so no recordings can be added to it. {remedy}")
    if settings.boards is not None and header.board not in settings.boards:
        guess, known = did_you_mean(header.board, settings.boards), ", ".join(settings.boards)
        remedy = f"Correct the name, or add the board to key boards in {scene_file(root, scene)}."
        raise ParamsError(f"board {header.board} is not a board of scene {scene} ({known}).{guess} {remedy}")
    shared, before = read_shared(root / PARAMS), read_registry(root)
    target = root / RAW / scene / header.capture
    _check_free(target, header.capture in before.captures.get(scene, {}))
    with io.restoring(root / REGISTRY, root / PLAN), _removing_on_failure(target):
        with _naming_sources(target, files):
            complete = write_capture(target, header, files)
            fingerprints, counts = _read_through(target, complete, shared.lost_fraction_max, shared.faults)
        if not counts.touched and not any(experiment.without_contact for experiment in settings.entries):
            known = ", ".join(name for name, experiment in EXPERIMENTS.items() if experiment.without_contact)
            raise ParamsError(
                f"{header.capture}: nothing touches the skin in this recording, and no experiment of scene {scene} "
                f"uses such recordings. Add the recording to a scene that runs {known}, such as scene hand."
            )
        entry = Entry(
            board=complete.board, skin=complete.skin, layout=complete.layout, chips_n=complete.chips_n,
            fingerprints=fingerprints, copy_of=None,
        )  # fmt: skip
        after = with_entry(before, scene, complete.capture, entry, allow_copy=allow_copy)
        _track(target, root)
        write_registry(root, after)
        _update_plan(root, scene, after)
    say(
        f"{complete.capture}: {counts.readings_n} readings in contact, {counts.indentations_n} indentations, "
        f"{counts.passes_n} passes"
    )
    if lost := complete.options.get("lost"):
        say(f"warning: the recording of capture {complete.capture} was interrupted. Lost: {lost}.")
    if "compare" in (settings.model_extra or {}):
        _warn_of_departures(target, read_settings(scene, root), shared.faults)
    else:
        _warn_of_other_labels(target, list(before.captures.get(scene, {})), shared.faults)
    if all(other.skin != complete.skin for other in before.captures.get(scene, {}).values()):
        _warn_of_small_pool(complete, settings, counts)
    return complete


def names_of(root: Path, scene: str, recording: Path, given: CaptureNames) -> CaptureNames:
    """Return the names of board, skin and capture; names that are not given are taken from the name of the file.

    The file must then be named `BOARD_SKIN.csv`. The skin gets the name `BOARD_SKIN`, so that skins of different boards
    have different names. Further parts of the file's name, as in `BOARD_SKIN_MORE.csv`, distinguish several captures of
    a skin.
    """
    if given.board and given.skin:
        return given
    stem = recording.stem
    boards = config.read_yaml(scene_file(root, scene)).get("boards", ())
    starts = [name for name in (given.board, *boards) if name and stem.startswith(f"{name}_")]
    board = max(starts, key=len, default=stem.partition("_")[0])
    skin = stem.removeprefix(f"{board}_").partition("_")[0]
    if skin == stem or not skin:
        raise ParamsError(
            f"{recording}: the name of the board or of the skin is not given, and the file's name is not of the form "
            "BOARD_SKIN.csv. Rename the file, or use options --board and --skin."
        )
    return CaptureNames(given.board or board, given.skin or f"{board}_{skin}", given.name or stem)


@contextmanager
def undoing(root: Path, scene: str, captures: Sequence[str]) -> Iterator[None]:
    """Undo all changes if the `with` block fails.

    The block appends the name of each capture that it has added to `captures`, so that these captures can be removed.
    """
    with io.restoring(root / REGISTRY, root / PLAN):
        try:
            yield
        except BaseException:
            for capture in captures:
                _remove_files(root / RAW / scene / capture)
            if captures:
                say(f"nothing was added: {', '.join(captures)} were removed again")
            raise


def remove(root: Path, scene: str, capture: str) -> None:
    """Remove a capture from the registry and the plan, then delete its raw files and its readings."""
    after = without_capture(read_registry(root), scene, capture)
    with io.restoring(root / REGISTRY, root / PLAN):
        write_registry(root, after)
        _update_plan(root, scene, after)
    _remove_files(root / RAW / scene / capture)
    io.remove(root / INDENTATIONS / scene / f"{capture}.parquet")


def _update_plan(root: Path, scene: str, registry: Registry) -> None:
    """Write the captures of a planned scene to the plan; drop the scene from the plan if it has none left."""
    planned = list(read_plan(root / PLAN).scenes)
    if scene in planned:
        use(root, [name for name in planned if name != scene or scene in registry.captures])


def _check_free(target: Path, registered: bool) -> None:
    if registered:
        remedy = (
            "If that is the same recording, nothing has to be added. Otherwise, choose another name with option --name."
        )
        raise ParamsError(f"the scene already has a capture with the name {target.name}. {remedy}")
    if target.exists():
        remedy = (
            "Probably an earlier `reskin add` was killed before the recording was complete. Delete the folder, or "
            "choose another name with option --name."
        )
        raise ParamsError(f"{target}: the folder exists already, but it belongs to no capture of a scene. {remedy}")


@dataclass(frozen=True)
class Counts:
    """Numbers of readings in contact, passes and indentations of a capture, and whether anything touches the skin."""

    readings_n: int
    passes_n: int
    indentations_n: int
    touched: bool


def _read_through(folder: Path, header: Header, limit: float, policy: FaultPolicy) -> tuple[tuple[str, ...], Counts]:
    """Read a whole capture as stage ingest does; return its fingerprints and its counts.

    The fingerprints are the SHA-256 of the readings and, if the capture has one, of the recorded byte stream. Copies of
    a recording have at least one fingerprint in common, even if they have other names or another layout. A reading with
    an unknown force (NaN) counts as a touch.
    """
    _, blocks, counts = open_capture(folder, policy)
    rows_n, touched, readings, repeats = 0, False, hashlib.sha256(), RepeatCounter(header.chips_n)
    passes: set[int] = set()
    indentations: set[int] = set()
    sums = np.zeros(4)  # sums of squares and numbers of field changes, and of steps from one reading to the next
    for block in blocks:
        rows_n += len(block)
        touched |= bool((block.Fz_N != 0).any())
        readings.update(block.b_uT.tobytes())
        repeats.feed(block.b_uT)
        change_uT = block.b_uT - block.noload_uT
        step_uT = np.diff(block.b_uT, axis=0)[np.diff(block.indentation) == 0]
        sums += [(change_uT**2).sum(), change_uT.size, (step_uT**2).sum(), step_uT.size]
        passes.update(np.unique(block.pass_i).tolist())
        indentations.update(np.unique(block.indentation).tolist())
    check_losses(counts, limit, folder.name)
    if rows_n == 0:
        raise CaptureError(
            f"{folder.name}: all readings were dropped because of faults. Counts: {dict(counts)}. Check the recorded "
            "files."
        )
    faults = [f"{key.removeprefix('fault_')} {n}" for key, n in counts.items() if key.startswith("fault_")]
    if faults:
        say(f"warning: capture {folder.name} has faults: {', '.join(faults)}")
    change_rms_uT, step_rms_uT = np.sqrt(sums[::2] / np.maximum(sums[1::2], 1))
    if touched and change_rms_uT < SIGNAL_STEPS_MIN * step_rms_uT:
        say(
            f"warning: capture {folder.name}: the presses change the field by {change_rms_uT:.2g} uT (rms), no more "
            f"than the noise from one reading to the next ({step_rms_uT:.2g} uT). Check that the skin was on the "
            "board, and that the labels belong to this recording. The recording was added anyway."
        )
    if repeats.readings > REPEATED_MAX:
        say(
            f"warning: capture {folder.name}: {repeats.readings:.0%} of readings equal the reading before. Probably "
            "the board, or the program that recorded it, reads faster than the chips measure. To measure the rate of "
            "the chips, run: reskin ports --rate. The recording was added anyway."
        )
    fingerprints = (readings.hexdigest(), *(header.files[name] for name in (STREAM_FILE,) if name in header.files))
    return fingerprints, Counts(rows_n, len(passes), len(indentations), touched)


def _warn_of_small_pool(header: Header, scene: Scene, counts: Counts) -> None:
    """Warn if the first capture of a skin has too few passes for setting `split.pool_passes_n` of the scene."""
    pool_n = scene.split.pool_passes_n
    if pool_n is not None and counts.passes_n <= pool_n:
        column = "fill in column pass of the file (needed if the order of places differs between passes), "
        say(
            f"warning: capture {header.capture} has {counts.passes_n} passes, but with split.pool_passes_n: {pool_n} "
            f"the scene needs more than {pool_n} passes of each skin. Add further recordings of skin {header.skin}, "
            f"{column if header.layout == 'table' else ''}or reduce split.pool_passes_n in the scene's file."
        )


def _warn_of_departures(folder: Path, settings: Settings, policy: FaultPolicy) -> None:
    """Warn if chips, labels or skin seem to be oriented differently from section `compare` of the scene."""
    # imported here, because importing the physics takes seconds
    from pipeline.fitting.frames import find_departure
    from pipeline.training.recorded import Compare

    blocks = list(open_capture(folder, policy)[1])
    section = settings.section(Compare, "compare")
    try:
        place_mm = np.concatenate([np.column_stack([each.x_mm, each.y_mm]) for each in blocks]).astype(float)
        sentence = _other_unit(place_mm, section.layout.chips_mm) or find_departure(blocks, section.axes)
    except ReskinError as error:
        sentence = f"The orientation of labels, chips and skin was not compared with the scene's settings: {error}"
    if sentence:
        say(f"warning: capture {folder.name}: {sentence} The recording was added anyway.")


def _other_unit(place_mm: Float64[np.ndarray, "m 2"], chips_mm: Float64[np.ndarray, "k 2"]) -> str:
    """Return a sentence if the places span too little or too much for the board, as in cm or m; otherwise empty."""
    place_mm = np.unique(place_mm[np.isfinite(place_mm).all(axis=1)].round(3), axis=0)
    if len(place_mm) < PLACES_MIN_N:
        return ""
    span_mm, chips_span_mm = (float(np.ptp(places, axis=0).max()) for places in (place_mm, chips_mm))
    if SPAN_MIN * chips_span_mm <= span_mm <= chips_span_mm / SPAN_MIN**2:
        return ""
    return (
        f"The {len(place_mm)} places span {span_mm:.3g} mm, but the chips of the layout span {chips_span_mm:.3g} mm. "
        "Probably the unit of the places is not mm: convert them to mm."
    )


def _warn_of_other_labels(folder: Path, others: Sequence[str], policy: FaultPolicy) -> None:
    """Warn if a capture's places seem rotated, mirrored or with x and y swapped.

    The places are compared with those of the latest captures in `others`, the names of the scene's other captures.
    """
    orientations = []
    presses = presses_of(open_capture(folder, policy)[1])
    for other in others[-COMPARED_N:]:
        if (folder.parent / other).is_dir():
            orientations.append(other_orientation(presses, presses_of(open_capture(folder.parent / other, policy)[1])))
    most_common = max(set(orientations), key=orientations.count, default=None)
    if most_common is not None:
        say(
            f"warning: capture {folder.name}: the places in this capture agree with the places in the scene's other "
            f"captures only {most_common}. Check whether columns are swapped, or whether the board was rotated. The "
            "recording was added anyway."
        )


@dataclass(frozen=True)
class Presses:
    """The presses of one capture: the place of each press, and the direction of its field change."""

    place_mm: Float[np.ndarray, "n 2"]  # relative to the middle of all places
    direction: Float[np.ndarray, "n ch"]  # unit vector along the mean field change


def presses_of(blocks: Iterable[Readings]) -> Presses:
    """Return at most `COMPARED_PRESSES_MAX_N` presses of a capture that have a known place."""
    try:
        presses = thin(pool(list(blocks), with_force=False), COMPARED_PRESSES_MAX_N)
    except SchemaError:  # no press has a known place
        return Presses(np.zeros((0, 2)), np.zeros((0, 0)))
    places, changes_uT = presses.place_mm, presses.db_uT.reshape(len(presses), -1)
    magnitude_uT = np.linalg.norm(changes_uT, axis=1)
    sound = np.isfinite(magnitude_uT) & (magnitude_uT > 0)
    middle_mm = (places[sound].max(axis=0) + places[sound].min(axis=0)) / 2 if sound.any() else 0.0
    return Presses(places[sound] - middle_mm, changes_uT[sound] / magnitude_uT[sound, None])


def other_orientation(own: Presses, others: Presses) -> str | None:
    """Return how the labels of `own` must be changed to agree with those of `others`, or None.

    The boards of a scene give similar readings for similar presses. Therefore, the place of each press of `own` is
    estimated as the mean place of the three presses of `others` whose field changes have the most similar directions.
    """
    comparable = own.direction.shape[1:] == others.direction.shape[1:]
    if not comparable or min(len(own.place_mm), len(others.place_mm)) < COMPARED_PRESSES_MIN_N:
        return None
    nearest = np.argsort(-own.direction @ others.direction.T, axis=1)[:, :3]
    looked_up_mm = others.place_mm[nearest].mean(axis=1)
    variance = max(float((looked_up_mm**2).mean()), 1e-12)
    explained = {
        name: 1 - float(((own.place_mm @ np.array(matrix).T - looked_up_mm) ** 2).mean()) / variance
        for name, matrix in ORIENTATIONS.items()
    }
    best = max(explained, key=lambda name: explained[name])
    is_better = explained[best] >= EXPLAINED_MIN and explained[best] - explained["as they are"] >= GAIN_MIN
    return best if is_better else None


@contextmanager
def _naming_sources(target: Path, files: Mapping[str, bytes | Path]) -> Iterator[None]:
    """In error messages, replace the paths of copied files by the paths of the user's files.

    If adding fails, the copies are deleted, so their paths would not help the user.
    """
    try:
        yield
    except ReskinError as error:
        sentence = str(error)
        for name, source in files.items():
            for copy in (str(target / name), f"{target.name}/{name}") if isinstance(source, Path) else ():
                sentence = sentence.replace(copy, str(source))
        raise type(error)(sentence) from None


@contextmanager
def _removing_on_failure(target: Path) -> Iterator[None]:
    try:
        yield
    except BaseException:
        _remove_files(target)
        raise


def _remove_files(target: Path) -> None:
    """Delete a capture's folder, its .dvc file and its line in .gitignore, and the scene's folder if it is empty."""
    io.remove(target)
    io.remove(target.with_name(f"{target.name}.dvc"))
    if target.parent.is_dir():
        ignored, line = target.parent / ".gitignore", f"/{target.name}"
        lines = ignored.read_text(encoding="utf-8").splitlines() if ignored.exists() else []
        if line in lines:
            lines.remove(line)
            io.write_text(ignored, "\n".join(lines) + "\n") if lines else io.remove(ignored)
        if not any(target.parent.iterdir()):
            target.parent.rmdir()


def _track(folder: Path, root: Path) -> None:
    """Track a folder with DVC like `dvc add`, but in this process, because starting another process takes seconds."""
    from dvc.exceptions import DvcException  # imported here, because the import takes a second
    from dvc.repo import Repo

    try:
        with Repo(str(root)) as repo:
            repo.scm_context.quiet = True  # otherwise DVC prints how to stage files with git
            repo.add([str(folder)])
    except (DvcException, OSError) as error:
        reason = " ".join(str(error).split())[-300:]
        raise CaptureError(
            f"dvc add {folder.relative_to(root)} failed: {reason}. The messages of DVC above give the details."
        ) from None

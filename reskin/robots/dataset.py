"""Write recordings as a LeRobot dataset, in format v3.0, which LeRobot 0.4 to 0.6 read and write.

The package lerobot is not needed. A dataset consists of episodes, which are sequences of frames at equal intervals of
time. The dataset is a folder with these files:

    meta/info.json                              features with their names and units, frames per second, totals
    meta/stats.json                             statistics of each feature over all frames
    meta/tasks.parquet                          the task
    meta/episodes/chunk-000/file-000.parquet    length, file and statistics of each episode
    meta/reskin.json                            recording, board, skin and source of each episode (not read by LeRobot)
    data/chunk-000/file-000.parquet             one row per frame

A feature is a named array with one row per frame. The names of features that a robot's sensors measure begin with
`observation.`, so that policies use these features as inputs. The names of features that a rig measured (place, depth,
force) begin with `label.`; LeRobot loads these features, but policies do not use them.
"""

import json
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from jaxtyping import Float, Float32, Int

from reskin import io
from reskin.errors import CaptureError, ParamsError, SchemaError
from reskin.recordings import clocks, probe
from reskin.recordings.header import PROBE_FILE, Header
from reskin.recordings.ingest import read_header
from reskin.recordings.loading import read_any_log
from reskin.recordings.readers import sd_card
from reskin.schema import from_table

VERSION = "v3.0"
FPS_MAX = 10_000
RATE_TOLERANCE = 0.05  # rates of recordings are treated as equal if their relative difference is at most this value
ROUNDING = 1e-6  # tolerance when times are compared, as a fraction of the time between frames
# If the time between two readings is longer than this, the earlier reading becomes outdated, so an episode ends there.
GAP_S = 0.3
LIMITS = {"chunks_size": 1000, "data_files_size_in_mb": 100, "video_files_size_in_mb": 200}  # for frames added later
PATH, FIRST = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet", {"chunk_index": 0, "file_index": 0}
QUANTILES = {f"q{percent:02d}": percent / 100 for percent in (1, 10, 50, 90, 99)}
FIELD, NOLOAD, TEMPERATURE = "observation.field_uT", "observation.noload_uT", "observation.temperature_degC"
LABELS = {
    "label.place_mm": ("x_mm", "y_mm"),
    "label.depth_mm": ("depth_mm",),
    "label.force_N": ("Fx_N", "Fy_N", "Fz_N"),
}
INDICES = {name: "float32" if name == "timestamp" else "int64" for name in (
    "timestamp", "frame_index", "episode_index", "index", "task_index",
)}  # fmt: skip


@dataclass(frozen=True)
class Recording:
    """The readings of one file.

    Parameters
    ----------
    where : name of the file in errors
    about : names of the capture, board, skin and source, as far as they are known
    values : the values of each feature; unknown values are NaN
    t_s : times of the readings; None if they are unknown
    part : for each reading, the number of the part of the recording to which it belongs, such as its indentation. Each
        part becomes an episode or, if it has gaps, several episodes.
    dropped_n : number of faulty frames in the file, which are omitted
    """

    where: str
    about: Mapping[str, str]
    values: Mapping[str, Float32[np.ndarray, "f _"]]
    t_s: Float[np.ndarray, " f"] | None
    part: Int[np.ndarray, " f"]
    dropped_n: int = 0


@dataclass(frozen=True)
class Episode:
    """The frames of one episode; `about` describes where they come from."""

    values: Mapping[str, Float32[np.ndarray, "f _"]]
    about: Mapping[str, str | int | float]

    def __len__(self) -> int:
        return len(self.values[FIELD])


def export_lerobot(
    files: Sequence[Path], out: Path, *, task: str, fps: int | None = None, rate_hz: float | None = None
) -> dict[str, float]:
    """Write recordings as a LeRobot dataset.

    Returns a dict with the number of episodes, the number of frames, the frame rate, the largest error of a timestamp,
    and the number of faulty frames that were omitted.

    Parameters
    ----------
    files : folders of captures (`reskin record`), tables of ingested readings (data/indentations), tables that
        `reskin decode` wrote, or logs of an SD card. A capture or log is one episode. In a table of ingested readings,
        each indentation is one episode. An episode is split where the time between two readings exceeds `GAP_S`.
    out : folder to create
    task : what the robot does, in natural language
    fps : frames per second of the dataset. If it is given, each frame is the latest reading at the frame's time. By
        default, each reading is a frame, and `fps` is the rate of the readings. LeRobot's timestamps are always
        multiples of 1 / fps, so they may differ from the times of the readings. The largest difference is returned.
    rate_hz : rate of the readings in files that contain no times

    Raises
    ------
    ReskinError : a file cannot be read, or has neither times nor a rate; or the files have different numbers of chips
        or different kinds of labels; or some files are simulated and others recorded
    """
    if out.exists():
        raise ParamsError(f"--out: {out} exists. Choose another folder.")
    if not task.strip():
        raise ParamsError("--task: the text is empty. Say what the robot does, such as 'press the skin'.")
    recordings = [read_recording(file, rate_hz) for file in files]
    features, resample = find_features(recordings), fps is not None
    fps = find_rate(recordings, rate_hz) if fps is None else fps
    if not 1 <= fps <= FPS_MAX:
        raise ParamsError(f"--fps: {fps} is not from 1 to {FPS_MAX:,}.")
    untimed = [recording.where for recording in recordings if recording.t_s is None]
    if untimed and resample:
        raise ParamsError(f"--fps: {untimed[0]} has no times, so its rate cannot be changed. Omit --fps.")
    parts = (split(recording, features, fps, resample=resample) for recording in recordings)
    episodes = [episode for part in parts for episode in part]
    with io.replacing(out) as folder:
        write_dataset(folder, episodes, features, task, fps)
    late_s = max(float(episode.about["timestamp_error_max_s"]) for episode in episodes)
    counts = {"episodes_n": len(episodes), "frames_n": sum(map(len, episodes)), "fps": fps}
    dropped_n = sum(recording.dropped_n for recording in recordings)
    return counts | {"timestamp_error_max_s": late_s, "dropped_faulty_frames_n": dropped_n}


# --- Reading ---


def read_recording(file: Path, rate_hz: float | None) -> Recording:
    """Read a capture, a table of ingested readings, a table of decoded frames, or the log of an SD card."""
    if file.is_dir():
        return _of_capture(file)
    if not file.is_file():
        raise SchemaError(f"{file}: file not found. Check the path.")
    if not io.is_parquet(file):
        return _of_log(str(file), {}, read_any_log(file, 1.0))
    table = io.read_table(file)
    if "indentation" in table.column_names:
        return _of_readings(table, str(file), rate_hz)
    if "device_s" in table.column_names and rate_hz is None and not _all_finite(table["device_s"]):
        raise ParamsError(f"{file}: the frames have no times. State their rate, for example with --rate-hz 400.")
    return _of_log(str(file), {}, read_any_log(file, rate_hz or 1.0))


def _of_log(
    where: str, about: Mapping[str, str], log: sd_card.Log, labels: Mapping[str, np.ndarray] | None = None
) -> Recording:
    t_s, b_uT, temperature_degC, account = log
    values = {FIELD: b_uT, TEMPERATURE: temperature_degC} | dict(labels or {})
    dropped_n = sum(count for name, count in account.items() if name.startswith("dropped_"))
    return Recording(where, about, values, t_s, np.zeros(len(t_s), int), dropped_n)


def _of_capture(folder: Path) -> Recording:
    header = read_header(folder)
    if header.layout not in ("native", "sd-card"):
        raise CaptureError(
            f"{folder}: a capture of layout {header.layout} cannot be exported. Run `reskin add` and `dvc repro`, and "
            f"export its table of ingested readings, data/indentations/SCENE/{header.capture}.parquet."
        )
    log = read_any_log(folder, 1.0)
    return _of_log(str(folder), _about(header), log, _labels(folder, header, log[0]))


def _about(header: Any) -> dict[str, str]:
    return {name: getattr(header, name) for name in ("capture", "board", "skin", "source")}


def _labels(folder: Path, header: Header, t_s: Float[np.ndarray, " f"]) -> dict[str, Float32[np.ndarray, "f _"]]:
    """Return the labels of each reading of a capture.

    These are the labels of the dwell in which the reading was taken. Readings between dwells have NaN.

    The result maps each feature to its values; it is empty if the capture has no probe log.
    """
    file = folder / PROBE_FILE
    if not file.is_file():
        return {}
    if not header.clock.marks:
        raise CaptureError(
            f"{folder}: the labels in {PROBE_FILE} are on another clock than the readings. Add the capture to a scene "
            "with `reskin add`, run `dvc repro`, and export the table of ingested readings."
        )
    log = probe.parse(file, str(file))
    probe_s = clocks.from_marks(np.array(header.clock.marks), str(folder)).probe_s(t_s)
    dwell_i = np.searchsorted(log.t_start_s, probe_s, "right") - 1
    inside = (dwell_i >= 0) & (probe_s <= log.t_end_s[dwell_i])
    return {
        feature: np.where(inside[:, None], np.stack([getattr(log, name)[dwell_i] for name in names], axis=1), np.nan)
        for feature, names in LABELS.items()
    }


def _of_readings(table: pa.Table, where: str, rate_hz: float | None) -> Recording:
    readings = from_table(table, where)
    values = {FIELD: readings.b_uT, NOLOAD: readings.noload_uT, TEMPERATURE: readings.temperature_degC}
    for feature, names in LABELS.items():
        values[feature] = np.stack([getattr(readings, name) for name in names], axis=1)
    timed = np.isfinite(readings.t_s).all()
    if not timed and rate_hz is None:
        raise ParamsError(f"{where}: the readings have no times. State their rate, for example with --rate-hz 100.")
    return Recording(where, _about(readings), values, readings.t_s if timed else None, readings.indentation)


def _all_finite(column: pa.ChunkedArray) -> bool:
    return bool(np.isfinite(np.asarray(column, np.float64)).all())


# --- Episodes ---


def find_features(recordings: Sequence[Recording]) -> dict[str, list[str]]:
    """Return the features of a dataset: a mapping from the name of each feature to the names of its components.

    Components that are unknown (NaN) in all readings are omitted. Raises `SchemaError` if the recordings differ in
    their features, or if some are simulated and others recorded.
    """
    first, *others = recordings
    features = _known(first)
    for other in others:
        problem = ""
        if (own := _known(other)) != features:
            names, own_names = ({name for part in each.values() for name in part} for each in (features, own))
            problem = f"only this recording or only {first.where} contains {', '.join(sorted(names ^ own_names))}"
        elif _source(other) != _source(first):
            problem = f"this recording is {_source(other)}, but {first.where} is {_source(first)}"
        if problem:
            raise SchemaError(f"{other.where}: {problem}. Export these recordings to different folders.")
    return features


def _source(recording: Recording) -> str:
    """Return "simulated" or "recorded"; a file that does not state its source counts as recorded."""
    return recording.about.get("source", "recorded")


def _known(recording: Recording) -> dict[str, list[str]]:
    """Return the features of one recording, each with the names of those components that are known in any reading."""
    chips_n = recording.values[FIELD].shape[1] // 3
    field = tuple(f"B{axis}{chip}_uT" for chip in range(chips_n) for axis in "xyz")
    temperature = tuple(f"T{chip}_degC" for chip in range(chips_n))
    names = {FIELD: field, NOLOAD: field, TEMPERATURE: temperature, **LABELS}
    known = {}
    for feature, values in recording.values.items():
        is_known = np.isfinite(values).any(axis=0)
        known[feature] = [name for name, kept in zip(names[feature], is_known, strict=True) if kept]
    return {feature: known[feature] for feature in names if known.get(feature)}


def find_rate(recordings: Sequence[Recording], rate_hz: float | None) -> int:
    """Return the median rate of the recordings, rounded to a whole number.

    Raises `ParamsError` if the rates differ by more than `RATE_TOLERANCE`, or if no rate is known.
    """
    found = [rate_hz if recording.t_s is None else _rate_hz(recording) for recording in recordings]
    rates = sorted(rate for rate in found if rate is not None)
    if not rates:
        raise ParamsError("--fps: no episode has two readings at different times. State the frame rate with --fps.")
    if rates[-1] > (1 + RATE_TOLERANCE) * rates[0]:
        got = f"{rates[0]:.4g} to {rates[-1]:.4g} Hz"
        raise ParamsError(
            f"--fps: the recordings have different rates, {got}. State the frame rate of the dataset with --fps."
        )
    return round(float(np.median(rates)))


def _rate_hz(recording: Recording) -> float | None:
    """Return the rate of a recording, from the median time between successive readings of the same part.

    The result is None if no part has readings at two different times.
    """
    assert recording.t_s is not None
    step_s = np.diff(recording.t_s)[np.diff(recording.part) == 0]
    return float(1 / np.median(step_s[step_s > 0])) if (step_s > 0).any() else None


def split(
    recording: Recording, features: Mapping[str, Sequence[str]], fps: int, *, resample: bool
) -> Iterator[Episode]:
    """Divide a recording into episodes.

    If `resample` is False, each reading is a frame. If it is True, a frame is the latest reading at the frame's time.
    """
    known = {feature: np.isfinite(recording.values[feature]).any(axis=0) for feature in features}
    values = {feature: recording.values[feature][:, mask].astype(np.float32) for feature, mask in known.items()}
    ends = np.diff(recording.part) != 0
    if recording.t_s is not None:
        step_s = np.diff(recording.t_s)
        if (~ends & (step_s < 0)).any():
            raise CaptureError(f"{recording.where}: the times go backwards. Split the file where they go backwards.")
        ends = ends | (step_s > GAP_S)
    for rows in np.split(np.arange(len(recording.part)), np.flatnonzero(ends) + 1):
        kept, late_s = rows, 0.0
        if recording.t_s is not None:
            since_s = recording.t_s[rows] - recording.t_s[rows[0]]
            frame_s = np.arange(int(since_s[-1] * fps + ROUNDING) + 1) / fps
            if resample:
                kept = rows[np.searchsorted(since_s, frame_s + ROUNDING / fps, "right") - 1]
            late_s = float(np.abs(since_s[kept - rows[0]] - np.arange(len(kept)) / fps).max())
        about: dict[str, str | int | float] = {"recording": Path(recording.where).name}
        about |= {"part": int(recording.part[rows[0]]), "skipped_readings_n": len(rows) - len(np.unique(kept))}
        about |= {"timestamp_error_max_s": round(late_s, 6)}
        yield Episode({feature: column[kept] for feature, column in values.items()}, {**recording.about, **about})


# --- Writing ---


def write_dataset(
    folder: Path, episodes: Sequence[Episode], features: Mapping[str, Sequence[str]], task: str, fps: int
) -> None:
    """Write all files of a dataset to a new folder. All frames are in one file, whatever its size."""
    described: dict[str, Any] = {
        name: {"dtype": "float32", "shape": [len(parts)], "names": list(parts)} for name, parts in features.items()
    }
    described |= {name: {"dtype": dtype, "shape": [1], "names": None} for name, dtype in INDICES.items()}
    starts = np.cumsum([0, *map(len, episodes)]).tolist()
    columns, rows = [], []
    for i, episode in enumerate(episodes):
        frame_i = np.arange(len(episode))[:, None]
        indices = {
            "timestamp": frame_i / fps, "frame_index": frame_i, "episode_index": np.full_like(frame_i, i),
            "index": starts[i] + frame_i, "task_index": np.zeros_like(frame_i),
        }  # fmt: skip
        columns.append(dict(episode.values) | {name: indices[name].astype(dtype) for name, dtype in INDICES.items()})
        row: dict[str, Any] = {"episode_index": i, "tasks": [task], "length": len(episode)}
        row |= {"dataset_from_index": starts[i], "dataset_to_index": starts[i + 1]}
        row |= {f"{kind}/{key}": number for kind in ("data", "meta/episodes") for key, number in FIRST.items()}
        for name, values in columns[-1].items():
            row |= {f"stats/{name}/{key}": value for key, value in statistics(values).items()}
        rows.append(row)
    joined = {name: np.concatenate([each[name] for each in columns]) for name in described}
    io.write_table(folder / "data" / PATH.format(**FIRST), _frame_table(joined))
    io.write_table(folder / "meta/episodes" / PATH.format(**FIRST), pa.Table.from_pylist(rows))
    io.write_table(folder / "meta/tasks.parquet", _task_table(task))
    io.write_json(folder / "meta/stats.json", {name: statistics(values) for name, values in joined.items()})
    io.write_json(folder / "meta/reskin.json", {"episodes": [dict(episode.about) for episode in episodes]})
    info = {
        "codebase_version": VERSION, "robot_type": "reskin", "total_episodes": len(episodes),
        "total_frames": starts[-1], "total_tasks": 1, **LIMITS, "fps": fps,
        "splits": {"train": f"0:{len(episodes)}"}, "data_path": f"data/{PATH}", "video_path": None,
        "features": described,
    }  # fmt: skip
    io.write_json(folder / "meta/info.json", info)


def _frame_table(columns: Mapping[str, Float[np.ndarray, "f _"] | Int[np.ndarray, "f _"]]) -> pa.Table:
    """Convert the values of features to a table with one row per frame.

    A feature with one component becomes a column of numbers; other features become columns of lists of fixed length.
    """
    arrays = {}
    for name, values in columns.items():
        flat, length = pa.array(np.ascontiguousarray(values).ravel()), values.shape[1]
        arrays[name] = flat if length == 1 else pa.FixedSizeListArray.from_arrays(flat, length)
    return pa.table(arrays)


def statistics(values: Float[np.ndarray, "f n"] | Int[np.ndarray, "f n"]) -> dict[str, list[float] | list[int]]:
    """Return the statistics that LeRobot stores for a feature, with one value for each component.

    Unknown values (NaN) are ignored. If all values of a component are unknown, its statistics are NaN.
    """
    exact = values.astype(float)
    with warnings.catch_warnings(action="ignore", category=RuntimeWarning):  # NumPy warns if all values are NaN
        least, greatest = np.nanmin(values, axis=0), np.nanmax(values, axis=0)
        moments = [least, greatest, np.nanmean(exact, axis=0), np.nanstd(exact, axis=0)]
        quantiles = np.nanquantile(exact, list(QUANTILES.values()), axis=0)
    names = ("min", "max", "mean", "std", *QUANTILES)
    return {"count": [len(values)]} | {name: v.tolist() for name, v in zip(names, [*moments, *quantiles], strict=True)}


def _task_table(task: str) -> pa.Table:
    """Return the table of tasks. When pandas reads it, the text of the task becomes the index of the data frame."""
    index = "__index_level_0__"
    described = {"name": None, "field_name": index, "pandas_type": "unicode", "numpy_type": "object", "metadata": None}
    metadata = {"index_columns": [index], "column_indexes": [], "columns": [described]}
    table = pa.table({"task_index": pa.array([0], pa.int64()), index: [task]})
    return table.replace_schema_metadata({"pandas": json.dumps(metadata)})

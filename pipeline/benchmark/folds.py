"""Folds of the benchmark: which presses a method may learn from and which presses it must predict.

Each dataset has a fold file (`benchmark/v1/*.json`). It lists the presses by role, as numbers, and contains the SHA-256
of the recorded files to which these numbers refer. The presses of a board are numbered from 0, in the order of the
board's recordings and then in the order of the presses in each recording. A published fold file never changes: a
correction needs a new version. This module also makes the arrays of each task, which methods receive.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any, Literal

import numpy as np
import pyarrow as pa
from jaxtyping import Float, Int64
from numpy.typing import ArrayLike
from pydantic import Field

from reskin import io
from reskin.code import ROOT
from reskin.config import Strict, parse
from reskin.display import one_line
from reskin.errors import ParamsError, SchemaError, did_you_mean
from reskin.recordings import ReaderLayout, header, preparing
from reskin.recordings.fault_policy import REFUSE_NONE
from reskin.recordings.readers import READERS

FOLDER = ROOT / "benchmark"
ENTRIES = "entries"  # a folder in FOLDER, beside those of the versions
VERSION = "v1"
FORMAT = "reskin-benchmark-1"
FETCHED = "data/fetched"  # where `reskin fetch` puts recordings, in the working directory
PLACE, FORCE = ("x_mm", "y_mm"), "F_N"  # columns of the predicted quantities

Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]{1,40}$")]
PressNumbers = tuple[Annotated[int, Field(ge=0)], ...]


class Recording(Strict):
    """A recording in a fold file.

    - path: path of the recording in the folder of recordings.
    - layout: format of the recording, which is a layout of `reskin add`, or `presses` for a Parquet file of simulated
      presses beside the fold file.
    - board: name of the board; None for layout `presses`, because the Parquet file contains the names of its boards.
    - options: options of `reskin add` for this layout.
    - files: SHA-256 of each file of the recording.
    """

    path: str
    layout: Literal[ReaderLayout, "presses"]
    board: Name | None
    options: dict[str, str]
    files: dict[str, Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]]


class Draw(Strict):
    """A random division of the presses of one tested board by role.

    - board, draw: names of the tested board and of this division.
    - train: training boards, whose presses are all labelled.
    - unlabelled: presses of the tested board whose places and forces methods do not receive.
    - labels: presses of the tested board that may be labelled; in a task with n labels, the first n of them are
      labelled.
    - tests: presses of the tested board whose places and forces are predicted.
    """

    board: Name
    draw: Name
    train: tuple[Name, ...]
    unlabelled: PressNumbers
    labels: PressNumbers
    tests: Annotated[PressNumbers, Field(min_length=1)]


class FoldFile(Strict):
    """Content of a fold file.

    - version, dataset, source: version of the benchmark, and name and kind of the dataset.
    - forces: whether forces are known, and therefore predicted.
    - about: description of the dataset.
    - seeds: seeds of the random draws.
    - labels_n: numbers of labels; each draw has one task for each of these numbers.
    - presses_n: number of presses of each board.
    - recordings, draws: the recordings of the dataset, and the divisions of their presses by role.
    """

    format: Literal["reskin-benchmark-1"]
    version: Name
    dataset: Name
    source: Literal["simulated", "recorded"]
    forces: bool
    about: str
    seeds: dict[str, int]
    labels_n: Annotated[tuple[Annotated[int, Field(ge=0)], ...], Field(min_length=1)]
    presses_n: dict[Name, int]
    recordings: Annotated[tuple[Recording, ...], Field(min_length=1)]
    draws: Annotated[tuple[Draw, ...], Field(min_length=1)]

    def fold(self, draw: Draw, labels_n: int) -> str:
        """Return the name of a fold, which predictions refer to."""
        return f"{self.version}.{self.dataset}.{draw.board}.{draw.draw}.labels{labels_n}"

    @cached_property
    def folds(self) -> dict[str, tuple[Draw, int]]:
        """The draw and the number of labels of each fold, by the fold's name."""
        return {self.fold(draw, n): (draw, n) for draw in self.draws for n in self.labels_n}


@dataclass(frozen=True)
class Presses:
    """A table with one row per press (the mean over its readings), or with one row per reading of the presses.

    - board: board of each row.
    - press: number of the press on its board.
    - recording: index of the recording that contains the press. In dataset lab, a recording contains all presses to one
      depth.
    - place_mm: x and y as recorded.
    - force_N: normal force; NaN if unknown.
    - noload_uT: field before the press.
    - db_uT: field during the press, minus `noload_uT`.
    """

    board: np.ndarray
    press: Int64[np.ndarray, " n"]
    recording: Int64[np.ndarray, " n"]
    place_mm: Float[np.ndarray, "n 2"]
    force_N: Float[np.ndarray, " n"]
    noload_uT: Float[np.ndarray, "n ch"]
    db_uT: Float[np.ndarray, "n ch"]

    __repr__ = one_line

    def __len__(self) -> int:
        return len(self.press)

    def __getitem__(self, rows: Any) -> "Presses":
        return Presses(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))


@dataclass(frozen=True)
class Task:
    """What a method may use to predict the tested presses of one fold.

    Attributes
    ----------
    fold, board, labels_n
        Name of the fold, tested board and number of its labelled presses.
    train, train_readings : Presses
        All presses of the training boards, with places and forces; and all single readings of these presses. Both are
        empty if there is no training board.
    noload_uT : array [ch]
        Mean field of the tested board without contact.
    unlabelled_uT : array [u ch]
        Field changes of presses at unknown places of the tested board.
    labels : Presses
        Labelled presses of the tested board.
    tests_uT : array [t ch]
        Field changes of the tested presses, in random order.
    """

    fold: str
    board: str
    labels_n: int
    train: Presses
    train_readings: Presses
    noload_uT: Float[np.ndarray, " ch"]
    unlabelled_uT: Float[np.ndarray, "u ch"]
    labels: Presses
    tests_uT: Float[np.ndarray, "t ch"]
    _tests: Int64[np.ndarray, " t"]

    __repr__ = one_line

    def predictions(
        self, place_mm: ArrayLike, force_N: ArrayLike | None = None, *, interval_90: ArrayLike | None = None
    ) -> pa.Table:
        """Return the rows of this fold for a file of predictions.

        Parameters
        ----------
        place_mm : array [t 2]
            Predicted x and y of the rows of `tests_uT`, in mm, in the coordinates of the labels.
        force_N : array [t], optional
            Predicted normal forces; omit them if the dataset has no forces.
        interval_90 : array [t 2 2] or [t 3 2], optional
            Limits (low, high) of 90 % intervals for x, y and, if given, the force.
        """
        t = len(self._tests)
        columns: dict[str, Any] = {"fold": [self.fold] * t, "press": self._tests}
        columns |= dict(zip(PLACE, self._checked("place_mm", place_mm, (t, 2)).T, strict=True))
        if force_N is not None:
            columns[FORCE] = self._checked("force_N", force_N, (t,))
        if interval_90 is not None:
            predicted = [*PLACE, *([FORCE] if force_N is not None else [])]
            limits = self._checked("interval_90", interval_90, (t, len(predicted), 2))
            for i, name in enumerate(predicted):
                columns |= dict(zip(limit_columns(name), limits[:, i].T, strict=True))
        return pa.table(columns)

    def _checked(self, name: str, values: ArrayLike, shape: tuple[int, ...]) -> np.ndarray:
        array = np.asarray(values, float)
        if array.shape != shape:
            remedy = "Make one prediction for each row of tests_uT."
            raise SchemaError(f"fold {self.fold}: {name} has shape {array.shape}, but must have {shape}. {remedy}")
        return array


@dataclass(frozen=True)
class Dataset:
    """A fold file, and the presses of its boards with all their readings."""

    folds: FoldFile
    presses: Mapping[str, Presses]
    readings: Mapping[str, Presses]
    _joined: dict[tuple[str, ...], tuple[Presses, Presses]] = field(default_factory=dict, init=False, repr=False)

    def tasks(self) -> list[Task]:
        """Return the tasks of all folds."""
        return [self.task(draw, labels_n) for draw, labels_n in self.folds.folds.values()]

    def task(self, draw: Draw, labels_n: int) -> Task:
        """Return the arrays that a method may use in one fold."""
        own, tests, at_rest = self.presses[draw.board], list(draw.tests), list(draw.unlabelled or draw.labels)
        train, train_readings = self._train(draw.train)
        return Task(
            self.folds.fold(draw, labels_n),
            draw.board,
            labels_n,
            train,
            train_readings,
            own.noload_uT[at_rest].mean(axis=0),
            own.db_uT[list(draw.unlabelled)],
            own[list(draw.labels[:labels_n])],
            own.db_uT[tests],
            own.press[tests],
        )

    def _train(self, boards: tuple[str, ...]) -> tuple[Presses, Presses]:
        """Return the presses of the training boards, and all readings of these presses.

        Draws with the same training boards share these arrays, to save memory.
        """
        if boards not in self._joined:
            none = [next(iter(self.presses.values()))[:0]]
            presses, readings = ([of_board[board] for board in boards] for of_board in (self.presses, self.readings))
            self._joined[boards] = join_presses(none + presses), join_presses(none + readings)
        return self._joined[boards]


def limit_columns(quantity: str) -> tuple[str, str]:
    """Return the names of the columns with the limits of the 90 % intervals of a quantity.

    >>> limit_columns("x_mm")
    ('x_low_mm', 'x_high_mm')
    """
    name, _, unit = quantity.rpartition("_")
    return f"{name}_low_{unit}", f"{name}_high_{unit}"


def sd_column(quantity: str) -> str:
    """Return the name of the column with the standard deviations of a quantity."""
    name, _, unit = quantity.rpartition("_")
    return f"{name}_sd_{unit}"


def tasks(dataset: str, data: Path | str | None = None, *, version: str = VERSION) -> list[Task]:
    """Return the tasks of a dataset: one for each tested board, draw of presses and number of labels.

    Parameters
    ----------
    dataset : str
        `lab`, `eflesh` or `simulated`.
    data : path, optional
        Folder of the recordings. Default: the folder to which `reskin fetch` writes them.

    Raises
    ------
    ReskinError
        If the dataset is unknown, or if its recordings are missing or differ from those in the fold file.
    """
    return read_dataset(dataset, data, version=version).tasks()


def read_folds(dataset: str, version: str = VERSION) -> FoldFile:
    """Read a fold file of the benchmark."""
    versions = sorted(folder.name for folder in FOLDER.iterdir() if folder.is_dir() and folder.name != ENTRIES)
    if version not in versions:
        raise ParamsError(f"benchmark: version {version!r} does not exist. Existing versions: {', '.join(versions)}.")
    names = sorted(file.stem for file in (FOLDER / version).glob("*.json"))
    if dataset not in names:
        guess = did_you_mean(dataset, names)
        known = f"Existing datasets: {', '.join(names) or 'none'}."
        raise ParamsError(f"benchmark {version}: dataset {dataset!r} does not exist. {known}{guess}")
    file = FOLDER / version / f"{dataset}.json"
    return parse(FoldFile, io.read_json(file), str(file))


def read_dataset(dataset: str, data: Path | str | None = None, *, version: str = VERSION) -> Dataset:
    """Read a fold file and the recordings that it lists; see `tasks`."""
    folds = read_folds(dataset, version)
    folder = FOLDER / version if folds.source == "simulated" else Path(data or Path(FETCHED) / dataset)
    presses, readings = read_boards(folder, folds.recordings)
    found_n = {board: len(own) for board, own in presses.items()}
    if found_n != folds.presses_n:
        rule = f"{folds.presses_n} as in benchmark {version}"
        remedy = "Use the release of this project that published these folds."
        raise SchemaError(folder, "the number of presses", rule, found_n, remedy)
    return Dataset(folds, presses, readings)


def read_boards(folder: Path, recordings: Sequence[Recording]) -> tuple[dict[str, Presses], dict[str, Presses]]:
    """Check the SHA-256 of all files and read them; return the presses and the readings of each board."""
    for name, digest in ((name, digest) for recording in recordings for name, digest in recording.files.items()):
        _check_file(folder / name, digest)
    by_board: dict[str, list[Presses]] = {}
    for recording in recordings:
        if recording.layout == "presses":
            simulated = read_simulated(folder / recording.path)
            for board in dict.fromkeys(simulated.board.tolist()):
                by_board.setdefault(board, []).append(simulated[simulated.board == board])
        else:
            parts = by_board.setdefault(str(recording.board), [])
            read = _read_recording(folder, recording)
            before_n = 1 + int(parts[-1].press.max()) if parts else 0
            parts.append(replace(read, press=read.press + before_n, recording=read.recording + len(parts)))
    readings = {board: join_presses(parts) for board, parts in by_board.items()}
    return {board: average_readings(own) for board, own in readings.items()}, readings


def average_readings(readings: Presses) -> Presses:
    """Average the readings of each press; presses must be numbered from 0."""
    press = readings.press
    count_n = np.bincount(press)[:, None]

    def mean(values: Float[np.ndarray, "f c"]) -> Float[np.ndarray, "n c"]:
        return np.stack([np.bincount(press, column) for column in values.T.astype(float)], axis=1) / count_n

    first = np.unique(press, return_index=True)[1]
    fields = mean(readings.noload_uT), mean(readings.db_uT)
    labels = mean(readings.place_mm), mean(readings.force_N[:, None])[:, 0]
    return Presses(readings.board[first], press[first], readings.recording[first], *labels, *fields)


def join_presses(parts: Sequence[Presses]) -> Presses:
    """Concatenate the presses of all parts."""
    return Presses(*(np.concatenate([getattr(part, name) for part in parts]) for name in Presses.__dataclass_fields__))


def _check_file(path: Path, digest: str) -> None:
    if not path.is_file():
        remedy = (
            "Run `reskin fetch` to download recordings, or state their folder with `--data`. The file of simulated "
            "presses is part of the repository: restore it with git."
        )
        raise SchemaError(f"{path}: file not found. {remedy}")
    if io.sha256(path) != digest:
        remedy = (
            "Run `reskin fetch` to download recordings again. The file of simulated presses is part of the repository: "
            "restore it with git."
        )
        raise SchemaError(f"{path}: the file is not the one of the benchmark, because its SHA-256 differs. {remedy}")


def _read_recording(folder: Path, recording: Recording) -> Presses:
    """Read the readings of a recording with the reader of its layout; its presses are numbered from 0."""
    names = preparing.CaptureNames(str(recording.board), "skin", None)
    layout: Any = recording.layout
    prepared = preparing.foreign(folder / recording.path, layout, names, recording.options)
    with TemporaryDirectory() as scratch:
        capture = Path(scratch) / prepared[0].capture
        readings, _ = READERS[layout].read(capture, header.write_capture(capture, *prepared), REFUSE_NONE)
    press = np.unique(readings.indentation, return_inverse=True)[1]
    place_mm, noload_uT = np.stack([readings.x_mm, readings.y_mm], axis=1), readings.noload_uT.astype(float)
    board, db_uT = np.full(len(press), recording.board), readings.b_uT - noload_uT
    force_N = readings.Fz_N.astype(float)
    return Presses(board, press, np.zeros_like(press), place_mm.astype(float), force_N, noload_uT, db_uT)


def read_simulated(file: Path) -> Presses:
    """Read simulated presses, as `write_simulated` wrote them."""
    table = io.read_table(file)
    columns = {name: np.asarray(table[name]) for name in (*PLACE, FORCE)}
    board, press = np.array(table["board"].to_pylist()), np.asarray(table["press"]).astype(np.int64)
    fields = [np.stack(table[name].to_numpy()).astype(float) for name in ("noload_uT", "b_uT")]
    place_mm, force_N = np.stack([columns["x_mm"], columns["y_mm"]], axis=1).astype(float), columns["F_N"].astype(float)
    return Presses(board, press, np.zeros_like(press), place_mm, force_N, fields[0], fields[1] - fields[0])


def write_simulated(file: Path, presses: Presses) -> None:
    """Write simulated presses in single precision, which is precise enough to store the steps of the chips exactly."""
    columns: dict[str, Any] = {"board": presses.board.tolist(), "press": presses.press.astype(np.int32)}
    columns |= {"x_mm": presses.place_mm[:, 0], "y_mm": presses.place_mm[:, 1], "F_N": presses.force_N}
    arrays = {name: pa.array(values) for name, values in columns.items()}
    arrays |= {name: arrays[name].cast(pa.float32()) for name in (*PLACE, FORCE)}
    for name, values in (("noload_uT", presses.noload_uT), ("b_uT", presses.noload_uT + presses.db_uT)):
        flat = pa.array(values.astype(np.float32).ravel())
        arrays[name] = pa.FixedSizeListArray.from_arrays(flat, values.shape[1])
    io.write_table(file, pa.table(arrays))

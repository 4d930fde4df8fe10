"""Files of predictions for the benchmark: write them, read them, and check them completely.

A file (CSV or Parquet) has one row for each tested press of each fold, in any order. docs/benchmark.md lists its
columns. Each fold has a number of labelled presses. A file may leave out all folds with the same number of labels, but
it may not leave out only some of them.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import pyarrow as pa
from jaxtyping import Bool, Float, Int64

from pipeline.benchmark.folds import FORCE, PLACE, Dataset, FoldFile, limit_columns, read_folds, sd_column
from reskin import io
from reskin.errors import ReskinError, SchemaError, did_you_mean
from reskin.recordings.tables import parse_csv, render_csv
from reskin.universal.force import NORMAL_90

DECIMALS = 4  # written decimals of predictions: 0.1 um and 0.1 mN
FIRST_LINE_N = 2  # number of the line with the first row of a CSV file
SHOWN_N = 5  # number of missing presses that an error lists
HELP = "See docs/benchmark.md."
# Beyond the following limits, predictions probably have a wrong unit or another origin. Even the predictions of poor
# methods are within the limits.
# Upper limit of the distance from the median predicted place to the middle of the pressed area, divided by the width of
# the area.
OFF_MIDDLE = 0.4
# Lower limit of the largest predicted coordinate, divided by the largest coordinate of the pressed area.
PLACE_MIN = 0.15
# Lower limit of the largest predicted force, and upper limit of the median predicted force, both divided by the largest
# true force.
FORCE_MIN, FORCE_MAX = 0.01, 10.0


@dataclass(frozen=True)
class Predictions:
    """Checked predictions of one dataset, with one row per tested press and fold, sorted by fold and press.

    - folds: fold file of the dataset.
    - fold, press: name of the fold and number of the press in each row.
    - place_mm, force_N: predicted place and force; `force_N` is None if no forces were predicted.
    - intervals: limits (low, high) of the 90 % intervals, by name of the quantity; empty if none were given.
    """

    folds: FoldFile
    fold: np.ndarray
    press: Int64[np.ndarray, " n"]
    place_mm: Float[np.ndarray, "n 2"]
    force_N: Float[np.ndarray, " n"] | None
    intervals: dict[str, Float[np.ndarray, "n 2"]]


def write(predicted: Sequence[pa.Table], file: Path | str) -> None:
    """Write the rows of `Task.predictions` of all folds to a .csv or .parquet file, rounded to four decimals."""
    path, table = Path(file), pa.concat_tables(predicted)
    for i, field in enumerate(table.schema):
        if pa.types.is_floating(field.type):
            table = table.set_column(i, field.name, pa.array(np.round(np.asarray(table[field.name]), DECIMALS)))
    if _suffix(path) == ".csv":
        io.write_text(path, render_csv(table))
    else:
        io.write_table(path, table)


def read_predictions(file: Path) -> Predictions:
    """Read and check a file of predictions, except for its units (`check_units`).

    Raises
    ------
    SchemaError
        If the file cannot be read, or if columns, rows or values are missing, repeated, unknown or not finite.
    """
    rows = _Rows(file, _read_table(file))
    folds = _folds_of(rows)
    _check_presses(rows, folds)
    if folds.forces != (FORCE in rows.table.column_names):
        what = f"column {FORCE} is missing" if folds.forces else f"column {FORCE} is not allowed"
        raise rows.error(None, f"{what}. Dataset {folds.dataset} {'has' if folds.forces else 'has no'} forces. {HELP}")
    quantities = [*PLACE, *([FORCE] if folds.forces else [])]
    for name in rows.table.column_names[2:]:
        rows.check(~np.isfinite(rows.number(name)), f"{name} is not a finite number")
    order = np.lexsort([rows.press, rows.fold])
    values = np.stack([rows.number(name) for name in quantities], axis=1)[order]
    intervals = {name: limits[order] for name in quantities if (limits := _interval(rows, name)) is not None}
    if (PLACE[0] in intervals) != (PLACE[1] in intervals):
        raise rows.error(None, f"intervals must be given for both x and y or for neither. {HELP}")
    force_N = values[:, 2] if folds.forces else None
    return Predictions(folds, rows.fold[order], rows.press[order], values[:, :2], force_N, intervals)


def check_units(file: Path, predictions: Predictions, dataset: Dataset) -> None:
    """Raise `SchemaError` if places or forces probably have a wrong unit or another origin."""
    boards, place_mm = list(dataset.presses.values()), predictions.place_mm
    pressed_mm = np.concatenate([presses.place_mm for presses in boards])
    least, most = pressed_mm.min(axis=0), pressed_mm.max(axis=0)
    area = " and ".join(f"{name} from {a:.3g} to {b:.3g}" for name, a, b in zip(PLACE, least, most, strict=True))
    if np.abs(place_mm).max() < PLACE_MIN * np.abs(pressed_mm).max():
        problem = f"all coordinates are within {np.abs(place_mm).max():.3g} of 0, but the presses have {area}"
        raise SchemaError(f"{file}: {problem}. Are they in m or cm instead of mm? {HELP}")
    median_mm = np.median(place_mm, axis=0)
    if (np.abs(median_mm - (least + most) / 2) > OFF_MIDDLE * (most - least)).any():
        problem = f"the median place is ({median_mm[0]:.4g}, {median_mm[1]:.4g}), but the presses have {area}"
        raise SchemaError(f"{file}: {problem}. Are places in mm, with the same origin as the labels? {HELP}")
    if predictions.force_N is not None:
        most_N, median_N = max(presses.force_N.max() for presses in boards), float(np.median(predictions.force_N))
        largest_N = float(np.abs(predictions.force_N).max())
        if not (largest_N >= FORCE_MIN * most_N and -FORCE_MIN * most_N <= median_N <= FORCE_MAX * most_N):
            problem = f"the median of F_N is {median_N:.3g} and its largest magnitude {largest_N:.3g}"
            remedy = "Are forces in N, and positive in compression?"
            raise SchemaError(f"{file}: {problem}, but the true forces are at most {most_N:.3g} N. {remedy} {HELP}")


@dataclass(frozen=True)
class _Rows:
    """The rows of a file of predictions, and functions that raise errors with the line of a row."""

    file: Path
    table: pa.Table

    @cached_property
    def fold(self) -> np.ndarray:
        return np.asarray(self.table["fold"].to_pylist(), str)

    @cached_property
    def press(self) -> Int64[np.ndarray, " n"]:
        return np.asarray(self.table["press"]).astype(np.int64)

    def number(self, name: str) -> Float[np.ndarray, " n"]:
        """Return a column of numbers; an empty cell is NaN."""
        return np.asarray(self.table[name].cast(pa.float64()).to_numpy(), float)

    def line(self, row_i: int) -> str:
        """Return the place of a row: its line in a CSV file, or its number, counted from 1, in a Parquet file."""
        return f"line {row_i + FIRST_LINE_N}" if self.file.suffix.lower() == ".csv" else f"row {row_i + 1}"

    def error(self, row_i: int | None, problem: str) -> SchemaError:
        return SchemaError(f"{self.file}{'' if row_i is None else f', {self.line(row_i)}'}: {problem}")

    def check(self, bad: Bool[np.ndarray, " n"], problem: str | Callable[[int], str]) -> None:
        """Raise an error for the first row that `bad` marks; `problem` is a text, or a function that describes it."""
        if bad.any():
            row_i = int(bad.argmax())
            more_n = int(bad.sum()) - 1
            more = f" The same error occurs in {more_n} more rows." if more_n else ""
            described = problem if isinstance(problem, str) else problem(row_i)
            end = "" if described.endswith("?") else "."
            raise self.error(row_i, f"{described}{end}{more} {HELP}")


def _suffix(file: Path) -> str:
    suffix = file.suffix.lower()
    if suffix not in (".csv", ".parquet"):
        raise SchemaError(f"{file}: the name of a file of predictions must end in .csv or .parquet. {HELP}")
    return suffix


def _read_table(file: Path) -> pa.Table:
    """Read a file and check the names and types of its columns."""
    optional = [FORCE, *(name for quantity in (*PLACE, FORCE) for name in (
        *limit_columns(quantity), sd_column(quantity)))]  # fmt: skip
    types = {"fold": pa.string(), "press": pa.int64(), **dict.fromkeys((*PLACE, *optional), pa.float64())}
    if _suffix(file) == ".csv":
        head = io.read_bytes(file).partition(b"\n")[0].decode("utf-8-sig", errors="replace")
        if not head.strip():
            raise SchemaError(f"{file}: line 1 is empty, but must contain the names of the columns. {HELP}")
        if "," not in head and (";" in head or "\t" in head):
            raise SchemaError(f"{file}: line 1 has no comma. Separate columns by commas. {HELP}")
        _check_columns(file, names := [name.strip() for name in head.split(",")], list(types), optional)
        try:
            table = parse_csv(file, {name: kind for name, kind in types.items() if name in names}, str(file))
        except ReskinError as error:
            raise SchemaError(str(error)) from None
    else:
        table = io.read_table(file)
        _check_columns(file, table.column_names, list(types), optional)
        table = table.select([name for name in types if name in table.column_names]).combine_chunks()
        try:
            table = table.cast(pa.schema([(name, types[name]) for name in table.column_names]))
        except (pa.ArrowInvalid, pa.ArrowNotImplementedError) as error:
            raise SchemaError(f"{file}: a column has a wrong type: {' '.join(str(error).split())}. {HELP}") from None
    rows = _Rows(file, table)
    if not len(table):
        raise rows.error(None, f"the file has no predictions. {HELP}")
    for name in ("fold", "press"):
        rows.check(np.asarray(table[name].is_null()), f"{name} is empty")
    return table


def _check_columns(file: Path, names: Sequence[str], known: Sequence[str], optional: Sequence[str]) -> None:
    for name in names:
        if not name:
            remedy = "With pandas, write the file with to_csv(..., index=False)."
            raise SchemaError(f"{file}: a column has no name. {remedy} {HELP}")
        if name not in known:
            raise SchemaError(f"{file}: column {name[:40]!r} is unknown.{did_you_mean(name, known)} {HELP}")
        if names.count(name) > 1:
            raise SchemaError(f"{file}: column {name} occurs twice. Remove one of them. {HELP}")
    if missing := [name for name in known if name not in (*names, *optional)]:
        raise SchemaError(f"{file}: column {', '.join(missing)} is missing. {HELP}")


def _folds_of(rows: _Rows) -> FoldFile:
    """Return the fold file that contains the folds of all rows."""
    version, dataset = [*str(rows.fold[0]).split("."), "", ""][:2]
    try:
        folds = read_folds(dataset, version)
    except ReskinError as error:
        raise rows.error(0, f"fold {str(rows.fold[0])[:80]!r} is unknown: {error} {HELP}") from None
    prefix = f"{version}.{dataset}."
    foreign = np.array([not name.startswith(prefix) for name in rows.fold])
    rows.check(foreign, lambda i: f"fold {rows.fold[i]} is not in {version}.{dataset}, to which the first row belongs. "
               "Write one file per dataset")  # fmt: skip
    unknown = ~np.isin(rows.fold, list(folds.folds))
    rows.check(unknown, lambda i: f"fold {rows.fold[i]} is unknown.{did_you_mean(rows.fold[i], folds.folds)}")
    return folds


def _check_presses(rows: _Rows, folds: FoldFile) -> None:
    """Check that every test press of each fold occurs once, and that no other press occurs."""
    first: dict[tuple[str, int], int] = {}
    wrong, repeated = np.zeros(len(rows.table), bool), np.zeros(len(rows.table), bool)
    tests = {name: set(draw.tests) for name, (draw, _) in folds.folds.items()}
    for i, key in enumerate(zip(rows.fold.tolist(), rows.press.tolist(), strict=True)):
        wrong[i] = key[1] not in tests[key[0]]
        repeated[i] = first.setdefault(key, i) != i
    rows.check(wrong, lambda i: f"press {rows.press[i]} is not tested in fold {rows.fold[i]}"
               f"{_role(folds, str(rows.fold[i]), int(rows.press[i]))}")  # fmt: skip
    rows.check(repeated, lambda i: f"press {rows.press[i]} of fold {rows.fold[i]} was predicted before, in "
               f"{rows.line(first[rows.fold[i], rows.press[i]])}")  # fmt: skip
    predicted = {folds.folds[name][1] for name in set(rows.fold.tolist())}
    for name, (_, labels_n) in folds.folds.items():
        if labels_n in predicted and (missing := sorted(press for press in tests[name] if (name, press) not in first)):
            shown = ", ".join(map(str, missing[:SHOWN_N])) + (", ..." if len(missing) > SHOWN_N else "")
            what = f"{len(missing)} of {len(tests[name])} tested presses of fold {name} are missing: {shown}"
            raise rows.error(None, f"{what}. Predict either all folds with {labels_n} labels or none. {HELP}")


def _role(folds: FoldFile, fold: str, press: int) -> str:
    """Describe the role in a fold of a press that is not tested; empty if the press has no role."""
    draw, labels_n = folds.folds[fold]
    if press in draw.labels[:labels_n]:
        return ", where it is labelled"
    return ", where it is unlabelled" if press in draw.unlabelled else ""


def _interval(rows: _Rows, quantity: str) -> Float[np.ndarray, "n 2"] | None:
    """Return the limits of the 90 % intervals of a quantity, from given limits or standard deviations, or else None."""
    sd, limits, names = sd_column(quantity), limit_columns(quantity), rows.table.column_names
    given = [name for name in limits if name in names]
    if sd in names:
        if given:
            remedy = "Give either standard deviations or limits."
            raise rows.error(None, f"both {sd} and {given[0]} are given. {remedy} {HELP}")
        values = rows.number(sd)
        rows.check(values < 0, f"{sd} is negative")
        half_width = NORMAL_90 * values
        return np.stack([rows.number(quantity) - half_width, rows.number(quantity) + half_width], axis=1)
    if len(given) == 1:
        raise rows.error(None, f"of {limits[0]} and {limits[1]}, only {given[0]} is given. Give both. {HELP}")
    if not given:
        return None
    low, high = (rows.number(name) for name in limits)
    rows.check(low > high, f"{limits[0]} is above {limits[1]}")
    return np.stack([low, high], axis=1)

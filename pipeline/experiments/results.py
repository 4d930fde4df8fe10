"""Read the captures of an experiment, and write its results."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float32, Int32

from pipeline.statistics import as_json
from reskin import io
from reskin.errors import SchemaError
from reskin.schema import Readings

Capture = TypeVar("Capture")
# The losses of an experiment without captures of its own. The losses of the main captures are in other results.
NO_LOSSES: Mapping[str, Any] = {"accounts": [], "left_out": {}}


def read_captures(indentations: Path, names: tuple[str, ...] = ()) -> list[Readings]:
    """Read the named captures of the folder `indentations` in alphabetical order; without names, read all of them."""
    files = [indentations / f"{name}.parquet" for name in sorted(names)] or sorted(indentations.glob("*.parquet"))
    if not files:
        remedy = "Run the stages ingest or ingest_many of this scene again with `dvc repro`."
        raise SchemaError(f"{indentations}: no captures in this folder. {remedy}")
    return [io.read_readings(file) for file in files]


def only(captures: Sequence[Capture], folder: Path) -> Capture:
    """Return the only capture in `captures`, which were read from `folder`; raise `SchemaError` unless there is one."""
    if len(captures) != 1:
        remedy = "Set skins_n: 1 for the protocol of the experiment in the scene's file, and run `dvc repro`."
        raise SchemaError(f"{folder}: {len(captures)} captures, but the experiment reads exactly one. {remedy}")
    return captures[0]


def group_by_level(
    db_uT: Float32[np.ndarray, "f ch"],
    indentation: Int32[np.ndarray, " f"],
    force_N: Float32[np.ndarray, " f"],
    *,
    levels_n: int,
    where: str,
) -> Float32[np.ndarray, "n p r ch"]:
    """Reshape readings to axes (filling of the glass, weight level, reading, channel).

    Successive readings with the same logged force form a stop, at one weight level. Raises `SchemaError` unless every
    filling has `levels_n` stops, all with the same number of readings.
    """
    starts = np.flatnonzero((np.diff(indentation) != 0) | (np.diff(force_N) != 0)) + 1
    stops = np.split(np.arange(len(force_N)), starts)
    fillings_n = len(np.unique(indentation))
    lengths = {len(stop) for stop in stops}
    if len(stops) != fillings_n * levels_n or len(lengths) != 1:
        got = f"{len(stops)} stops of {sorted(lengths)} readings in {fillings_n} fillings"
        rule = f"each filling needs {levels_n} stops, all with the same number of readings"
        raise SchemaError(f"{where}: {rule}; got {got}. Run stages simulate and ingest_simulated again.")
    return db_uT[np.stack(stops)].reshape(fillings_n, levels_n, lengths.pop(), -1)


def read_losses(indentations: Path, left_out: Mapping[str, int]) -> dict[str, Any]:
    """Return the losses of an experiment: the ingest counts of each capture in a folder, and the counts `left_out`.

    The ingest counts contain the numbers of lost readings. left_out: the number of rows that the experiment excluded,
    by reason.
    """
    accounts = [io.read_ingest_counts(file) for file in sorted(indentations.glob("*.parquet"))]
    return {"accounts": accounts, "left_out": dict(left_out)}


def write_results(
    results: Path,
    numbers: Mapping[str, Any] | Sequence[Any],
    drawn: Mapping[str, Any],
    losses: Mapping[str, Any] = NO_LOSSES,
    trainings: Mapping[str, int] | None = None,
) -> None:
    """Write the results of an experiment.

    numbers: the results that are added to numbers.json. drawn: data that only the figures need. losses: the result of
    `read_losses` if the experiment has captures of its own. trainings: the numbers of trained and of collapsed networks
    (see `pipeline.statistics.tally`).
    """
    content = {"numbers": as_json(numbers), "drawn": dict(drawn), "losses": dict(losses)}
    io.write_json(results, content if trainings is None else content | {"trainings": dict(trainings)})

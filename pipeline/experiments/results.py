"""Read the captures of an experiment, and write its results."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from reskin import io
from reskin.errors import SchemaError
from reskin.schema import Readings

Capture = TypeVar("Capture")
NO_LOSSES: Mapping[str, Any] = {"accounts": [], "left_out": {}}  # for an experiment on the main captures


def read_captures(indentations: Path, names: tuple[str, ...] = ()) -> list[Readings]:
    """Read the named captures of a folder, ordered by name; without names, all captures of the folder."""
    files = [indentations / f"{name}.parquet" for name in sorted(names)] or sorted(indentations.glob("*.parquet"))
    if not files:
        raise SchemaError(f"{indentations}: no captures in this folder. Ingest them again.")
    return [io.read_readings(file) for file in files]


def only(captures: Sequence[Capture], folder: Path) -> Capture:
    """Return the one capture of a folder; raise `SchemaError` if there are several."""
    if len(captures) != 1:
        remedy = "Run its protocol on one skin (skins_n: 1), and simulate it again."
        raise SchemaError(f"{folder}: {len(captures)} captures, but the experiment reads exactly one. {remedy}")
    return captures[0]


def read_losses(indentations: Path, left_out: Mapping[str, int]) -> dict[str, Any]:
    """Read how many readings each capture of a folder lost, and add the numbers of rows left out, by reason."""
    accounts = [io.read_ingest_counts(file) for file in sorted(indentations.glob("*.parquet"))]
    return {"accounts": accounts, "left_out": dict(left_out)}


def write_results(
    results: Path,
    numbers: Mapping[str, Any],
    drawn: Mapping[str, Any],
    losses: Mapping[str, Any] = NO_LOSSES,
    trainings: Mapping[str, int] | None = None,
) -> None:
    """Write the results of an experiment.

    numbers: part of numbers.json. drawn: data that only figures need. losses: `read_losses` of the experiment's own
    captures. trainings: how many networks were trained, and how many of them collapsed (`pipeline.statistics.tally`).
    """
    content = {"numbers": dict(numbers), "drawn": dict(drawn), "losses": dict(losses)}
    io.write_json(results, content if trainings is None else content | {"trainings": dict(trainings)})

"""What the modules of experiments share: reading the captures of a folder, and writing results."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from reskin import io
from reskin.errors import SchemaError
from reskin.schema import Readings

Capture = TypeVar("Capture")
NO_CAPTURES: Mapping[str, Any] = {"accounts": [], "left_out": {}}  # of its own: it asks the main ones


def read_folder(indentations: Path, names: tuple[str, ...] = ()) -> list[Readings]:
    """Read the named captures of a folder in order of name; without names, all that its one stage wrote."""
    files = [indentations / f"{name}.parquet" for name in sorted(names)] or sorted(indentations.glob("*.parquet"))
    if not files:
        raise SchemaError(str(indentations), "captures", "one or more", "none", "Ingest them again.")
    return [io.read_readings(file) for file in files]


def only(captures: Sequence[Capture], folder: Path) -> Capture:
    """Give the one capture of a folder; more than one is an error, not a choice."""
    if len(captures) != 1:
        remedy = "Ask its protocol of one skin (skins_n), and simulate it again."
        raise SchemaError(folder, "captures", "one, as its experiment reads no more", len(captures), remedy)
    return captures[0]


def read_losses(indentations: Path, left_out: Mapping[str, int]) -> dict[str, Any]:
    """Read the account of every capture of a folder, and note what was left out of its rows."""
    accounts = [io.read_account(file) for file in sorted(indentations.glob("*.parquet"))]
    return {"accounts": accounts, "left_out": dict(left_out)}


def write_results(
    results: Path, numbers: Mapping[str, Any], drawn: Mapping[str, Any], losses: Mapping[str, Any] = NO_CAPTURES,
    trainings: Mapping[str, int] | None = None,
) -> None:  # fmt: skip
    """Write what numbers.json takes over as it is, what only figures show, what was lost of captures of its own.

    `trainings` counts the networks that the stage trained, and those that collapsed.
    """
    words = {"numbers": dict(numbers), "drawn": dict(drawn), "losses": dict(losses)}
    io.write_json(results, words if trainings is None else words | {"trainings": dict(trainings)})

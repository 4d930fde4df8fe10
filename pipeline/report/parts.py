"""What the folders of experiments give to a report: `show.py` its tables and figures, `show.yaml` its words.

In: numbers.json and what only figures show. A question that was not asked shows nothing. Refuses to know results.
"""

from collections.abc import Iterable, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol, cast, runtime_checkable

import pandas as pd

from pipeline.scenes import EXPERIMENTS
from reskin.config import read_yaml

FOLDER = Path(__file__).parents[1] / "experiments"


@runtime_checkable
class Part(Protocol):
    """What `show.py` of each experiment offers."""

    def tables(self, numbers: Mapping[str, Any], source: str) -> dict[str, pd.DataFrame]:
        """Make its tables, by name."""

    def figures(self, numbers: Mapping[str, Any], drawn: Mapping[str, Any], source: str) -> dict[str, str]:
        """Draw its figures: SVG text by file name."""


def parts(numbers: Mapping[str, Any]) -> dict[str, Part]:
    """Import `show.py` of each experiment that was asked."""
    return {
        name: cast(Part, import_module(f"pipeline.experiments.{name}.show")) for name in EXPERIMENTS if name in numbers
    }


def experiment_tables(numbers: Mapping[str, Any], source: str) -> dict[str, pd.DataFrame]:
    """Make the tables of every experiment that was asked."""
    made = [part.tables(numbers[name], source) for name, part in parts(numbers).items()]
    return {name: table for tables in made for name, table in tables.items()}


def experiment_figures(numbers: Mapping[str, Any], drawn: Mapping[str, Any], source: str) -> dict[str, str]:
    """Draw the figures of every experiment that was asked."""
    made = [part.figures(numbers[name], drawn[name], source) for name, part in parts(numbers).items()]
    return {name: text for figures in made for name, text in figures.items()}


def add_sections(order: Iterable[Any]) -> list[dict[str, Any]]:
    """Put each experiment's section of the page where `order` has its name."""
    return _put({name: {"key": name} | words["section"] for name, words in _words().items()}, order)


def add_rows(order: Iterable[Any]) -> list[dict[str, Any]]:
    """Put each experiment's rows of the checklist where `order` has their ids; their stage is the experiment's."""
    rows = [row | {"stage": name} for name, words in _words().items() for row in words["checklist"]]
    return _put({row["id"]: row for row in rows}, order)


def _words() -> dict[str, Any]:
    files = {name: FOLDER / name / "show.yaml" for name in EXPERIMENTS}
    return {name: read_yaml(file) for name, file in files.items() if file.is_file()}


def _put(entries: dict[str, dict[str, Any]], order: Iterable[Any]) -> list[dict[str, Any]]:
    """Replace names by their entries; an entry that is not named comes last, so that a new one needs no edit."""
    named = [entries.pop(entry) if isinstance(entry, str) else entry for entry in order]
    return [*named, *entries.values()]

"""Which module shows which experiment. In: numbers.json and what only figures show. Out: tables and figures by name.

An experiment that was not asked shows nothing. Refuses to know what an experiment found.
"""

from collections.abc import Mapping
from importlib import import_module
from typing import Any, Protocol, cast, runtime_checkable

import pandas as pd

from pipeline.questions import EXPERIMENTS


@runtime_checkable
class Part(Protocol):
    """What each module of an experiment offers."""

    def tables(self, numbers: Mapping[str, Any], source: str) -> dict[str, pd.DataFrame]:
        """Make its tables, by name."""

    def figures(self, numbers: Mapping[str, Any], drawn: Mapping[str, Any], source: str) -> dict[str, str]:
        """Draw its figures: SVG text by file name."""


def parts(numbers: Mapping[str, Any]) -> dict[str, Part]:
    """Find what shows each experiment that was asked: `experiments.<name>.show`."""
    asked = [name for name in EXPERIMENTS if name in numbers]
    return {name: cast(Part, import_module(f"pipeline.experiments.{name}.show")) for name in asked}


def experiment_tables(numbers: Mapping[str, Any], source: str) -> dict[str, pd.DataFrame]:
    """Make the tables of every experiment that was asked."""
    made = [part.tables(numbers[name], source) for name, part in parts(numbers).items()]
    return {name: table for tables in made for name, table in tables.items()}


def experiment_figures(numbers: Mapping[str, Any], drawn: Mapping[str, Any], source: str) -> dict[str, str]:
    """Draw the figures of every experiment that was asked."""
    made = [part.figures(numbers[name], drawn[name], source) for name, part in parts(numbers).items()]
    return {name: text for figures in made for name, text in figures.items()}

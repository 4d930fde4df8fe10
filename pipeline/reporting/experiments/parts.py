"""Which module shows which experiment. In: numbers.json and what only figures show. Out: tables and figures by name.

An experiment that was not asked shows nothing. Refuses to know what an experiment found.
"""

from collections.abc import Mapping
from typing import Any, Protocol

import pandas as pd

from pipeline.reporting.experiments import (
    ambient,
    contacts,
    drift,
    dynamics,
    flexible,
    logs,
    manual,
    sensitivity,
    shear,
    sleeve,
    variation,
)


class Part(Protocol):
    """What each module of an experiment offers."""

    def tables(self, numbers: Mapping[str, Any], source: str) -> dict[str, pd.DataFrame]:
        """Make its tables, by name."""

    def figures(self, numbers: Mapping[str, Any], drawn: Mapping[str, Any], source: str) -> dict[str, str]:
        """Draw its figures: SVG text by file name."""


PARTS: dict[str, Part] = {
    "variation": variation,
    "drift": drift,
    "shear": shear,
    "manual": manual,
    "flexible": flexible,
    "sensitivity": sensitivity,
    "logs": logs,
    "sleeve": sleeve,
    "contacts": contacts,
    "ambient": ambient,
    "dynamics": dynamics,
}


def experiment_tables(numbers: Mapping[str, Any], source: str) -> dict[str, pd.DataFrame]:
    """Make the tables of every experiment that was asked."""
    asked = [question for question in PARTS if question in numbers]
    return {name: table for one in asked for name, table in PARTS[one].tables(numbers[one], source).items()}


def experiment_figures(numbers: Mapping[str, Any], drawn: Mapping[str, Any], source: str) -> dict[str, str]:
    """Draw the figures of every experiment that was asked."""
    asked = [question for question in PARTS if question in numbers]
    return {name: text for one in asked for name, text in PARTS[one].figures(numbers[one], drawn[one], source).items()}

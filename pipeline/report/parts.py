"""What experiments add to a report: tables and figures from their modules, captions from their YAML files."""

from collections.abc import Iterable, Mapping
from importlib import import_module
from types import ModuleType
from typing import Any

import pandas as pd

from pipeline.catalogue import experiment_files
from pipeline.scenes import ANALYSES, EXPERIMENTS
from pipeline.stages import module_name


def modules(numbers: Mapping[str, Any]) -> dict[str, ModuleType]:
    """Import the module of each experiment with results in numbers.json, by its key there."""
    keys = {name: EXPERIMENTS[name].key for name in ANALYSES}
    return {key: import_module(module_name(name)) for name, key in keys.items() if key in numbers}


def experiment_tables(numbers: Mapping[str, Any], source: str) -> dict[str, pd.DataFrame]:
    """Make the tables of every experiment that was asked."""
    made = [module.tables(numbers[key], source) for key, module in modules(numbers).items()]
    return {name: table for tables in made for name, table in tables.items()}


def experiment_figures(numbers: Mapping[str, Any], drawn: Mapping[str, Any], source: str) -> dict[str, str]:
    """Draw the figures of every experiment that was asked."""
    made = [module.figures(numbers[key], drawn[key], source) for key, module in modules(numbers).items()]
    return {name: text for figures in made for name, text in figures.items()}


def add_sections(order: Iterable[Any]) -> list[dict[str, Any]]:
    """Put each experiment's section of the page where `order` has its name."""
    files = experiment_files().items()
    return _put({name: {"key": name} | file.section for name, file in files if file.section is not None}, order)


def add_rows(order: Iterable[Any]) -> list[dict[str, Any]]:
    """Put each experiment's rows of the checklist where `order` has their ids; their stage is the experiment's."""
    rows = [row | {"stage": name} for name, file in experiment_files().items() for row in file.checklist]
    return _put({row["id"]: row for row in rows}, order)


def _put(entries: dict[str, dict[str, Any]], order: Iterable[Any]) -> list[dict[str, Any]]:
    """Replace names by their entries; an entry that is not named comes last, so that a new one needs no edit."""
    named = [entries.pop(entry) if isinstance(entry, str) else entry for entry in order]
    return [*named, *entries.values()]

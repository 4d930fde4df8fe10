"""Numbers and figures that experiments add to a report; their tables are in `pipeline.report.tables`."""

from collections.abc import Mapping
from importlib import import_module
from types import ModuleType
from typing import Any

import pandas as pd

from pipeline.catalogue import ANALYSES, EXPERIMENTS, module_name
from pipeline.scores import select


def experiment_numbers(results: Mapping[str, Any], table: pd.DataFrame) -> dict[str, Any]:
    """Return the numbers of experiments: those that they measured, and summaries of their rows of the table of scores.

    results: content of the files that the experiments wrote, by experiment.
    """
    numbers = {}
    for name, result in results.items():
        module = import_module(module_name(name))
        scores = select(table, experiment=name)
        numbers[name] = module.summarise(scores, result["numbers"]) if EXPERIMENTS[name].scores else result["numbers"]
    return numbers


def experiment_figures(numbers: Mapping[str, Any], plot_data: Mapping[str, Any], source: str) -> dict[str, str]:
    """Draw the figures of every experiment with results in numbers.json: SVG text by file name.

    plot_data: data that are only in figures, by the experiment's key in numbers.json.
    """
    figures: dict[str, str] = {}
    for key, module in _modules(numbers).items():
        if hasattr(module, "figures"):
            figures |= module.figures(numbers[key], plot_data[key], source)
    return figures


def _modules(numbers: Mapping[str, Any]) -> dict[str, ModuleType]:
    """Import the module of each experiment with results in numbers.json, by its key there."""
    return {name: import_module(module_name(name)) for name in ANALYSES if name in numbers}

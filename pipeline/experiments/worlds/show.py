"""What decides table 2, told: numbers -> one table, one figure. Sees no training, no physics and no path."""

from collections.abc import Mapping, Sequence
from typing import Any

import pandas as pd

from pipeline.report.drawing import COLOURS, MARKERS, drawing, svg
from pipeline.report.formatting import COLUMNS, SHORT, show, tabulate
from pipeline.report.paper import TABLE_2

DEFAULT = "default"
FACTORS = {
    "residual": "error that the law leaves, part of |dB|", "skin_modulus": "spread of stiffness (sd of the logarithm)",
    "amplitude_and_gap": "spreads of amplitude and gap, times the default", "friction": "friction under the tip",
}  # fmt: skip
DRAWN = ("accuracy_pct", "mse_xy_mm2", "mse_f_N2")
MEANING = (
    "Each world differs from the default in one thing; the same skins, presses, noise and folds in all. Law's error: "
    "the largest is what the fitted law leaves on recorded boards (scene lab, 1 - explained), alike over "
    "{residual_length_mm:g} mm, {residual_own_share:.0%} of its variance one skin's own; simulated skins of all other "
    "scenes have none. {folds_n} boards held out in turn, {steps_n} steps, one network each."
)
DEFAULTS = {"residual": 0.0, "amplitude_and_gap": 1.0}  # of the other factors: among the numbers


def tables(numbers: Mapping[str, Any], source: str) -> dict[str, pd.DataFrame]:
    """List each world's rows of table 2."""
    lines = [
        {"world": _say(world), "row": SHORT[row], "source": source}
        | {title: show(world[row].get(metric)) for metric, title in COLUMNS.items()}
        for world in numbers["by_world"]
        for row in TABLE_2
    ]
    return {"worlds": tabulate(lines, meaning=MEANING.format(**numbers))}


def figures(numbers: Mapping[str, Any], drawn: Mapping[str, Any], source: str) -> dict[str, str]:
    """Draw the rows of table 2 against each factor; the default is where all panels of a row meet."""
    with drawing(11.0, 7.6) as figure:
        panels = figure.subplots(len(DRAWN), len(FACTORS), sharey="row", squeeze=False)
        for column, (factor, words) in enumerate(FACTORS.items()):
            found = _along(numbers, factor)
            for row, metric in enumerate(DRAWN):
                _draw(panels[row][column], found, metric, default=_default(numbers, factor))
            panels[-1][column].set_xlabel(words, fontsize=8)
        for row, metric in enumerate(DRAWN):
            panels[row][0].set_ylabel(COLUMNS[metric].replace(", ", " / "))
        handles = panels[0][0].get_legend_handles_labels()
        figure.legend(*handles, loc="outside lower center", ncols=5, frameon=False, fontsize=9)
        title = f"What decides table 2 ({source}; dotted: the default, dashed: the paper)"
        figure.suptitle(title, x=0.01, ha="left", fontsize=11)
        return {"worlds.svg": svg(figure)}


def _draw(axes: Any, found: Sequence[tuple[float, Mapping[str, Any]]], metric: str, *, default: float) -> None:
    values = [value for value, _ in found]
    for (row, paper), colour, marker in zip(TABLE_2.items(), COLOURS, MARKERS, strict=False):
        means = [world[row][metric]["mean"] for _, world in found]
        axes.plot(values, means, color=colour, marker=marker, markersize=5, linewidth=1.2, label=SHORT[row])
        axes.axhline(paper[metric][0], color=colour, linestyle="--", linewidth=0.8)
    axes.axvline(default, color="0.5", linestyle=":", linewidth=1, label="default")
    if metric != "accuracy_pct":
        axes.set_yscale("log")
    axes.grid(alpha=0.25)


def _along(numbers: Mapping[str, Any], factor: str) -> list[tuple[float, Mapping[str, Any]]]:
    worlds = [(world["value"], world) for world in numbers["by_world"] if world["factor"] == factor]
    own = next(world for world in numbers["by_world"] if world["factor"] == DEFAULT)
    return sorted([*worlds, (_default(numbers, factor), own)], key=lambda pair: pair[0])


def _default(numbers: Mapping[str, Any], factor: str) -> float:
    return DEFAULTS[factor] if factor in DEFAULTS else float(numbers[factor])


def _say(world: Mapping[str, Any]) -> str:
    return "default" if world["factor"] == DEFAULT else f"{FACTORS[world['factor']]}: {world['value']:g}"

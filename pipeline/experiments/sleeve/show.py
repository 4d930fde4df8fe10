"""Table and map of question sleeve: one large skin over many boards. In: its numbers and what only the map shows.

Out: a table, SVG text. Refuses to know how places were learned.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

from pipeline.report.drawing import COLOURS, drawing, svg
from pipeline.report.formatting import COLUMNS, scores, show, tabulate
from pipeline.report.paper import SLEEVE, SLEEVE_SKIN, SLEEVE_WORDS

PLACES = {"median_error_mm": "median error, mm", "p95_error_mm": "95 % within, mm"}
PARTS = {"near_seam": "median near a border of boards, mm", "inside": "median elsewhere, mm"}
NO_NUMBER = "none: a demonstration"
SPREAD = "± is the standard deviation over the network seeds that column `seeds` counts."
NAMES = {"knn-raw": "k nearest neighbours (dB)", "knn-shape": "k nearest neighbours (shape of dB)"}
NETWORK = "the paper's network"


def tables(numbers: Mapping[str, Any], source: str) -> dict[str, pd.DataFrame]:
    """Put every method's places beside each other, and the set-up beside the paper's."""
    lines = [_line(NETWORK, numbers, source)]
    lines += [
        _line(NAMES.get(name, f"network, recipe {name}"), one, source) for name, one in numbers["variants"].items()
    ]
    near_n, inside_n = (numbers[part]["pokes_n"] if part in numbers else 0 for part in PARTS)
    meaning = (
        f"Trained on the first {numbers['trained_n']} pokes of one skin, tested on its last {numbers['tested_n']}: "
        f"{near_n} of them less than {numbers['near_mm']:g} mm from a border of two boards, {inside_n} elsewhere. "
        f"The paper prints no number here: {SLEEVE_WORDS}."
    )
    return {"sleeve": tabulate(lines, meaning=meaning, spread=SPREAD), "sleeve_set_up": _set_up(numbers, source)}


def figures(numbers: Mapping[str, Any], drawn: Mapping[str, Any], source: str) -> dict[str, str]:
    """Map the whole skin: every tested poke, coloured by its error, over chips and borders of boards."""
    with drawing(6.2, 3.5) as figure:
        axes = figure.subplots()
        _under_the_skin(axes, drawn)
        most_mm = numbers["p95_error_mm"]["mean"]
        size = float(np.clip(12_000 / len(drawn["x_mm"]), 10, 60))
        # The long side lies: y runs to the right.
        points = axes.scatter(
            drawn["y_mm"], drawn["x_mm"], c=drawn["error_mm"], s=size, cmap="viridis", vmin=0.0, vmax=most_mm,
            edgecolors="white", linewidths=0.3, zorder=3,
        )  # fmt: skip
        bar = figure.colorbar(points, label="place error, first seed / mm", extend="max", shrink=0.8)
        bar.ax.tick_params(labelsize=9)
        axes.set(xlabel="y / mm", ylabel="x / mm", aspect="equal")
        median = show(numbers["median_error_mm"])
        over = f"over {numbers['median_error_mm']['n']} network seeds"
        title = f"Held-out pokes over {numbers['chips_n']} chips ({source})\nmedian error {median} mm {over}"
        figure.suptitle(title, x=0.01, ha="left", fontsize=10)
        figure.legend(loc="outside lower left", ncols=3, frameon=False, fontsize=9)
        return {"sleeve.svg": svg(figure)}


def _under_the_skin(axes: Any, drawn: Mapping[str, Any]) -> None:
    x_mm, y_mm = drawn["area_mm"]
    thin = {"color": "0.5", "linewidth": 0.8, "zorder": 1}
    axes.vlines(drawn["borders_y_mm"], 0, x_mm, **thin, label="border of two boards")
    axes.hlines(drawn["borders_x_mm"], 0, y_mm, **thin)
    axes.plot([0, y_mm, y_mm, 0, 0], [0, 0, x_mm, x_mm, 0], color=COLOURS[0], linewidth=1.2, label="edge of the skin")
    chips = {"marker": "+", "s": 45, "color": COLOURS[2], "linewidths": 1.2, "zorder": 4, "label": "chip"}
    axes.scatter(drawn["chips_y_mm"], drawn["chips_x_mm"], **chips)
    axes.set(xlim=(-1.5, y_mm + 1.5), ylim=(-1.5, x_mm + 1.5))
    for side in ("left", "bottom"):
        axes.spines[side].set_visible(False)


def _line(name: str, one: Mapping[str, Any], source: str) -> dict[str, str]:
    line = {"method": name, "source": source} | scores(one, COLUMNS | PLACES)
    for part, title in PARTS.items():
        line[title] = show(one[part]["median_error_mm"]) if part in one else "–"
    return line | {"paper": NO_NUMBER, "seeds": str(one["accuracy_pct"]["n"])}


def _set_up(numbers: Mapping[str, Any], source: str) -> pd.DataFrame:
    printed = {"chips": str(SLEEVE["chips_n"]), "rate, Hz": f"{SLEEVE['rate_hz']:g}", "skin, mm": SLEEVE_SKIN}
    ours = {
        "chips": str(numbers["chips_n"]),
        "rate, Hz": f"{numbers['rate_hz']:.1f}",
        "skin, mm": "{:g} x {:g}".format(*numbers["area_mm"]),
    }
    return tabulate(
        [{"what": what, "ours": one, "paper": printed[what], "source": source} for what, one in ours.items()]
    )

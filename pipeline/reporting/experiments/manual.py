"""Adaptation by hand, told: numbers -> a table beside the paper's numbers. Refuses to know how it was adapted."""

from collections.abc import Mapping
from typing import Any

import pandas as pd

from pipeline.reporting.paper import MANUAL, MANUAL_POKES_N
from pipeline.reporting.shown import COLUMNS, show, show_difference, tabulate

ARMS = {
    "before": "before",
    "after": "adapted by hand",
    "control": "as long, without pokes",
    "grid": "adapted by as many pokes of the robot",
}
PAIRED = {
    "after_minus_before": "by hand less before, on the same skin",
    "after_minus_control": "by hand less without pokes, on the same skin",
    "after_minus_grid": "by hand less by the robot, on the same skin",
}


def tables(numbers: Mapping[str, Any], source: str) -> dict[str, pd.DataFrame]:
    """Show the arms, then their differences skin by skin."""
    shown = [(ARMS[arm], numbers[arm], MANUAL.get(arm, {}), show) for arm in ARMS if arm in numbers]
    differences = numbers["paired"]
    shown += [(PAIRED[one], differences[one], {}, show_difference) for one in PAIRED if one in differences]
    lines = []
    for name, ours, paper, words in shown:
        line = {"networks": name, "source": source}
        for metric, title in COLUMNS.items():
            line[f"{title} (ours)"] = words(ours.get(metric))
            line[f"{title} (paper)"] = f"{paper[metric]:g}" if metric in paper else "–"
        lines.append(line | {"n": str(ours["accuracy_pct"]["n"])})
    meaning = (
        f"{numbers['pokes_n']} pokes by hand a skin, along {numbers['lines_n']} lines of which only the order is known "
        f"(paper: {MANUAL_POKES_N}); tested on the robot's grid of the same skin, by networks that never saw its board."
    )
    spread = f"± is the sd over n skins, each the mean of {numbers['seeds_n']} networks."
    return {"manual": tabulate(lines, meaning=meaning, spread=spread)}


def figures(numbers: Mapping[str, Any], drawn: Mapping[str, Any], source: str) -> dict[str, str]:
    """Nothing: a table says it all."""
    return {}

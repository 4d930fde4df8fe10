"""Adaptation by hand, told: numbers -> a table beside the paper's numbers. Refuses to know how it was adapted."""

from collections.abc import Mapping
from typing import Any

import pandas as pd

from pipeline.report.formatting import COLUMNS, OF_PAPER, Stat, gain, show, show_difference, tabulate
from pipeline.report.paper import GAINS, MANUAL, MANUAL_POKES_N
from pipeline.report.statistics import VERDICTS, verdict

ARMS = {
    "before": "before",
    "after": "adapted by hand",
    "control": "as long, without pokes",
    "grid": "adapted by as many pokes of the robot",
}
GAINED = {"after_minus_before": GAINS["by_hand"]}
PAIRED = {
    "after_minus_before": "by hand less before, on the same skin",
    "after_minus_control": "by hand less without pokes, on the same skin",
    "after_minus_grid": "by hand less by the robot, on the same skin",
}


def tables(numbers: Mapping[str, Any], source: str) -> dict[str, pd.DataFrame]:
    """Show the arms, then their differences skin by skin."""
    shown = [(ARMS[arm], numbers[arm], MANUAL.get(arm, {}), _shown) for arm in ARMS if arm in numbers]
    differences = numbers["paired"]
    shown += [(PAIRED[one], differences[one], GAINED.get(one, {}), _judged) for one in PAIRED if one in differences]
    lines = []
    for name, ours, paper, words in shown:
        line = {"networks": name, "source": source}
        for metric, title in COLUMNS.items():
            line[f"{title} (ours)"] = words(ours.get(metric), metric)
            if metric in OF_PAPER:
                line[f"{title} (paper)"] = f"{paper[metric]:g}" if metric in paper else "–"
        lines.append(line | {"n": str(ours["accuracy_pct"]["n"])})
    meaning = (
        f"{numbers['pokes_n']} pokes by hand a skin, along {numbers['lines_n']} lines of which only the order is known "
        f"(paper: {MANUAL_POKES_N}); tested on the robot's grid of the same skin, by networks that never saw its "
        f"board. Differences: whether by hand is better. {VERDICTS}"
    )
    spread = (
        f"[low, high] is the 95 % interval over n boards, each skin the mean of {numbers['seeds_n']} networks. "
        f"± (seeds) is the standard deviation over {numbers['seeds_n']} network seeds on one skin, mean over skins; of "
        "a difference, that of the differences of equal seeds."
    )
    return {"manual": tabulate(lines, meaning=meaning, spread=spread)}


def _shown(stat: Stat | None, metric: str) -> str:
    return show(stat)


def _judged(stat: Stat | None, metric: str) -> str:
    """Say whether a difference is a gain, before its size."""
    return "–" if stat is None else f"{verdict(gain(stat, metric))}: {show_difference(stat)}"


def figures(numbers: Mapping[str, Any], drawn: Mapping[str, Any], source: str) -> dict[str, str]:
    """Nothing: a table says it all."""
    return {}

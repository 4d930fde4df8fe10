"""The order of the paper's rows: numbers.json -> tables of paired differences, and a verdict on each claim.

Refuses to know why a claim does not hold.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from math import sqrt
from typing import Any

import pandas as pd

from pipeline.reporting.paper import ADAPTED_POKES_N, TABLE_2, TABLE_2_ROWS, Number
from pipeline.reporting.shown import COLUMNS, Stat, n_of, show_difference, tabulate

FEW_POINTS = 5.0  # assumed: the paper's own drop is 3.4 points, "slightly affects performance"
FAR_SDS = 2.0  # assumed: the paper's own means are 5.1 of these apart
SURE_ERRORS = 2.0  # standard errors: about 95 %
ALONE = "Leave-one-board-out, one training skin"
CONTROL = "Control: fine-tuned as long, without the new skin's pokes (ours)"
SHORT = {
    "single": "single-sensor", "multi": "multi-sensor", "triplet": "multi-sensor + triplet", "adapted": "adapted",
    "control": "control",
}  # fmt: skip
SPREAD_OF_PAIRS = "± is the sd over n held-out skins, each the mean of its seeds."
ORDER = (
    f"The verdict stands before the difference of the means. Far better: the difference is more than {FAR_SDS:g} times "
    f"the root mean square of both rows' sd. Within a few points: at most {FEW_POINTS:g} points of accuracy. Better: "
    "the mean of the paired differences is on the right side of 0; the verdict says where that is within "
    f"{SURE_ERRORS:g} standard errors of 0 (sd over the root of n, as if skins of one board, which share a model, were "
    "independent)."
)


@dataclass(frozen=True)
class Model:
    """A row of table 2: what it is called, also in short, and what the paper says about the same (empty: nothing)."""

    title: str
    short: str
    paper: Mapping[str, Number]


def models(numbers: Mapping[str, Any]) -> dict[str, Model]:
    """Name the rows of table 2 in the paper's order; names say so where nothing was pooled, with one training skin."""
    titles = TABLE_2_ROWS | {"control": CONTROL}
    if "adapt" in numbers and numbers["adapt"]["pokes_n"] != ADAPTED_POKES_N:
        own = f"{numbers['adapt']['pokes_n']} indentations (paper: {ADAPTED_POKES_N})"
        titles["adapted"] = titles["adapted"].replace(f"{ADAPTED_POKES_N} indentations", own)
    named = {row: Model(title, SHORT[row], TABLE_2.get(row, {})) for row, title in titles.items()}
    if is_pooled(numbers):
        return named
    alone = {row: titles[row].replace("Multi-sensor", ALONE) for row in ("triplet", "adapted")}
    named["multi"] = Model(f"{ALONE} (paper: single-sensor)", "one training skin", TABLE_2["single"])
    named["triplet"] = Model(alone["triplet"], "one training skin + triplet", {})
    named["adapted"] = Model(alone["adapted"], SHORT["adapted"], {})
    return named


def is_pooled(numbers: Mapping[str, Any]) -> bool:
    """Tell whether some model of the leave-one-board-out question learnt from more than one skin."""
    boards = numbers["lobo"]["by_board"].values() if "lobo" in numbers else ()
    return not boards or max(one["trained_on_skins_n"] for one in boards) > 1


def paired_table(numbers: Mapping[str, Any], source: str) -> pd.DataFrame:
    """List the differences a held-out skin between two models, beside the difference of the paper's means."""
    known = models(numbers)
    lines = []
    for row in numbers["paired"]:
        line = {"difference": f"{known[row['of']].short} − {known[row['over']].short}", "source": source}
        of, over = known[row["of"]].paper, known[row["over"]].paper
        for metric, title in COLUMNS.items():
            line[f"{title} (ours)"] = show_difference(row.get(metric))
            both = metric in of and metric in over and of != over
            line[f"{title} (paper: difference of means)"] = f"{of[metric][0] - over[metric][0]:+.4g}" if both else "–"
        lines.append(line | {"n": n_of(row)})
    return tabulate(lines, spread=SPREAD_OF_PAIRS)


def order_table(numbers: Mapping[str, Any], source: str) -> pd.DataFrame:
    """Say for each claim of the paper about the order of its rows, and for our control, whether it holds here."""
    table2, known = numbers.get("table2", {}), models(numbers)
    pairs = {(row["of"], row["over"]): row for row in numbers["paired"]}
    lines = []
    if {"single", "multi"} <= set(table2) and is_pooled(numbers):
        line = {"claim": "multi-sensor far better than single-sensor"}
        line |= {t: _far(table2["multi"].get(m), table2["single"].get(m), m) for m, t in COLUMNS.items()}
        lines.append(line | {"n": f"{n_of(table2['multi'])}; {n_of(table2['single'])}"})
    if ("triplet", "multi") in pairs:
        row = pairs["triplet", "multi"]
        line = {"claim": f"{known['triplet'].short} within a few points of {known['multi'].short}"}
        line |= {t: _few(row[m]) if m == "accuracy_pct" else "–" for m, t in COLUMNS.items()}
        lines.append(line | {"n": n_of(row)})
    for over in ("triplet", "multi", "control"):
        if ("adapted", over) in pairs:
            row = pairs["adapted", over]
            line = {"claim": f"adapted better than {known[over].short}" + (" (ours)" if over == "control" else "")}
            line |= {t: _better(row.get(m), m) for m, t in COLUMNS.items()}
            lines.append(line | {"n": n_of(row)})
    return tabulate([line | {"source": source} for line in lines], meaning=ORDER, spread=SPREAD_OF_PAIRS)


def _far(better: Stat | None, worse: Stat | None, metric: str) -> str:
    """Judge whether two means are far apart: by more than `FAR_SDS` times the root mean square of their sd."""
    if better is None or worse is None:
        return "–"
    gain = _gain(better["mean"] - worse["mean"], metric)
    shown = show_difference({"mean": better["mean"] - worse["mean"]})
    if "sd" not in better or "sd" not in worse:
        return f"{'yes, but of one' if gain > 0 else 'no'}: {shown}"
    sd = sqrt((better["sd"] ** 2 + worse["sd"] ** 2) / 2)
    word = "yes" if gain > FAR_SDS * sd else "better, not far" if gain > 0 else "no"
    return f"{word}: {shown} ({abs(gain) / sd:.2g} sd)" if sd > 0 else f"{word}: {shown}"


def _few(difference: Stat) -> str:
    return f"{'yes' if abs(difference['mean']) <= FEW_POINTS else 'no'}: {show_difference(difference)}"


def _better(difference: Stat | None, metric: str) -> str:
    """Judge whether a paired difference is an improvement, and one of more than `SURE_ERRORS` standard errors."""
    if difference is None:
        return "–"
    gain = _gain(difference["mean"], metric)
    word = "yes" if gain > 0 else "no"
    if gain > 0 and "sd" not in difference:
        word = "yes, but of one"
    elif gain > 0 and gain <= SURE_ERRORS * difference["sd"] / sqrt(difference["n"]):
        word = f"yes, within {SURE_ERRORS:g} standard errors"
    return f"{word}: {show_difference(difference)}"


def _gain(difference: float, metric: str) -> float:
    return difference if metric == "accuracy_pct" else -difference

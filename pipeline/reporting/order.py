"""The rows of table 2 in the paper's order: numbers.json -> what they are called, and tables of paired differences."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import pandas as pd

from pipeline.evaluation.scores import negated
from pipeline.reporting.paper import ADAPTED_POKES_N, TABLE_2, TABLE_2_ROWS, Number
from pipeline.reporting.shown import COLUMNS, Stat, beside, show_difference, tabulate

FEW_POINTS = 5.0  # assumed: the paper's own drop is 3.4 points, "slightly affects performance"
ALONE = "Leave-one-board-out, one training skin"
CONTROL = "Control: fine-tuned as long, without the new skin's pokes (ours)"
SHORT = {
    "single": "single-sensor", "multi": "multi-sensor", "triplet": "multi-sensor + triplet", "adapted": "adapted",
    "control": "control",
}  # fmt: skip
PAIRED = (
    "Differences on the same test rows, skin by skin, each side the mean of its networks on a skin and a board the "
    "mean of its skins; [low, high] is the 95 % interval over n boards (Student's t). One skin on others: on the "
    "boards that it was tested on, and the interval is over its training skins too. What they decide: table claims."
)
CHANGE = "difference"  # column

Numbers = Mapping[str, Any]


@dataclass(frozen=True)
class Model:
    """A row of table 2: what it is called, also in short, and what the paper says about the same (empty: nothing)."""

    title: str
    short: str
    paper: Mapping[str, Number]


def models(numbers: Numbers) -> dict[str, Model]:
    """Name the rows of table 2 in the paper's order; names say so where nothing was pooled, with one training skin."""
    titles = TABLE_2_ROWS | {"control": CONTROL}
    if "adapt" in numbers and numbers["adapt"]["pokes_n"] != ADAPTED_POKES_N:
        pokes = f"{numbers['adapt']['pokes_n']} indentations (paper: {ADAPTED_POKES_N})"
        titles["adapted"] = titles["adapted"].replace(f"{ADAPTED_POKES_N} indentations", pokes)
    named = {row: Model(title, SHORT[row], TABLE_2.get(row, {})) for row, title in titles.items()}
    if is_pooled(numbers):
        return named
    alone = {row: titles[row].replace("Multi-sensor", ALONE) for row in ("triplet", "adapted")}
    return named | {
        "multi": Model(f"{ALONE} (paper: single-sensor)", "one training skin", TABLE_2["single"]),
        "triplet": Model(alone["triplet"], "one training skin + triplet", {}),
        "adapted": Model(alone["adapted"], SHORT["adapted"], {}),
    }


def table_2_rows(numbers: Numbers) -> dict[str, tuple[Model, Mapping[str, Any]]]:
    """Give the rows of table 2 that were computed, in the paper's order; last the control, which the paper has not."""
    ours = numbers["table2"] | control_of(numbers)
    return {row: (model, ours[row]) for row, model in models(numbers).items() if row in ours}


def control_of(numbers: Numbers) -> dict[str, Any]:
    """Give the control's row by its name, where there is one."""
    return {name: row for name, row in numbers.get("adapt", {}).items() if name == "control"}


def is_pooled(numbers: Numbers) -> bool:
    """Tell whether some model of the leave-one-board-out question learnt from more than one skin."""
    boards = numbers["lobo"]["by_board"].values() if "lobo" in numbers else ()
    return not boards or max(board["trained_on_skins_n"] for board in boards) > 1


def paired_table(numbers: Numbers, source: str) -> pd.DataFrame:
    """List the differences between two models over boards, beside the difference of the paper's means."""
    known = models(numbers)
    lines = []
    for row in numbers["paired"]:
        of, over = known[row["of"]].paper, known[row["over"]].paper
        printed = {m: f"{of[m][0] - over[m][0]:+.4g}" for m in of if m in over and of != over}
        cells = beside(row, printed, show_difference, paper="paper: difference of means")
        lines.append({CHANGE: _name(row, known), "source": source} | cells)
    return tabulate(lines, spread=PAIRED)


def paired_boards_table(numbers: Numbers, source: str) -> pd.DataFrame:
    """List the difference between two models on each held-out board."""
    known = models(numbers)
    lines = [
        {CHANGE: _name(row, known), "held-out board": board, "source": source}
        | {title: show_difference({"mean": means[m]}) for m, title in COLUMNS.items() if m in means}
        for row in numbers["paired"]
        for board, means in row.get("by_board", {}).items()
    ]
    return tabulate(lines, spread=PAIRED)


def gain(difference: Stat, metric: str) -> Stat:
    """Turn the difference of an error round, so that more is better."""
    return negated(difference) if metric.startswith("mse_") else difference


def _name(row: Mapping[str, Any], known: Mapping[str, Model]) -> str:
    return f"{known[row['of']].short} − {known[row['over']].short}"

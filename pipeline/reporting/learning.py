"""Tables of learning on many skins: rows of numbers.json -> data frames, each row simulated or recorded.

Refuses to know how a model learnt; a question that was not asked has no table.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import pandas as pd

from pipeline.reporting.order import SHORT, order_table, paired_boards_table, paired_table
from pipeline.reporting.paper import ADAPTED_POKES_N, FIGURE_6A, FIGURE_6B, TABLE_2
from pipeline.reporting.shown import COLUMNS, n_of, scores, show, tabulate

PLACES = (
    "Registered: after one offset a board (uses its labels: a diagnosis). Labels and unlabelled pokes are indentations "
    "of the new board at places where it is also tested, at other depths."
)
ROWS = (
    "Training rows of the first fold; a classical method is given at most so many, drawn at random. Settings of "
    "classical methods were not searched."
)
CONTROLLED = (
    "0 is the network as it was trained, all others are fine-tuned: what that does without pokes is the control of "
    "table 2."
)
BUDGETS = "How many steps there are is a budget of each scene, and no part of the choice."
DRAWS = (
    "[low, high] is the 95 % interval over n held-out boards (Student's t), each with its own draw of training skins; "
    "networks of one board are averaged first."
)
OF_BOARDS = "± is the sd over n boards."

Rows = Sequence[Mapping[str, Any]]


def learning_tables(numbers: Mapping[str, Any], source: str) -> dict[str, pd.DataFrame]:
    """Make the tables of every question about learning on many skins that was asked, by name."""
    makers: dict[str, Callable[[Any, str], pd.DataFrame]] = {
        "sweep_pokes": sweep_pokes_table,
        "sweep_sensors": sweep_sensors_table,
        "baselines": baselines_table,
        "labels": labels_table,
        "audit": audit_table,
        "chosen": chosen_table,
    }
    tables: dict[str, pd.DataFrame] = {}
    if "paired" in numbers:
        order = order_table(numbers, source)
        tables |= {} if order.empty else {"order": order}  # only pairs about which the paper claims nothing
        tables["paired"] = paired_table(numbers, source)
        boards = paired_boards_table(numbers, source)
        tables |= {} if boards.empty else {"paired_boards": boards}
    return tables | {name: make(numbers[name], source) for name, make in makers.items() if name in numbers}


def sweep_pokes_table(rows: Rows, source: str) -> pd.DataFrame:
    """List scores by the number of unlabelled pokes of the new skin; the paper gives numbers for two of them."""
    printed = {0: TABLE_2["triplet"], ADAPTED_POKES_N: TABLE_2["adapted"]}
    lines = []
    for row in sorted(rows, key=lambda row: row["pokes_n"]):
        line = {"pokes": str(row["pokes_n"]), "source": source}
        for metric, title in COLUMNS.items():
            paper = printed.get(row["pokes_n"], {})
            line[f"{title} (ours)"] = show(row.get(metric))
            line[f"{title} (paper, table 2)"] = "{:g} ± {:g}".format(*paper[metric]) if paper else "–"
        lines.append(line | {"n": n_of(row)})
    return tabulate(lines, meaning=f"The paper on its figure 6a: {FIGURE_6A}. {CONTROLLED}")


def sweep_sensors_table(rows: Rows, source: str) -> pd.DataFrame:
    """List scores by the number of training skins for each method."""
    lines = [
        {"training skins": str(row["skins_n"]), "method": SHORT[row["method"]], "source": source}
        | scores(row)
        | {"n": n_of(row)}
        for row in sorted(rows, key=lambda row: (row["skins_n"], list(SHORT).index(row["method"])))
    ]
    return tabulate(lines, meaning=f"The paper on its figure 6b: {FIGURE_6B}.", spread=DRAWS)


def baselines_table(rows: Rows, source: str) -> pd.DataFrame:
    """List classical methods and networks on the same folds, the most accurate first."""
    ordered = sorted(rows, key=lambda row: -row["accuracy_pct"]["mean"])
    lines = [
        {"method": row["method"], "inputs": row["inputs"], "training rows": str(row["rows_n"]), "source": source}
        | scores(row)
        | {"n": n_of(row)}
        for row in ordered
    ]
    return tabulate(lines, meaning=ROWS)


def labels_table(rows: Rows, source: str) -> pd.DataFrame:
    """List scores by how many labelled indentations of the new skin were at hand."""
    places = {metric: title for metric, title in COLUMNS.items() if metric != "mse_f_N2"}
    lines = []
    for row in rows:
        line = {"method": row["method"], "inputs": row["inputs"], "labels": str(row["labels_n"]), "source": source}
        line |= scores(row["as_labelled"])
        line |= scores(row["registered"], {metric: f"{title} (registered)" for metric, title in places.items()})
        lines.append(line | {"n": n_of(row["as_labelled"])})
    return tabulate(lines, meaning=PLACES)


def audit_table(rows: Rows, source: str) -> pd.DataFrame:
    """List what was searched for leaks; a leak that is known and stated is told from one that is not."""
    lines = [{name: str(row[name]) for name in ("what", "where", "rule", "found")} for row in rows]
    holds = ["yes" if row["holds"] else "no, known" if row["known"] else "NO" for row in rows]
    return tabulate([line | {"holds": word, "source": source} for line, word in zip(lines, holds, strict=True)])


def chosen_table(arms: Mapping[str, Any], source: str) -> pd.DataFrame:
    """List the candidates of each arm and which was chosen, by leave-one-board-out on boards of their own."""
    lines = []
    for arm, choice in arms.items():
        for row in choice["candidates"]:
            chosen = f"yes, by {choice['by']}" if row["recipe_name"] == choice["recipe_name"] else ""
            line = {"arm": arm, "candidate": row["recipe_name"], "settings": row["settings"], "chosen": chosen}
            lines.append(line | {"source": source} | scores(row) | {"n": n_of(row)})
    return tabulate(lines, meaning=BUDGETS, spread=OF_BOARDS)


def methods_costs_table(rows: Rows, source: str) -> pd.DataFrame:
    """List test errors beside training seconds and the microseconds of one reading, where those were measured."""
    lines = [
        {
            "method": row["method"],
            "inputs": row["inputs"],
            "training, s": _time(row, "train_s"),
            "one reading, µs": _time(row, "inference_us"),
            "source": source,
        }
        | scores(row)
        | {"n": n_of(row)}
        for row in rows
    ]
    return tabulate(lines)


def adaptation_costs_table(rows: Rows, source: str) -> pd.DataFrame:
    """List errors after adaptation beside its seconds, where those were measured, by the number of pokes."""
    lines = [
        {"pokes": str(row["pokes_n"]), "adaptation, s": _time(row, "seconds"), "source": source}
        | scores(row)
        | {"n": n_of(row)}
        for row in sorted(rows, key=lambda row: row["pokes_n"])
    ]
    return tabulate(lines)


def _time(row: Mapping[str, Any], name: str) -> str:
    return f"{row[name]:.3g}" if name in row else "–"

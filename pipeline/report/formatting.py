"""Format scores as text: means, deviations and intervals, paired differences, and checks as tables."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from pipeline.report.paper import ADAPTED_POKES_N, TABLE_2, TABLE_2_ROWS, Number
from pipeline.statistics import negated

COLUMNS = {"accuracy_pct": "accuracy, %", "mse_xy_mm2": "MSE_xy, mm²", "mse_f_N2": "MSE_F, N²", "r2_f": "R² of F"}
OF_FORCE = ("mse_f_N2", "r2_f")  # an offset of places changes neither
OF_PAPER = ("accuracy_pct", "mse_xy_mm2", "mse_f_N2")  # the scores that the paper gives
Stat = Mapping[str, Any]  # mean, n, and where known sd and ci95: [low, high], or values: each of a few boards
MEANING = "Accuracy: the part of held-out readings whose x and y are both within 1 mm. MSE_xy: mean over the two axes."
INTERVAL = (
    "[low, high] is the 95 % interval over held-out boards (Student's t), each the mean of its skins and networks; "
    "below four boards (a; b) are the boards' own values instead"
)
SPREAD = (
    f"{INTERVAL}; ± is the sd over n repeats on one skin, over n pairs of a training and a "
    "test skin in rows of one skin on others, or over seeds where it says so."
)


def show(value: Stat | None) -> str:
    """Write a mean with three significant digits: with its interval over boards, or else with its deviation.

    The standard deviation over network seeds follows where it is known.
    """
    if value is None:
        return "–"
    if "ci95" in value or "values" in value:
        return f"{_three(value['mean'])} {show_interval(value)}{_show_seeds(value)}"
    return show_deviation(value)


def show_deviation(value: Stat) -> str:
    """Write a mean, its standard deviation over n, and that over network seeds where it is known."""
    over_n = f" ± {value['sd']:.2g}" if "sd" in value else ""
    return f"{_three(value['mean'])}{over_n}{_show_seeds(value)}"


def _show_seeds(value: Stat) -> str:
    return f" ± {value['sd_seeds']:.2g} (seeds)" if "sd_seeds" in value else ""


def show_interval(value: Stat) -> str:
    """Write the 95 % interval over boards alone, or the values of a few boards."""
    if "values" in value:
        return f"({'; '.join(map(_three, value['values']))})"
    low, high = value["ci95"]
    return f"[{_three(low)}, {_three(high)}]"


def show_digits(value: Stat, digits: int) -> str:
    """Write a mean with so many decimals, and its interval over boards and deviation over seeds if it has them."""
    mean, *ends = [f"{number:.{digits}f}" for number in (value["mean"], *value.get("ci95", value.get("values", ())))]
    if not ends:
        return f"{mean}{_show_seeds(value)}"
    boards = f"[{', '.join(ends)}]" if "ci95" in value else f"({'; '.join(ends)})"
    return f"{mean} {boards}{_show_seeds(value)}"


def show_both(value: Stat | None) -> str:
    """Write a mean, its standard deviation as the paper does, and its interval over boards."""
    if value is None or not {"ci95", "values"} & set(value):
        return show(value)
    return f"{show_deviation(value)} {show_interval(value)}"


def show_difference(value: Stat | None) -> str:
    """Write a mean difference with its sign."""
    return "–" if value is None else ("+" if value["mean"] > 0 else "") + show(value)


def scores(row: Mapping[str, Any], titles: Mapping[str, str] = COLUMNS) -> dict[str, str]:
    """Show every metric of a row under its title."""
    return {title: show(row.get(metric)) for metric, title in titles.items()}


def scored(row: Mapping[str, Any]) -> dict[str, str]:
    """Show every metric of a row, and over how many it is."""
    return scores(row) | {"n": n_of(row)}


def beside(
    row: Mapping[str, Any], printed: Mapping[str, str], show: Callable[[Stat | None], str], *, paper: str = "paper"
) -> dict[str, str]:
    """Show every metric of a row beside what the paper prints, and over how many ours is."""
    cells: dict[str, str] = {}
    for metric, title in COLUMNS.items():
        cells |= {f"{title} (ours)": show(row.get(metric))}
        cells |= {f"{title} ({paper})": printed.get(metric, "–")} if metric in OF_PAPER else {}
    return cells | {"n": n_of(row)}


def n_of(row: Mapping[str, Any]) -> str:
    """Show over how many the scores of a row are."""
    return str(row.get("accuracy_pct", row.get("mse_f_N2"))["n"])


def _three(value: float) -> str:
    return f"{value:.4g}" if abs(value) >= 100 else f"{value:.3g}"


def tabulate(lines: Sequence[Mapping[str, str]], **said: str) -> pd.DataFrame:
    """Make a table, and keep what is said below it: its `meaning`, and its `spread`: what ± and brackets are."""
    table = pd.DataFrame(lines)
    table.attrs.update(said)
    return table


def notes(table: pd.DataFrame) -> list[str]:
    """Give the sentences that stand below a table: what its numbers mean."""
    meanings = [table.attrs["meaning"]] if "meaning" in table.attrs else []
    if any("accuracy" in str(column) for column in table.columns):
        meanings.append(f"{MEANING} {table.attrs.get('spread', SPREAD)}")
    return meanings


def to_markdown(table: pd.DataFrame) -> str:
    """Write a table as Markdown, empty where a number is not known, and say below what its numbers mean."""
    text = str(table.fillna("").to_markdown(index=False, disable_numparse=True)) + "\n"
    return text + "".join(f"\n{note}\n" for note in notes(table))


def rounded(value: Any, digits: int = 6) -> Any:
    """Round every float to significant digits, so that committed numbers do not change with the last bit."""
    if isinstance(value, dict):
        return {key: rounded(item, digits) for key, item in value.items()}
    if isinstance(value, list):
        return [rounded(item, digits) for item in value]
    if isinstance(value, float):
        return float(np.format_float_positional(value, digits, unique=False, fractional=False, trim="-"))
    return value


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

Results = Mapping[str, Any]


@dataclass(frozen=True)
class Model:
    """A row of table 2: what it is called, also in short, and what the paper says about the same (empty: nothing)."""

    title: str
    short: str
    paper: Mapping[str, Number]


def models(numbers: Results) -> dict[str, Model]:
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


def table_2_rows(numbers: Results) -> dict[str, tuple[Model, Mapping[str, Any]]]:
    """Give the rows of table 2 that were computed, in the paper's order; last the control, which the paper has not."""
    ours = numbers["table2"] | control_of(numbers)
    return {row: (model, ours[row]) for row, model in models(numbers).items() if row in ours}


def control_of(numbers: Results) -> dict[str, Any]:
    """Give the control's row by its name, where there is one."""
    return {name: row for name, row in numbers.get("adapt", {}).items() if name == "control"}


def is_pooled(numbers: Results) -> bool:
    """Tell whether some model of the leave-one-board-out experiment learnt from more than one skin."""
    boards = numbers["lobo"]["by_board"].values() if "lobo" in numbers else ()
    return not boards or max(board["trained_on_skins_n"] for board in boards) > 1


def paired_table(numbers: Results, source: str) -> pd.DataFrame:
    """List the differences between two models over boards, beside the difference of the paper's means."""
    known = models(numbers)
    lines = []
    for row in numbers["paired"]:
        of, over = known[row["of"]].paper, known[row["over"]].paper
        printed = {m: f"{of[m][0] - over[m][0]:+.4g}" for m in of if m in over and of != over}
        cells = beside(row, printed, show_difference, paper="paper: difference of means")
        lines.append({CHANGE: _name(row, known), "source": source} | cells)
    return tabulate(lines, spread=PAIRED)


def paired_boards_table(numbers: Results, source: str) -> pd.DataFrame:
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


CHECKS = {
    "subject": "what", "law": "law", "against": "against", "error": "error", "tolerance": "allowed",
    "reason": "why so much",
}  # fmt: skip
CASES = {
    "area": "area", "case": "case", "should": "should", "happened": "happened", "error": "error", "limit": "allowed",
}  # fmt: skip


def verification_table(rows: Sequence[Mapping[str, Any]], source: str) -> pd.DataFrame:
    """Lay out checks: what was measured against what, its error, and why it may be so large."""
    return _table(rows, CHECKS, source)


def stability_table(rows: Sequence[Mapping[str, Any]], source: str) -> pd.DataFrame:
    """Lay out cases: what should happen, what happened, and by how much where that is a number."""
    return _table(rows, CASES, source)


def _table(rows: Sequence[Mapping[str, Any]], titles: Mapping[str, str], source: str) -> pd.DataFrame:
    return pd.DataFrame(
        {title: _show(row[name], row.get("unit", "1")) for name, title in titles.items()}
        | {"holds": "yes" if row["holds"] else "NO", "source": source}
        for row in rows
    )


def _show(value: str | float | None, unit: str) -> str:
    if value is None or isinstance(value, str):
        return value or "–"
    return f"{value:.2g}" if unit == "1" else f"{value:.2g} {unit}"

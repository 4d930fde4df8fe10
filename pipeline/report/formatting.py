"""Scores as text: means, deviations, intervals and paired differences; rows of table 2; tables as Markdown."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from pipeline.report.paper import ADAPTED_POKES_N, TABLE_2, TABLE_2_ROWS, Number
from pipeline.statistics import negate

Stat = Mapping[str, Any]  # mean, n, and if known sd and ci95: [low, high], or the values of a few boards
Results = Mapping[str, Any]  # numbers.json of one scene
COLUMNS = {"accuracy_pct": "accuracy, %", "mse_xy_mm2": "MSE_xy, mm²", "mse_f_N2": "MSE_F, N²", "r2_f": "R² of F"}
OF_FORCE = ("mse_f_N2", "r2_f")  # an offset of places changes neither
OF_PAPER = ("accuracy_pct", "mse_xy_mm2", "mse_f_N2")  # the scores that the paper gives
FEW_POINTS = 5.0  # assumed: the paper's own drop is 3.4 points, "slightly affects performance"
MEANING = "Accuracy: the part of held-out readings whose x and y are both within 1 mm. MSE_xy: mean over the two axes."
INTERVAL = (
    "[low, high] is the 95 % interval over held-out boards (Student's t), each the mean of its skins and networks; "
    "below four boards (a; b) are the boards' own values instead"
)
SPREAD = (
    f"{INTERVAL}; ± is the sd over n repeats on one skin, over n pairs of a training and a "
    "test skin in rows of one skin on others, or over seeds where it says so."
)
SHORT = {
    "single": "single-sensor", "multi": "multi-sensor", "triplet": "multi-sensor + triplet", "adapted": "adapted",
    "control": "control",
}  # fmt: skip
CONTROL = "Control: fine-tuned as long, without the new skin's pokes (ours)"
ONE_TRAINING_SKIN = "Leave-one-board-out, one training skin"
UNIVERSAL = ("universal", 0)  # rows of experiment population: the whole universal model, without labels


def show(value: Stat | None) -> str:
    """Write a mean with three significant digits, its interval over boards (or else its sd), and its sd over seeds."""
    if value is None:
        return "–"
    if "ci95" in value or "values" in value:
        return f"{_three_digits(value['mean'])} {show_interval(value)}{_show_seeds(value)}"
    return show_deviation(value)


def show_deviation(value: Stat) -> str:
    """Write a mean, its standard deviation over n, and its standard deviation over seeds if known."""
    over_n = f" ± {value['sd']:.2g}" if "sd" in value else ""
    return f"{_three_digits(value['mean'])}{over_n}{_show_seeds(value)}"


def show_interval(value: Stat) -> str:
    """Write only the 95 % interval over boards, or the values of a few boards."""
    if "values" in value:
        return f"({'; '.join(map(_three_digits, value['values']))})"
    low, high = value["ci95"]
    return f"[{_three_digits(low)}, {_three_digits(high)}]"


def show_digits(value: Stat, digits: int) -> str:
    """Write a mean with `digits` decimals, and its interval over boards and deviation over seeds if it has them."""
    mean, *ends = [f"{number:.{digits}f}" for number in (value["mean"], *value.get("ci95", value.get("values", ())))]
    if not ends:
        return f"{mean}{_show_seeds(value)}"
    boards = f"[{', '.join(ends)}]" if "ci95" in value else f"({'; '.join(ends)})"
    return f"{mean} {boards}{_show_seeds(value)}"


def show_both(value: Stat | None) -> str:
    """Write a mean with its standard deviation, as the paper does, and its interval over boards."""
    if value is None or not {"ci95", "values"} & set(value):
        return show(value)
    return f"{show_deviation(value)} {show_interval(value)}"


def show_difference(value: Stat | None) -> str:
    """Write a mean difference with its sign."""
    return "–" if value is None else ("+" if value["mean"] > 0 else "") + show(value)


def gain(difference: Stat, metric: str) -> Stat:
    """Return the difference such that positive is better: the sign of differences of errors is changed."""
    return negate(difference) if metric.startswith("mse_") else difference


def _show_seeds(value: Stat) -> str:
    return f" ± {value['sd_seeds']:.2g} (seeds)" if "sd_seeds" in value else ""


def _three_digits(value: float) -> str:
    return f"{value:.4g}" if abs(value) >= 100 else f"{value:.3g}"


def scores(row: Mapping[str, Any], titles: Mapping[str, str] = COLUMNS) -> dict[str, str]:
    """Write every metric of a row under its title."""
    return {title: show(row.get(metric)) for metric, title in titles.items()}


def scored(row: Mapping[str, Any]) -> dict[str, str]:
    """Write every metric of a row, and n."""
    return scores(row) | {"n": n_of(row)}


def beside(
    row: Mapping[str, Any], printed: Mapping[str, str], show: Callable[[Stat | None], str], *, paper: str = "paper"
) -> dict[str, str]:
    """Write every metric of a row beside the paper's, and n."""
    cells: dict[str, str] = {}
    for metric, title in COLUMNS.items():
        cells |= {f"{title} (ours)": show(row.get(metric))}
        cells |= {f"{title} ({paper})": printed.get(metric, "–")} if metric in OF_PAPER else {}
    return cells | {"n": n_of(row)}


def n_of(row: Mapping[str, Any]) -> str:
    """Write the number of boards, pairs or repeats that the scores of a row are averaged over."""
    return str(row.get("accuracy_pct", row.get("mse_f_N2"))["n"])


def tabulate(lines: Sequence[Mapping[str, str]], **notes: str) -> pd.DataFrame:
    """Make a table with notes to show below it: its `meaning`, and its `spread` (what ± and brackets mean)."""
    table = pd.DataFrame(lines)
    table.attrs.update(notes)
    return table


def notes(table: pd.DataFrame) -> list[str]:
    """List the notes to show below a table."""
    meanings = [table.attrs["meaning"]] if "meaning" in table.attrs else []
    if any("accuracy" in str(column) for column in table.columns):
        meanings.append(f"{MEANING} {table.attrs.get('spread', SPREAD)}")
    return meanings


def to_markdown(table: pd.DataFrame) -> str:
    """Write a table and its notes as Markdown; unknown cells are empty."""
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


@dataclass(frozen=True)
class Model:
    """A row of table 2: its title, a short title, and the paper's scores for it (empty if it has none)."""

    title: str
    short: str
    paper: Mapping[str, Number]


def models(numbers: Results) -> dict[str, Model]:
    """Return the rows of table 2 in the paper's order; their titles say if there was only one training skin."""
    titles = TABLE_2_ROWS | {"control": CONTROL}
    if "adapt" in numbers and numbers["adapt"]["pokes_n"] != ADAPTED_POKES_N:
        pokes = f"{numbers['adapt']['pokes_n']} indentations (paper: {ADAPTED_POKES_N})"
        titles["adapted"] = titles["adapted"].replace(f"{ADAPTED_POKES_N} indentations", pokes)
    named = {row: Model(title, SHORT[row], TABLE_2.get(row, {})) for row, title in titles.items()}
    if is_pooled(numbers):
        return named
    one_skin = {row: titles[row].replace("Multi-sensor", ONE_TRAINING_SKIN) for row in ("triplet", "adapted")}
    return named | {
        "multi": Model(f"{ONE_TRAINING_SKIN} (paper: single-sensor)", "one training skin", TABLE_2["single"]),
        "triplet": Model(one_skin["triplet"], "one training skin + triplet", {}),
        "adapted": Model(one_skin["adapted"], SHORT["adapted"], {}),
    }


def table_2_rows(numbers: Results) -> dict[str, tuple[Model, Mapping[str, Any]]]:
    """Return the rows of table 2 that were computed, in the paper's order; last the control, which the paper lacks."""
    ours = numbers["table2"] | control_of(numbers)
    return {row: (model, ours[row]) for row, model in models(numbers).items() if row in ours}


def universal_rows(numbers: Results) -> list[tuple[Model, Mapping[str, Any]]]:
    """Return the universal model's row of experiment population without labels and with the most unlabelled pokes."""
    rows = [row for row in numbers.get("population", {}).get("told", ()) if (row["way"], row["labels_n"]) == UNIVERSAL]
    if not rows:
        return []
    most = max(rows, key=lambda row: row["pokes_n"])
    title = f"Universal model, trained on simulated skins, {most['pokes_n']} unlabelled pokes (ours)"
    return [(Model(title, "universal", {}), most)]


def control_of(numbers: Results) -> dict[str, Any]:
    """Return the control's row by its name, if there is one."""
    return {name: row for name, row in numbers.get("adapt", {}).items() if name == "control"}


def is_pooled(numbers: Results) -> bool:
    """Return whether any leave-one-board-out model was trained on several skins."""
    boards = numbers["lobo"]["by_board"].values() if "lobo" in numbers else ()
    return not boards or max(board["trained_on_skins_n"] for board in boards) > 1

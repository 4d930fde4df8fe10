"""How a score is shown: a mean and its deviation -> words. In: plain numbers. Out: text, and tables of it.

Refuses to know what a score is of.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

COLUMNS = {"accuracy_pct": "accuracy, %", "mse_xy_mm2": "MSE_xy, mm²", "mse_f_N2": "MSE_F, N²", "r2_f": "R² of F"}
OF_FORCE = ("mse_f_N2", "r2_f")  # an offset of places changes neither
OF_PAPER = ("accuracy_pct", "mse_xy_mm2", "mse_f_N2")  # the scores that the paper gives
Stat = Mapping[str, Any]  # mean, n, and where known sd and ci95: [low, high], or values: each of a few boards
MEANING = "Accuracy: the part of held-out readings whose x and y are both within 1 mm. MSE_xy: mean over the two axes."
INTERVAL = (
    "[low, high] is the 95 % interval over held-out boards (Student's t), each the mean of its skins and networks; "
    "below four boards (a; b) are the boards' own values instead"
)
SPREAD = f"{INTERVAL}; ± is the sd over n repeats on one skin, or over seeds where it says so."


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

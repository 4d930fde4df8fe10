"""How a score is shown: a mean and its deviation -> words. In: plain numbers. Out: text, and tables of it.

Refuses to know what a score is of.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import pandas as pd

COLUMNS = {"accuracy_pct": "accuracy, %", "mse_xy_mm2": "MSE_xy, mm²", "mse_f_N2": "MSE_F, N²"}
Stat = Mapping[str, float]
MEANING = "Accuracy: the part of held-out readings whose x and y are both within 1 mm. MSE_xy: mean over the two axes."
SPREAD = (
    "± is the sd over n folds (over n pairs of a training and a test skin for one skin on others), or over seeds where "
    "it says so."
)


def show(value: Stat | None) -> str:
    """Write a mean and its deviation with three significant digits."""
    if value is None:
        return "–"
    mean = f"{value['mean']:.4g}" if value["mean"] >= 100 else f"{value['mean']:.3g}"
    if "sd" in value:
        return f"{mean} ± {value['sd']:.2g}"
    return mean + (f" ± {value['sd_seeds']:.2g} (seeds)" if "sd_seeds" in value else "")


def show_difference(value: Stat | None) -> str:
    """Write a mean difference with its sign."""
    return "–" if value is None else ("+" if value["mean"] > 0 else "") + show(value)


def scores(row: Mapping[str, Any], titles: Mapping[str, str] = COLUMNS) -> dict[str, str]:
    """Show every metric of a row under its title."""
    return {title: show(row.get(metric)) for metric, title in titles.items()}


def n_of(row: Mapping[str, Any]) -> str:
    """Show over how many the scores of a row are."""
    return str(row["accuracy_pct"]["n"])


def tabulate(lines: Sequence[Mapping[str, str]], **said: str) -> pd.DataFrame:
    """Make a table, and keep what is said below it: its `meaning`, and its `spread`, which is what ± stands for."""
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

"""Scores as text (means, deviations, intervals, paired differences), and tables as Markdown."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from pipeline.paper import Number
from pipeline.statistics import Stat, as_json

Statistic = Stat | Mapping[str, Any]  # a statistic, or its entry in numbers.json
COLUMNS = {"accuracy_pct": "accuracy, %", "mse_xy_mm2": "MSE_xy, mm²", "mse_f_N2": "MSE_F, N²", "r2_f": "R² of F"}
PAPER_METRICS = ("accuracy_pct", "mse_xy_mm2", "mse_f_N2")  # metrics that the paper reports
MEANING = (
    "Accuracy: percentage of held-out readings whose predicted x and y are both within 1 mm of the true position. "
    "MSE_xy: mean squared error of the position, averaged over x and y."
)
INTERVAL = (
    "[low, high] is the 95 % interval over held-out boards (Student's t). The value of a board is the mean over its "
    "skins and networks. With fewer than four boards there is no interval, and (a; b) are the values of the boards."
)
SPREAD = (
    f"{INTERVAL} ± is a standard deviation. If networks are tested on the skin on which they were trained, n is the "
    "number of random splits into training and test rows, and ± is the standard deviation of the scores of these "
    "splits. If networks are tested on other skins, n is the number of pairs of a training skin and a test skin. A "
    "standard deviation with the mark (seeds) is that of networks that differ only in their random seed."
)
# Titles of methods, by their short names in the table of scores.
TITLES = {
    "single": "single-sensor", "multi": "multi-sensor", "triplet": "multi-sensor + triplet", "adapted": "adapted",
    "control": "control", "shipped": "in-context model, as shipped",
    "rig": "in-context model, made with the rig's other boards", "registration": "multi-sensor, 5 known presses",
    "gaussian_process": "Gaussian process on own labels", "kernel_ridge": "kernel ridge", "constant": "mean of labels",
    "reference_chip": "shipped, reference chip subtracted", "joints": "shipped, field predicted from joints subtracted",
    "before": "before adaptation", "after": "after adaptation", "grid": "adapted with as many robot pokes",
    "network": "the paper's network", "knn-raw": "k nearest neighbours (dB)",
    "knn-shape": "k nearest neighbours (direction and length of dB)",
}  # fmt: skip
DECIMALS_MAX = 6  # numbers that need more decimals are written with an exponent


def show(value: Statistic | None) -> str:
    """Write a mean, its interval over boards (or else its standard deviation), and its standard deviation over seeds.

    All these numbers have as many decimals as `decimals` returns.
    """
    if value is None:
        return "–"
    stat = Stat.of(value)
    return f"{_rounded_mean(stat)} {show_interval(stat)}{_show_seeds(stat)}" if stat.ends else show_deviation(stat)


def show_deviation(value: Statistic) -> str:
    """Write a mean with its standard deviations over the n values and over seeds, if they are known."""
    stat = Stat.of(value)
    over_n = "" if stat.sd is None else f" ± {_rounded_sd(stat, stat.sd)}"
    return f"{_rounded_mean(stat)}{over_n}{_show_seeds(stat)}"


def show_interval(value: Statistic) -> str:
    """Write the 95 % interval over boards, or the values of a few boards, without the mean."""
    stat = Stat.of(value)
    digits = decimals(stat)
    ends = [three_digits(end) if digits is None else f"{end:z.{digits}f}" for end in stat.ends]
    return f"({'; '.join(ends)})" if stat.few else f"[{', '.join(ends)}]"


def show_with_unit(value: Statistic | None, unit: str) -> str:
    """Write a mean with its unit, then its uncertainty.

    >>> show_with_unit({"mean": 78.7, "n": 6, "ci95": [72.1, 84.2]}, "%")
    '78.7 % [72.1, 84.2]'
    """
    mean, *uncertainty = show(value).split(" ", 1)
    return " ".join([mean, unit, *uncertainty]) if value else mean


def decimals(value: Statistic) -> int | None:
    """Return the number of decimals at which the uncertainty of a mean has two significant digits.

    The uncertainty is half of the interval over boards, half of the range of a few boards' values, or else the standard
    deviation. The mean gets at most four significant digits, or three if there are few boards. One more decimal is used
    if it prevents an end of the interval from being rounded to 0. Returns None if there is no uncertainty, or if the
    numbers are too small to be written without an exponent.

    >>> decimals({"mean": 78.7, "n": 6, "ci95": [72.1234, 84.2234]}), decimals({"mean": 1234.5, "n": 3, "sd": 8.0})
    (1, 0)
    """
    stat = Stat.of(value)
    sd = stat.sd_seeds or 0.0 if stat.sd is None else stat.sd
    ends = stat.ends or (0.0, 2 * sd)
    uncertainty = (max(ends) - min(ends)) / 2
    if not np.isfinite(uncertainty) or uncertainty <= 0:
        return None
    largest = max(abs(stat.mean), uncertainty)
    digits = max(0, min(1 - _exponent(uncertainty), (2 if stat.few else 3) - _exponent(largest)))
    zeros = [end for end in stat.ci95 or () if end and not float(f"{end:.{digits}f}")]
    if zeros and all(float(f"{end:.{digits + 1}f}") for end in zeros):
        digits += 1
    return digits if digits <= DECIMALS_MAX else None


def _exponent(value: float) -> int:
    return int(np.floor(np.log10(value)))


def _rounded_mean(stat: Stat) -> str:
    digits = decimals(stat)
    return three_digits(stat.mean) if digits is None else f"{stat.mean:z.{digits}f}"


def _rounded_sd(stat: Stat, sd: float) -> str:
    """Write a standard deviation with the decimals of its mean, or with one significant digit instead of 0."""
    digits = decimals(stat)
    text = f"{sd:.2g}" if digits is None else f"{sd:.{digits}f}"
    return text if float(text) or not sd else f"{sd:.1g}"


def show_digits(value: Statistic, digits: int) -> str:
    """Write a mean with `digits` decimals, and its interval over boards and standard deviation over seeds, if known."""
    stat = Stat.of(value)
    mean, *ends = [f"{number:.{digits}f}" for number in (stat.mean, *stat.ends)]
    if not ends:
        return f"{mean}{_show_seeds(stat)}"
    boards = f"({'; '.join(ends)})" if stat.few else f"[{', '.join(ends)}]"
    return f"{mean} {boards}{_show_seeds(stat)}"


def show_both(value: Statistic | None) -> str:
    """Write a mean with its standard deviation, which the paper also gives, and with its interval over boards."""
    if value is None or not Stat.of(value).ends:
        return show(value)
    return f"{show_deviation(value)} {show_interval(value)}"


def show_difference(value: Statistic | None) -> str:
    """Write a mean difference with its sign."""
    return "–" if value is None else ("+" if Stat.of(value).mean > 0 else "") + show(value)


def _show_seeds(stat: Stat) -> str:
    return "" if stat.sd_seeds is None else f" ± {_rounded_sd(stat, stat.sd_seeds)} (seeds)"


def three_digits(value: float) -> str:
    """Write a number with three significant digits; four if it is 100 or more."""
    return f"{value:.4g}" if abs(value) >= 100 else f"{value:.3g}"


def two_digits(value: float) -> str:
    """Write a number with two significant digits, also if the last one is 0, and without an exponent if it is large.

    >>> [two_digits(value) for value in (0.6, 1.234, 47.4, 99.7)]
    ['0.60', '1.2', '47', '100']
    """
    return f"{value:.0f}" if abs(value) >= 9.95 else f"{value:#.2g}"


def scores(row: Mapping[str, Any], titles: Mapping[str, str] = COLUMNS) -> dict[str, str]:
    """Write every metric of a row as text; return the cells by column title."""
    return {title: show(row.get(metric)) for metric, title in titles.items()}


def scored(row: Mapping[str, Any]) -> dict[str, str]:
    """Write every metric of a row, and the number n that it is averaged over, as text; return cells by column title."""
    return scores(row) | {"n": n_of(row)}


def beside(
    row: Mapping[str, Any],
    printed: Mapping[str, str],
    show: Callable[[Statistic | None], str],
    *,
    columns: Mapping[str, str] = COLUMNS,
    paper: str = "paper",
) -> dict[str, str]:
    """Write each metric of a row beside the paper's value (`printed`), and then n; return cells by column title."""
    cells: dict[str, str] = {}
    for metric, title in columns.items():
        cells |= {f"{title} (ours)": show(row.get(metric))}
        if metric in PAPER_METRICS or metric in printed:
            cells |= {f"{title} ({paper})": printed.get(metric, "–")}
    return cells | {"n": n_of(row)}


def printed(paper: Mapping[str, Number] | Mapping[str, float]) -> dict[str, str]:
    """Write the paper's scores, which are means or pairs of mean and standard deviation, as text by metric."""
    return {
        metric: "{:g} ± {:g}".format(*value) if isinstance(value, tuple) else f"{value:g}"
        for metric, value in paper.items()
    }


def n_of(row: Mapping[str, Any]) -> str:
    """Write the number of boards, pairs or repeats that the scores of a row are averaged over."""
    return str(row.get("accuracy_pct", row.get("mse_f_N2"))["n"])


def tabulate(lines: Sequence[Mapping[str, str]], **notes: str) -> pd.DataFrame:
    """Make a table with two notes to show below it: `meaning`, and `spread`, which explains ± and brackets."""
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
    """Round every float to significant digits, so that rounding errors do not change committed numbers.

    Statistics become entries of numbers.json.
    """
    return _rounded(as_json(value), digits)


def _rounded(value: Any, digits: int) -> Any:
    if isinstance(value, dict):
        return {key: _rounded(item, digits) for key, item in value.items()}
    if isinstance(value, list):
        return [_rounded(item, digits) for item in value]
    if isinstance(value, float):
        return float(np.format_float_positional(value, digits, unique=False, fractional=False, trim="-"))
    return value

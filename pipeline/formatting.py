"""Scores as text: means with their deviations or intervals, and paired differences."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from pipeline.statistics import Stat, as_json

Statistic = Stat | Mapping[str, Any]  # a statistic, or its entry in numbers.json
COLUMNS = {"accuracy_pct": "within 1 mm, %", "mse_xy_mm2": "MSE_xy, mm²", "mse_f_N2": "MSE_F, N²", "r2_f": "R² of F"}
NONE = "–"  # a value that does not exist
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


def show(value: Statistic | float) -> str:
    """Write a mean and its 95 % interval over boards, or the values of few boards, or else its standard deviation.

    A standard deviation over seeds follows, if it is known. All numbers have as many decimals as `decimals` returns.

    >>> show({"mean": 78.7, "n": 6, "ci95": [72.1, 84.2]}), show({"mean": 85.0, "n": 2, "values": [80.0, 90.0]})
    ('78.7 [72.1, 84.2]', '85.0 (80.0; 90.0)')
    """
    stat = Stat.of(value if isinstance(value, Stat | Mapping) else {"mean": value})
    over_n = _show_interval(stat) if stat.ends else _show_sd(stat)
    return f"{_rounded_mean(stat)}{over_n}{_show_seeds(stat)}"


def show_with_sd(value: Statistic | float) -> str:
    """Write a mean with its standard deviation, which the paper also gives, and with its interval over boards."""
    stat = Stat.of(value if isinstance(value, Stat | Mapping) else {"mean": value})
    return f"{_rounded_mean(stat)}{_show_sd(stat)}{_show_seeds(stat)}{_show_interval(stat) if stat.ends else ''}"


def show_difference(value: Statistic) -> str:
    """Write a mean difference with its sign."""
    return ("+" if Stat.of(value).mean > 0 else "") + show(value)


def _show_interval(stat: Stat) -> str:
    digits = decimals(stat)
    ends = [three_digits(end) if digits is None else f"{end:z.{digits}f}" for end in stat.ends]
    return f" ({'; '.join(ends)})" if stat.few else f" [{', '.join(ends)}]"


def _show_sd(stat: Stat) -> str:
    return "" if stat.sd is None else f" ± {_rounded_sd(stat, stat.sd)}"


def _show_seeds(stat: Stat) -> str:
    return "" if stat.sd_seeds is None else f" ± {_rounded_sd(stat, stat.sd_seeds)} (seeds)"


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


def three_digits(value: float) -> str:
    """Write a number with three significant digits; four if it is 100 or more."""
    return f"{value:.4g}" if abs(value) >= 100 else f"{value:.3g}"


def two_digits(value: float) -> str:
    """Write a number with two significant digits, also if the last one is 0, and without an exponent if it is large.

    >>> [two_digits(value) for value in (0.6, 1.234, 47.4, 99.7)]
    ['0.60', '1.2', '47', '100']
    """
    return f"{value:.0f}" if abs(value) >= 9.95 else f"{value:#.2g}"


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

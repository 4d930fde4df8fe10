"""The shear experiment, told: numbers and a few hundred forces -> a table and a figure beside the paper's numbers.

Refuses to know how networks were trained, and paths.
"""

from collections.abc import Mapping
from typing import Any

import pandas as pd

from pipeline.report.drawing import COLOURS, drawing, svg
from pipeline.report.formatting import show, tabulate
from pipeline.report.paper import SHEAR

TITLES = {
    "mse_fxy_N2": "MSE_Fxy, N²", "mse_fz_N2": "MSE_Fz, N²", "mse_xy_mm2": "MSE_xy, mm²", "accuracy_pct": "accuracy, %",
    "explained_fxy": "explained variance of Fxy", "explained_fz": "explained variance of Fz",
}  # fmt: skip
FORCES = ("Fx", "Fy", "Fz")


def tables(numbers: Mapping[str, Any], source: str) -> dict[str, pd.DataFrame]:
    """Show both splits, the paper's numbers beside each: it names none."""
    ways = {
        "random readings held out (ours; the paper names no split)": numbers,
        "whole lines held out": numbers["by_line"],
    }
    lines = []
    for way, own in ways.items():
        line = {"split": way, "source": source}
        for metric, title in TITLES.items():
            line[f"{title} (ours)"] = show(own[metric])
            if metric in SHEAR:
                line[f"{title} (paper)"] = "{:g} ± {:g}".format(*SHEAR[metric])
        lines.append(line | {"n": str(own["accuracy_pct"]["n"])})
    rms_N = ", ".join(f"{numbers[f'{axis}_rms_N']:.2g} N (F{axis[1]})" for axis in ("fx", "fy", "fz"))
    meaning = (
        f"{numbers['readings_n']} readings of {numbers['lines_n']} dragged lines in {numbers['passes_n']} passes: a "
        f"line that is held out is dragged along in {numbers['passes_n'] - 1} others. Our forces are {rms_N} rms. The "
        "paper's are not stated, and an MSE grows with the square of the force: explained variance, 1 - MSE / "
        "variance, does not. MSE_Fxy is a mean over two axes too; the paper does not say whether it sums or averages."
    )
    spread = (
        f"± is the sd over n random splits, each the mean of {numbers['seeds_n']} networks; ± (seeds) is the sd over "
        f"{numbers['seeds_n']} network seeds on one split, mean over splits."
    )
    return {"shear": tabulate(lines, meaning=meaning, spread=spread)}


def figures(numbers: Mapping[str, Any], drawn: Mapping[str, Any], source: str) -> dict[str, str]:
    """Draw predicted against true force of lines that were held out whole, a panel a direction."""
    with drawing(7.6, 3.1) as figure:
        panels = figure.subplots(1, len(FORCES))
        for axes, name, true_N, predicted_N in zip(panels, FORCES, drawn["true"], drawn["predicted"], strict=True):
            low, high = min(*true_N, *predicted_N), max(*true_N, *predicted_N)
            axes.plot([low, high], [low, high], color=COLOURS[0], linewidth=0.8)
            axes.scatter(true_N, predicted_N, s=7, color=COLOURS[1], alpha=0.6, linewidths=0)
            axes.set(xlabel=f"true {name} / N", ylabel=f"predicted {name} / N")
            axes.locator_params(nbins=4)
        explained = {part: _explained(numbers["by_line"][f"explained_{part}"]) for part in ("fxy", "fz")}
        title = (
            f"Forces of dragged lines held out whole ({source}); points of the first of {numbers['seeds_n']} networks\n"
            f"explained variance: {explained['fxy']} sideways, {explained['fz']} normal"
        )
        figure.suptitle(title, x=0.01, ha="left", fontsize=10)
        return {"shear.svg": svg(figure)}


def _explained(stat: Mapping[str, float]) -> str:
    return f"{stat['mean']:.3f}" + (f" ± {stat['sd_seeds']:.3f} (seeds)" if "sd_seeds" in stat else "")

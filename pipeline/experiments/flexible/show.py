"""Networks of rigid boards on flexible ones, told: numbers and a few forces -> a table and a figure.

Refuses to know how networks were adapted, and paths.
"""

from collections.abc import Mapping
from typing import Any

import pandas as pd

from pipeline.report.drawing import COLOURS, drawing, svg
from pipeline.report.formatting import COLUMNS, OF_PAPER, show, show_difference, tabulate
from pipeline.report.paper import FLEXIBLE, FLEXIBLE_BIAS, FLEXIBLE_GAP_LESS_PCT

ARMS = {"before": "before", "after": "adapted", "control": "as long, without pokes"}
OF_SHAPE = "direction and length of the change of field (ours): "


def tables(numbers: Mapping[str, Any], source: str) -> dict[str, pd.DataFrame]:
    """Show the arms of the paper's recipe, then those of ours on directions where there is one."""
    lines = [_line(ARMS[arm], numbers, arm, source) for arm in ARMS if arm in numbers]
    if "shape" in numbers:
        lines += [_line(OF_SHAPE + ARMS[arm], numbers["shape"], arm, source) for arm in ARMS if arm in numbers["shape"]]
    spread = (
        f"[low, high] is the 95 % interval over n boards, each skin the mean of {numbers['seeds_n']} networks; one "
        "fold's networks answer for all these boards, so it says nothing of other training boards. ± (seeds) is the "
        f"standard deviation over {numbers['seeds_n']} network seeds on one skin, mean over skins."
    )
    return {"flexible": tabulate(lines, meaning=_meaning(numbers), spread=spread)}


def figures(numbers: Mapping[str, Any], drawn: Mapping[str, Any], source: str) -> dict[str, str]:
    """Draw predicted against true force before and after adaptation, with the diagonal and the bias."""
    every_N = [value for arm in drawn.values() for side in arm.values() for value in side]
    ends_N = [min(every_N), max(every_N)]
    with drawing(6.4, 3.7) as figure:
        panels = figure.subplots(1, len(drawn), sharex=True, sharey=True)
        for axes, (arm, forces), colour in zip(panels, drawn.items(), COLOURS[1:], strict=False):
            axes.plot(ends_N, ends_N, color=COLOURS[0], linewidth=0.8)
            axes.scatter(forces["true_N"], forces["predicted_N"], s=7, color=colour, alpha=0.6, linewidths=0)
            bias = f"bias {show_difference(numbers['bias_f_N'][arm])} N"
            axes.set_title(f"{ARMS[arm]}:\n{bias}", loc="left", fontsize=9)
            axes.set(xlabel="true force / N")
        panels[0].set_ylabel("predicted force / N")
        title = (
            f"Networks of rigid boards on flexible boards ({source})\n"
            f"bias over {numbers['seeds_n']} network seeds, points of the first"
        )
        figure.suptitle(title, x=0.01, ha="left", fontsize=10)
        return {"flexible.svg": svg(figure)}


def _meaning(numbers: Mapping[str, Any]) -> str:
    gap_mm = numbers["gap_mm"]
    return (
        f"Networks of fold {numbers['fold']}, trained on {numbers['trained_on_skins_n']} skins of rigid boards, on "
        f"{numbers['skins_n']} skins of {numbers['boards_n']} flexible boards; adapted by {numbers['pokes_n']} pokes. "
        "Bias: mean of predicted less true force, and as a part of the mean force; the paper names "
        f"{FLEXIBLE_BIAS} after adaptation, without a number. Ours: |dB| is {show(numbers['strength_ratio'])} times as "
        f"strong at equal depth (± over depths). Skins lie {gap_mm['flexible']:g} mm over the chips instead of "
        f"{gap_mm['rigid']:g} mm, {numbers['gap_less_pct']:.0f} % less; the paper's {FLEXIBLE_GAP_LESS_PCT:g} % less. "
        "The paper's numbers are after adaptation, its accuracy about."
    )


def _line(name: str, numbers: Mapping[str, Any], arm: str, source: str) -> dict[str, str]:
    line = {"networks": name, "source": source}
    paper = FLEXIBLE if arm == "after" else {}
    for metric, title in COLUMNS.items():
        line[f"{title} (ours)"] = show(numbers[arm].get(metric))
        if metric in OF_PAPER:
            line[f"{title} (paper)"] = f"{paper[metric]:g}" if metric in paper else "–"
    line |= {"bias of F, N": show_difference(numbers["bias_f_N"][arm])}
    line |= {"bias of F, %": show_difference(numbers["bias_f_pct"][arm])}
    return line | {"n": str(numbers[arm]["accuracy_pct"]["n"])}

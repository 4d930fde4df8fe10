"""The glass that is filled: numbers -> one table and one figure. Sees no readings and no path."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

from pipeline.report import paper
from pipeline.report.drawing import COLOURS, drawing, svg
from pipeline.report.statistics import FEW_BOARDS, INCONCLUSIVE

MEANING = (  # {told_pct} comes from the numbers
    "A weight at the skin's middle goes up step by step; the glass's flat foot is taken as the rig's round tip. Two "
    "weights are told apart where at least {told_pct:g} % of the pairs of readings within a filling, in fillings that "
    "fitted nothing, are in the order of the weights, and so are those of all larger differences. The response is the "
    "change of field along its mean direction in the other half of the fillings. Whether its mean over fillings rises "
    "is judged at the least step whose mean rise stands out of the noise of a stop's readings in {told_pct:g} % of "
    "cases: at finer ones noise alone makes it fall."
)
READINGS = {"one_reading": "one reading", "five_readings": "mean of a stop's readings"}


def tables(numbers: Mapping[str, Any], source: str) -> dict[str, pd.DataFrame]:
    """Show the smallest step told apart, in newtons and in water, and whether the response is monotonic."""
    rows = []
    for name, words in READINGS.items():
        rows += [
            (
                f"smallest step told apart, {words}, N",
                _show(numbers["smallest_step_N"], name, numbers),
                f"< {paper.SENSITIVITY_N:g}",
            ),
            (f"smallest step told apart, {words}, mL of water", _show_mL(name, numbers), f"< {paper.SENSITIVITY_ML:g}"),
            (f"the same by |dB| alone, {words}, N", _show(numbers["by_length_N"], name, numbers), "–"),
        ]
    rise = numbers["monotonic"]
    rows += [
        ("mean response rises at every step that stands out of noise", _rises(rise), paper.MONOTONIC),
        (f"falls from level to level, {numbers['step_N']:g} N apart", _falls(rise["neighbours"], numbers), "–"),
        ("gain, straight line, µT/N", f"{numbers['gain_uT_per_N']:.3g}", "–"),
        ("noise of one reading along the response, µT", f"{numbers['noise_uT']:.2g}", "–"),
    ]
    table = pd.DataFrame(
        [{"what": what, "ours": ours, "paper": theirs, "source": source} for what, ours, theirs in rows]
    )
    table.attrs["meaning"] = MEANING.format(told_pct=numbers["told_pct"])
    return {"sensitivity": table}


def figures(numbers: Mapping[str, Any], drawn: Mapping[str, Any], source: str) -> dict[str, str]:
    """Draw the response against weight, and how sure a difference is told."""
    with drawing(7.6, 3.6) as figure:
        left, right = figure.subplots(1, 2)
        weight_N, response_uT, sd_uT = (np.array(drawn[name]) for name in ("weight_N", "response_uT", "sd_uT"))
        left.fill_between(weight_N, response_uT - sd_uT, response_uT + sd_uT, color=COLOURS[6], linewidth=0)
        left.plot(weight_N, response_uT, color=COLOURS[1])
        left.set(xlabel="weight / N", ylabel="response / µT (mean, sd of a reading)")
        difference_N = numbers["step_N"] * np.arange(1, len(weight_N))
        for colour, (name, words) in zip(COLOURS[1:], READINGS.items(), strict=False):
            share_pct = 100 * np.array(drawn["told"][name])
            right.plot(difference_N, share_pct, "o-", color=colour, markersize=3, linewidth=1.2, label=words)
        told_pct = numbers["told_pct"]
        right.axhline(told_pct, color="0.3", linestyle="--", linewidth=1, label=f"{told_pct:g} %")
        right.axvline(paper.SENSITIVITY_N, color="0.6", linestyle=":", linewidth=1.2, label="paper: less than this")
        right.set(xscale="log", xlabel="difference of weight / N", ylabel="pairs in the right order / %")
        right.set_ylim(48, 102)  # half is chance
        right.legend(frameon=True, framealpha=1, edgecolor="none", fontsize=9, loc="lower right")
        figure.suptitle(f"A glass is filled on the skin ({source})", x=0.01, ha="left", fontsize=11)
        return {"sensitivity.svg": svg(figure)}


def _rises(rise: Mapping[str, Any]) -> str:
    ranks = f"rank correlation {rise['spearman']:.4f}"
    if "step_N" not in rise:
        return f"{INCONCLUSIVE}: no step stands out of noise; {ranks}"
    here = "rises" if rise["holds"] else "does not rise"
    rises_n = rise["pairs_n"] - rise["falls_n"]
    return (
        f"{FEW_BOARDS}; {here} on this one: {rises_n} of {rise['pairs_n']} pairs {rise['step_N']:.3g} N apart, {ranks}"
    )


def _falls(found: Mapping[str, Any], numbers: Mapping[str, Any]) -> str:
    expected = f", {found['expected_falls_n']:.1f} expected of noise" if "expected_falls_n" in found else ""
    return f"{found['falls_n']} of {numbers['levels_n'] - 1}{expected}"


def _show(steps_N: Mapping[str, float], name: str, numbers: Mapping[str, Any]) -> str:
    if name not in steps_N:
        return f"none up to {numbers['range_N']:g}"
    return f"{_least(steps_N[name], numbers)}{steps_N[name]:.3g}"


def _show_mL(name: str, numbers: Mapping[str, Any]) -> str:
    if name not in numbers["smallest_step_mL"]:
        return "none"
    return f"{_least(numbers['smallest_step_N'][name], numbers)}{numbers['smallest_step_mL'][name]:.2g}"


def _least(step_N: float, numbers: Mapping[str, Any]) -> str:
    return "at most " if step_N <= numbers["step_N"] else ""  # no finer one was tried

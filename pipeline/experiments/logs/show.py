"""An SD card's log: numbers and series -> two tables and one figure. Sees no readings, no models and no path."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

from pipeline.report import paper
from pipeline.report.drawing import COLOURS, drawing, svg

MEANING = (  # {rate_hz} comes from the numbers
    "A log at {rate_hz:.0f} Hz with nothing but times and readings, as a board writes it to an SD card: a quiet start, "
    "then footfalls at random places. The quiet start is the no-load reading; contact is a change of field well above "
    "its noise; places and forces are answered by networks that never saw the board, each scored by itself: ± is the "
    "standard deviation over {networks_n} network seeds. Errors are over the readings "
    "found in contact, against the truth that the simulator keeps. The board keeps its place: the earth's field is "
    "part of the no-load reading and stays as it is, which it does not in a dog's shoe or on a hand."
)
TURNING = (
    "The same log, as if the board pitched to either side by so much, as a sine once a step ({turning_period_s:.2g} s) "
    "in the earth's field of {earth_uT:.0f} µT, walking north (the worst way); the angles are assumed. What changes "
    "of that field passes for contacts. As a remedy, one chip more, aside and of the same make and noise, is read with "
    "every frame, and its reading is taken off all others, turned as the board's design turns each chip. Errors are "
    "over the readings found in contact that are: where more weak ones are found, the mean error of force falls. ± is "
    "the standard deviation over network seeds."
)
WAYS = {"as logged": None, "a chip's aside taken off": "reference_chip"}


def tables(numbers: Mapping[str, Any], source: str) -> dict[str, pd.DataFrame]:
    """Show what was found in the log, and how well where that is known; the paper shows its logs as videos."""
    account = numbers["account"]
    rows = [
        ("rate, Hz", f"{numbers['rate_hz']:.0f}", f"{paper.LOG_RATE_HZ:.0f}"),
        ("duration, s", f"{numbers['duration_s']:.1f}", "–"),
        ("readings", f"{numbers['readings_n']}", "–"),
        ("readings lost to failed reads and stuck chips", f"{account['rows_read_n'] - account['rows_n']}", "–"),
        ("frames missing in gaps of time", f"{account['gap_frames_n']}", "–"),
        ("contacts found", f"{numbers['contacts_n']}", "–"),
        ("contacts made", _show(numbers, "contacts_true_n"), "–"),
        ("readings in contact", f"{numbers['contact_readings_n']}", "–"),
        ("readings in contact that were missed", _show(numbers, "missed_readings_n"), "–"),
        ("largest force of a missed reading, N", _show(numbers, "missed_force_max_N"), "–"),
        ("readings without contact taken for one", _show(numbers, "false_readings_n"), "–"),
        ("largest force found, N", _show(numbers, "force_max_N"), "–"),
        ("largest force made, N", _show(numbers, "force_true_max_N"), "–"),
        ("accuracy, %", _show(numbers, "accuracy_pct"), "–"),
        ("MSE_xy, mm²", _show(numbers, "mse_xy_mm2"), "–"),
        ("MSE_F, N²", _show(numbers, "mse_f_N2"), "–"),
    ]
    table = pd.DataFrame(
        [{"what": what, "ours": ours, "paper": theirs, "source": source} for what, ours, theirs in rows]
    )
    table.attrs["meaning"] = MEANING.format(**{name: numbers[name] for name in ("rate_hz", "networks_n")})
    return {"logs": table} | ({"logs_turning": _turning(numbers, source)} if "turning" in numbers else {})


def _turning(numbers: Mapping[str, Any], source: str) -> pd.DataFrame:
    """Show what is found in the log of a board that turns, by its largest pitch."""
    rows = []
    for row in numbers["turning"]:
        for words, name in WAYS.items():
            own = row if name is None else row[name]
            rows.append(
                {
                    "pitch / °": f"± {row['pitch_deg']:g}",
                    "readings": words,
                    "contacts found": _show(own, "contacts_n"),
                    "contacts made": _show(numbers, "contacts_true_n"),
                    "readings without contact taken for one": _show(own, "false_readings_n"),
                    "readings in contact that were missed": _show(own, "missed_readings_n"),
                    "MSE_F / N²": _show(own, "mse_f_N2"),
                    "accuracy / %": _show(own, "accuracy_pct"),
                    "source": source,
                }
            )
    table = pd.DataFrame(rows)
    table.attrs["meaning"] = TURNING.format(**{name: numbers[name] for name in ("turning_period_s", "earth_uT")})
    return table


def figures(numbers: Mapping[str, Any], drawn: Mapping[str, Any], source: str) -> dict[str, str]:
    """Draw force, x and y over time, in contact only."""
    t_s = np.array(drawn["t_s"])
    with drawing(7.0, 5.0) as figure:
        panels = figure.subplots(3, 1, sharex=True, height_ratios=(2, 1, 1))
        for axes, name, label in zip(panels, ("F_N", "x_mm", "y_mm"), ("F / N", "x / mm", "y / mm"), strict=True):
            for which, colour, width in (("estimated", COLOURS[1], 1.8), ("true", COLOURS[2], 0.9)):
                if which in drawn:
                    axes.plot(t_s, np.array(drawn[which][name], float), color=colour, linewidth=width, label=which)
            if "low" in drawn:
                low, high = (np.array(drawn[which][name], float) for which in ("low", "high"))
                words = f"range over {numbers['networks_n']} network seeds"
                axes.fill_between(t_s, low, high, color=COLOURS[1], alpha=0.3, linewidth=0, label=words)
            axes.set_ylabel(label)
        panels[0].set_ylim(bottom=0)
        panels[1].set_ylim(-2, 18)  # the grid is 16 mm wide
        panels[2].set_ylim(-2, 18)
        panels[2].set_xlabel("time / s")
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False, fontsize=9)
        panels[0].set_title(f"A log at {numbers['rate_hz']:.0f} Hz ({source})", loc="left", fontsize=11)
        return {"logs.svg": svg(figure)}


def _show(numbers: Mapping[str, Any], name: str) -> str:
    if name not in numbers:
        return "unknown"
    if isinstance(numbers[name], int):
        return f"{numbers[name]}"
    spread = numbers.get("spread", {})
    return f"{numbers[name]:.3g}" + (f" ± {spread[name]:.2g}" if name in spread else "")

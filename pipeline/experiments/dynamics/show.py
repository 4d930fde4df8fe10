"""Presses that never rest: numbers -> one table and one figure. Sees no readings, no models and no path."""

from collections.abc import Mapping
from typing import Any

import pandas as pd

from pipeline.report import paper
from pipeline.report.drawing import COLOURS, MARKERS, drawing, svg
from pipeline.report.formatting import show_difference
from pipeline.report.statistics import VERDICTS, negated, verdict

MEANING = (
    "Half-sine presses at random places of the grid, every frame read. The model is the paper's network, trained on "
    "readings at rest of other boards. Scored are readings with four before them in the press and some force. The mean "
    "of the last five readings is the paper's protocol at rest; in a press the five see different depths. Against the "
    "force of its middle reading the same mean shows what of its error is lag: an answer that comes two frames late. "
    "Presses of one duration differ from those of another in depth and place too: compare the ways, at each duration. "
    f"± is the sd over network seeds; all presses are on one board. {VERDICTS}"
)
WAYS = {"one": "each reading alone", "mean5": "mean of the last five", "mean5_of_middle": "the same, two frames late"}
LESS = "less force error than each reading alone, N²"  # column
TICKS_S = (0.05, 0.1, 0.2, 0.5, 1.0)
METRICS = {"accuracy_pct": "accuracy / %", "mse_xy_mm2": "MSE_xy / mm²", "mse_f_N2": "MSE_F / N²"}


def tables(numbers: Mapping[str, Any], source: str) -> dict[str, pd.DataFrame]:
    """Show the errors of each way by duration of the press, and over all presses; the paper has none."""
    rows = [(f"{one['duration_s']:.2g}", one) for one in numbers["by_duration"]]
    rows.append(("all", numbers["all"] | {"n": numbers["readings_n"], "presses_n": numbers["presses_n"]}))
    table = pd.DataFrame(
        {
            "press lasts about, s": label,
            "presses": one["presses_n"],
            "readings": one["n"],
            "answered by": words,
            **{title: _show(one[way].get(name)) for name, title in METRICS.items()},
            "lag / ms": _show(_lag(numbers, way)) if label == "all" else "",
            LESS: _less(one) if way == "mean5" else "",
            "paper": paper.DYNAMICS if label == "all" and way == "one" else "",
            "source": source,
        }
        for label, one in rows
        for way, words in WAYS.items()
    )
    table.attrs["meaning"] = MEANING
    return {"dynamics": table}


def figures(numbers: Mapping[str, Any], drawn: Mapping[str, Any], source: str) -> dict[str, str]:
    """Draw errors of force and place against the press's duration."""
    with drawing(7.6, 3.8) as figure:
        panels = figure.subplots(1, 2)
        # A press stays where it is: against the middle's place the mean is as good as against the last one's.
        for axes, name, ways_n in zip(panels, ("mse_f_N2", "mse_xy_mm2"), (3, 2), strict=True):
            for i, (way, words) in enumerate(list(WAYS.items())[:ways_n]):
                points = [(one["duration_s"], one[way][name]) for one in numbers["by_duration"] if name in one[way]]
                duration_s = [where for where, _ in points]
                mean, sd = ([one.get(part, 0.0) for _, one in points] for part in ("mean", "sd"))
                axes.errorbar(
                    duration_s, mean, sd, color=COLOURS[i], marker=MARKERS[i], markersize=4.5, linewidth=1.2,
                    capsize=2, label=words,
                )  # fmt: skip
            axes.set(xscale="log", xlabel="duration of the press / s", ylabel=METRICS[name])
            axes.set_xticks(TICKS_S, [f"{one:g}" for one in TICKS_S])
            axes.minorticks_off()
            axes.set_ylim(bottom=0)
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False, fontsize=9)
        figure.suptitle(f"Presses read at {numbers['rate_hz']:.0f} Hz ({source})", x=0.01, ha="left", fontsize=11)
        return {"dynamics.svg": svg(figure)}


def _less(one: Mapping[str, Any]) -> str:
    """Judge whether the mean of the last five readings has less force error than each reading alone."""
    if "paired" not in one or "mse_f_N2" not in one["paired"]["mean5_minus_one"]:
        return "–"  # no force is known, or an older run
    difference = one["paired"]["mean5_minus_one"]["mse_f_N2"]
    return f"{verdict(negated(difference))}: {show_difference(difference)}"


def _lag(numbers: Mapping[str, Any], way: str) -> Mapping[str, float] | None:
    lag: Mapping[str, float] = numbers["lag_ms"].get(way, {})
    return lag if "mean" in lag else None


def _show(value: Mapping[str, float] | None) -> str:
    if value is None:
        return "–"
    return f"{value['mean']:.3g}" + (f" ± {value['sd']:.2g}" if "sd" in value else "")

"""Figures of learning on many skins, and its errors beside costs. In: rows. Out: SVG text and tables by file name.

Same rows, same bytes. Refuses to know how a model learnt, and paths.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib as mpl
import numpy as np
import pandas as pd

from pipeline.reporting.figures import STYLE, svg
from pipeline.reporting.order import SHORT
from pipeline.reporting.paper import ADAPTED_POKES_N, TABLE_2
from pipeline.reporting.shown import COLUMNS, scored, tabulate, to_markdown
from pipeline.reporting.trade_offs import adaptation, trade_off
from pipeline.reporting.work_precision import COLOURS, MARKERS

DRAWN = {"accuracy_pct": (0.0, 100.0), "mse_xy_mm2": (0.0, np.inf)}  # what is drawn, and what is possible
LINEAR_BELOW_N = 65  # pokes: a logarithm has no place for none
METHODS = ("multi", "triplet", "adapted")
COSTS = {"training": ("train_s", "median time of a training / s"),
         "inference": ("inference_us", "median time of one reading / µs")}  # fmt: skip

Rows = Sequence[Mapping[str, Any]]


@dataclass(frozen=True)
class Line:
    """Points of one line of a sweep: counts and scores, and how they are drawn."""

    name: str
    counts: Sequence[int]
    scores: Rows
    look: Mapping[str, Any]
    shift_pt: float = 0.0  # to the right, so that bars at one count stand beside each other


def learning_figures(numbers: Mapping[str, Any], source: str) -> Iterator[tuple[str, str]]:
    """Draw the sweeps that were asked for: file name and SVG text."""
    for name, draw in {"sweep_pokes": sweep_pokes, "sweep_sensors": sweep_sensors}.items():
        if name in numbers:
            yield f"{name}.svg", draw(numbers[name], source)


def learning_pages(runtime: Mapping[str, Any], source: str) -> dict[str, str]:
    """Draw and tabulate errors against costs: text by file name; no figure where nothing was timed here."""
    texts = {f"{name}.md": to_markdown(table) for name, table in learning_costs(runtime, source).items()}
    for name, (key, cost) in COSTS.items():
        if any(key in row for row in runtime.get("learning", [])):
            title = f"Error on new skins against {name} time ({source})"
            texts[f"{name}.svg"] = trade_off(runtime["learning"], key, title=title, cost=cost)
    if any("seconds" in row for row in runtime.get("adaptation", [])):
        texts["adaptation.svg"] = adaptation(runtime["adaptation"], source)
    return texts


def learning_costs(runtime: Mapping[str, Any], source: str) -> dict[str, pd.DataFrame]:
    """Tabulate errors beside costs, where those were measured: of methods, of adaptation by its pokes, of rivals."""
    methods = [
        {"method": row["method"], "inputs": row["inputs"], "training, s": _time(row, "train_s")}
        | {"one reading, µs": _time(row, "inference_us"), "source": source}
        | scored(row)
        for row in runtime.get("learning", [])
    ]
    adaptations = [
        {"pokes": str(row["pokes_n"]), "adaptation, s": _time(row, "seconds"), "source": source} | scored(row)
        for row in sorted(runtime.get("adaptation", []), key=lambda row: row["pokes_n"])
    ]
    rivals = [
        {"method": row["method"], "until ready, s": _time(row, "train_s")}
        | {"one reading, µs": _time(row, "inference_us"), "source": source}
        | scored(row)
        for row in runtime.get("rivals_costs", [])
        if "train_s" in row
    ]
    lines = {"learning": methods, "adaptation": adaptations, "rivals_costs": rivals}
    return {name: tabulate(lines[name]) for name in lines if name in runtime}


def sweep_pokes(rows: Rows, source: str) -> str:
    """Draw scores against the number of unlabelled pokes (figure 6a), beside the two that the paper prints."""
    ordered = sorted(rows, key=lambda row: row["pokes_n"])
    paper = [{m: {"mean": mean, "sd": sd} for m, (mean, sd) in TABLE_2[row].items()} for row in ("triplet", "adapted")]
    hollow = {"color": COLOURS[2], "marker": MARKERS[1], "markerfacecolor": "white", "linestyle": "none"}
    lines = [
        Line("ours", [row["pokes_n"] for row in ordered], ordered, {"color": COLOURS[1], "marker": MARKERS[0]}),
        Line("paper (table 2)", [0, ADAPTED_POKES_N], paper, hollow, shift_pt=5.0),
    ]
    return _sweep(lines, f"Adapted to a new skin by unlabelled pokes ({source})", "pokes of the new skin", log=True)


def sweep_sensors(rows: Rows, source: str) -> str:
    """Draw scores against the number of training skins (figure 6b), a line for each method."""
    lines = []
    for i, method in enumerate(METHODS):
        swept = sorted((row for row in rows if row["method"] == method), key=lambda row: row["skins_n"])
        look = {"color": COLOURS[1 + i], "marker": MARKERS[i]}
        if swept:
            lines.append(Line(SHORT[method], [row["skins_n"] for row in swept], swept, look, shift_pt=4.0 * (i - 1)))
    title = f"Scores on boards held out, by the number of training skins ({source})"
    return _sweep(lines, title, "training skins", log=False)


def bars(scores: Rows, metric: str) -> tuple[np.ndarray, np.ndarray]:
    """Find means and the lengths of their bars (down, up): the interval over boards, cut at what is possible.

    Of a few boards bars reach from the least to the largest value; without boards (the paper) they are one sd.
    """
    means = np.array([row[metric]["mean"] for row in scores])
    ends = np.array([_ends(row[metric]) for row in scores]).clip(*DRAWN[metric])
    return means, np.stack([means - ends[:, 0], ends[:, 1] - means]).clip(min=0)  # rounded numbers


def _ends(stat: Mapping[str, Any]) -> tuple[float, float]:
    sd = stat.get("sd", stat.get("sd_seeds", 0.0))
    values = stat.get("values", (stat["mean"] - sd, stat["mean"] + sd))
    low, high = stat.get("ci95", (min(values), max(values)))
    return low, high


def _sweep(lines: Sequence[Line], title: str, xlabel: str, *, log: bool) -> str:
    from matplotlib.figure import Figure

    counts = sorted({count for line in lines for count in line.counts})
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(5.6, 6.4), layout="constrained")
        for axes, metric in zip(figure.subplots(len(DRAWN), 1), DRAWN, strict=True):
            if log:
                axes.set_xscale("symlog", linthresh=LINEAR_BELOW_N, linscale=0.5)
                axes.set_xlim(-LINEAR_BELOW_N / 4, 1.3 * counts[-1])
            else:
                axes.set_xlim(counts[0] - 1, counts[-1] + 1)
            axes.set_xticks(counts, [str(count) for count in counts], rotation=90 if log else 0)
            axes.set_xticks([], minor=True)
            axes.set(xlabel=xlabel, ylabel=COLUMNS[metric].replace(", ", " / "))
            axes.grid(alpha=0.25)
            _bars(axes, lines, metric)
        figure.align_ylabels()
        look = {"loc": "outside lower left", "ncols": 2, "frameon": False, "fontsize": 9, "alignment": "left"}
        figure.legend(*axes.get_legend_handles_labels(), title=_about_bars(lines), title_fontsize=9, **look)
        figure.suptitle(title, x=0.01, ha="left", fontsize=10)
        return svg(figure)


def _bars(axes: Any, lines: Sequence[Line], metric: str) -> None:
    from matplotlib.transforms import ScaledTranslation

    ends: list[float] = []
    for line in lines:
        means, lengths = bars(line.scores, metric)
        shift = ScaledTranslation(line.shift_pt / 72, 0, axes.figure.dpi_scale_trans)
        style = {"linewidth": 1, "markersize": 5, "capsize": 2, "elinewidth": 0.8, **line.look}
        axes.errorbar(line.counts, means, lengths, transform=axes.transData + shift, label=line.name, **style)
        ends += [*(means - lengths[0]), *(means + lengths[1])]
    # What is shifted does not set the limits by itself.
    room = 0.05 * (max(ends) - min(ends)) or 1.0
    axes.set_ylim(min(ends) - room, max(ends) + room)


def _about_bars(lines: Sequence[Line]) -> str:
    stats = [row["accuracy_pct"] for line in lines for row in line.scores]
    kinds = {f"95 % interval over {stat['n']} boards" for stat in stats if "ci95" in stat}
    kinds |= {f"least to largest of {stat['n']} boards" for stat in stats if "values" in stat}
    kinds |= {"sd over seeds (one board)" for stat in stats if "sd" not in stat and "sd_seeds" in stat}
    if not kinds:
        return "No bars: one training each."
    of_paper = " (paper: sd)" if any("n" not in stat for stat in stats) else ""
    return f"Bars: {', '.join(sorted(kinds))}{of_paper}; cut at what is possible."


def _time(row: Mapping[str, Any], name: str) -> str:
    return f"{row[name]:.3g}" if name in row else "–"

"""The answer of a scene: does it work on a board never seen? In: numbers.json. Out: a figure, and a short table of it.

Ours and the paper's side by side. Refuses to know paths, and how anything was measured.
"""

import re
from collections.abc import Mapping, Sequence
from textwrap import fill
from typing import Any

import numpy as np
import pandas as pd

from pipeline.report.drawing import COLOURS, MARKERS, drawing, svg
from pipeline.report.figures import DRAWN, bars
from pipeline.report.formatting import COLUMNS, INTERVAL, OF_PAPER, Model, models, n_of, show, table_2_rows, tabulate

FILE = "headline.svg"
APART = 0.17  # of a row: ours above, the paper's below
ADAPTED = "Multi-sensor with triplet loss, adapted"  # so begins a title that is said shorter in the short table
SHORT_TABLE = ("accuracy_pct", "mse_xy_mm2", "mse_f_N2", "r2_f")
WITHIN = "Readings placed within 1 mm on boards"
OF_FEW = re.compile(r"\([\d.-]+(; [\d.-]+)+\)")  # values of a few boards
BRACKETS = "In brackets: 95 % interval over boards"
UNIVERSAL = "universal, "  # so begins what is told which skin it is on: the map with networks
EXPERTS = ("universal", 0)  # the map with networks, without a label
ANSWERING = ("multi", "adapted", "single")  # rows of table 2, the one that matters most first


def headline_figures(numbers: Mapping[str, Any], source: str) -> dict[str, str]:
    """Draw what the scene asked: scores on boards held out, also with ever more labels of the board; else nothing."""
    if "labels" in numbers:
        return {FILE: labels_figure(numbers, source)}
    return {FILE: table2_figure(numbers, source)} if numbers.get("table2") else {}


def answer(numbers: Mapping[str, Any]) -> str:
    """Say in one sentence how a model does on boards never seen, with intervals; nothing where none was held out."""
    if numbers.get("labels"):
        return _answer_with_labels(numbers["labels"])
    rows, known = numbers.get("table2", {}), models(numbers)
    shown = _experts(numbers) + [(known[name], rows[name]) for name in ANSWERING if name in rows]
    said = [
        f"{model.short} {show(row['accuracy_pct'])} %"
        + (f" (paper: {model.paper['accuracy_pct'][0]:.3g} %)" if model.paper else "")
        for model, row in shown
    ]
    return f"{WITHIN} and skins never seen: {_with_brackets('; '.join(said))}" if said else ""


def _experts(numbers: Mapping[str, Any]) -> list[tuple[Model, Mapping[str, Any]]]:
    """Give the experts of experiment population, told most pokes and no label, as a row beside those of table 2."""
    rows = [row for row in numbers.get("population", {}).get("told", ()) if (row["way"], row["labels_n"]) == EXPERTS]
    if not rows:
        return []
    most = max(rows, key=lambda row: row["pokes_n"])
    told = f"told {most['pokes_n']} unlabelled pokes"
    title = f"Universal, taught simulated skins, {told} (ours)"
    return [(Model(title, f"{UNIVERSAL}{told}", {}), most)]


def _told(rows: Sequence[Mapping[str, Any]]) -> tuple[list[int], dict[str, list[str]]]:
    """Give the least and the greatest number of labels, and by method its accuracies with them.

    The models that are told which skin they are on come first, then the first method, as the usual way.
    """
    methods = list(dict.fromkeys((row["method"], row["inputs"]) for row in rows))
    counts = sorted({row["labels_n"] for row in rows})
    ends = counts if len(counts) == 1 else [counts[0], counts[-1]]
    said = {}
    for method in [*(one for one in methods if one[0].startswith(UNIVERSAL)), methods[0]]:
        of_method = {row["labels_n"]: row for row in rows if (row["method"], row["inputs"]) == method}
        said[method[0]] = [show(of_method[n]["as_labelled"]["accuracy_pct"]) for n in ends if n in of_method]
    return ends, said


def _answer_with_labels(rows: Sequence[Mapping[str, Any]]) -> str:
    ends, said = _told(rows)
    boards_n = rows[0]["as_labelled"]["accuracy_pct"]["n"]
    scores = "; ".join(f"{method} {' and '.join(of_method)} %" for method, of_method in said.items())
    labels = f"with {' and '.join(map(str, ends))} labels of the new board"
    return f"{WITHIN} never seen, {labels}: {_with_brackets(scores, f' (n = {boards_n})')}"


def labels_table(rows: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """Tabulate place and force for a first look, a row a method: without a label, and with most of them."""
    ends, said = _told(rows)
    by_method = {(row["method"], row["labels_n"]): row["as_labelled"] for row in reversed(rows)}
    metrics = {"accuracy_pct": "within 1 mm, %", "r2_f": "R² of F"}
    lines = [
        {"boards never seen": method}
        | {
            f"{title}, {n} labels": show(by_method[method, n].get(metric))
            for metric, title in metrics.items()
            for n in ends
        }
        for method in said
    ]
    return tabulate(lines, spread=f"{INTERVAL}.")


def _with_brackets(said: str, boards: str = "") -> str:
    few = f"{said}. In brackets: each board's{boards}." if OF_FEW.search(said) else f"{said}."
    return f"{said}. {BRACKETS}{boards}." if "[" in said else few


def table2_figure(numbers: Mapping[str, Any], source: str) -> str:
    """Draw accuracy and MSE of each row of table 2 on boards held out, ours beside the paper's."""
    of_table = [row for name, row in table_2_rows(numbers).items() if name in numbers["table2"]]
    rows = _experts(numbers) + of_table
    y = np.arange(len(rows))[::-1].astype(float)
    with drawing(8.6, 0.9 + 0.55 * len(rows)) as figure:
        panels = figure.subplots(1, len(DRAWN), sharey=True)
        for axes, metric in zip(panels, DRAWN, strict=True):
            _draw(axes, metric, y + APART, [row for _, row in rows], f"ours, {source} (95 % interval over boards)")
            printed = [(at, model.paper) for at, (model, _) in zip(y, rows, strict=True) if model.paper]
            if printed:
                paper = [{metric: dict(zip(("mean", "sd"), words[metric], strict=True))} for _, words in printed]
                _draw(axes, metric, np.array([at for at, _ in printed]) - APART, paper, "paper (mean, sd)", hollow=True)
            axes.set(xlabel=COLUMNS[metric].replace(", ", " / "), xlim=(0, 1.18 * axes.dataLim.x1))
            axes.grid(axis="x", alpha=0.25)
        # A space that does not break holds a count together.
        names = [fill(f"{model.title} (n\xa0=\xa0{n_of(row)})", 34) for model, row in rows]
        panels[0].set_yticks(y, names, fontsize=9)
        panels[0].set_ylim(-0.6, len(rows) - 0.4)
        handles = panels[0].get_legend_handles_labels()
        figure.legend(*handles, loc="outside lower center", ncols=2, frameon=False, fontsize=9)
        title = (
            f"On boards never seen ({numbers['provenance']['scene']}, {source}; n boards held out, or pairs of skins)"
        )
        figure.suptitle(title, x=0.01, ha="left", fontsize=11)
        return svg(figure)


def labels_figure(numbers: Mapping[str, Any], source: str) -> str:
    """Draw accuracy and MSE of each method on boards held out, a point for each number of labels of the new board."""
    rows = numbers["labels"]
    methods = list(dict.fromkeys((row["method"], row["inputs"]) for row in rows))
    counts = sorted({row["labels_n"] for row in rows})
    with drawing(8.6, 1.1 + 0.32 * len(methods)) as figure:
        panels = figure.subplots(1, len(DRAWN), sharey=True)
        for axes, metric in zip(panels, DRAWN, strict=True):
            for i, count in enumerate(counts):
                found = [
                    (methods.index((row["method"], row["inputs"])), row) for row in rows if row["labels_n"] == count
                ]
                means = [row["as_labelled"][metric]["mean"] for _, row in found]
                style = {"color": COLOURS[i % len(COLOURS)], "marker": MARKERS[i % len(MARKERS)], "linestyle": "none"}
                axes.plot(means, [-at for at, _ in found], label=f"{count} labels", markersize=6, **style)
            axes.set(xlabel=COLUMNS[metric].replace(", ", " / "), xlim=(0, 100 if metric == "accuracy_pct" else None))
            axes.grid(alpha=0.25)
        names = [f"{method} ({inputs})" for method, inputs in methods]
        panels[0].set_yticks([-i for i in range(len(methods))], names, fontsize=9)
        handles = panels[0].get_legend_handles_labels()
        figure.legend(*handles, loc="outside lower center", ncols=len(counts), frameon=False, fontsize=9)
        boards_n = rows[0]["as_labelled"]["accuracy_pct"]["n"]
        about = f"means over {boards_n} boards held out in turn; intervals: table"
        title = f"On boards never seen, as labelled ({numbers['provenance']['scene']}, {source}; {about})"
        figure.suptitle(title, x=0.01, ha="left", fontsize=11)
        return svg(figure)


def short_table(numbers: Mapping[str, Any]) -> pd.DataFrame:
    """Tabulate the same in five rows for a first look: means with intervals, and in brackets the paper's means."""
    lines = []
    for model, row in [*_experts(numbers), *table_2_rows(numbers).values()]:
        line = {
            "boards never seen": model.title.replace("Multi-sensor with triplet loss, adapted", "The same, adapted")
        }
        for metric in SHORT_TABLE:
            paper = f" ({model.paper[metric][0]:.3g})" if metric in model.paper else ""
            line[f"{COLUMNS[metric]} (paper)" if metric in OF_PAPER else COLUMNS[metric]] = (
                show(row.get(metric)) + paper
            )
        lines.append(line | {"n": n_of(row)})
    return tabulate(lines, spread=f"{INTERVAL}; n boards, or pairs of skins for one skin on others")


def _draw(
    axes: Any, metric: str, y: np.ndarray, rows: Sequence[Mapping[str, Any]], label: str, *, hollow: bool = False
) -> None:
    means, lengths = bars(rows, metric)
    colour = COLOURS[0] if hollow else COLOURS[1]
    face = "white" if hollow else colour
    style = {"color": colour, "markerfacecolor": face, "markersize": 6, "capsize": 3, "linewidth": 1.2}
    axes.errorbar(means, y, xerr=lengths, fmt="s" if hollow else "o", label=label, **style)
    for mean, length, at in zip(means, lengths[1], y, strict=True):
        beside = {"xytext": (4, 0), "textcoords": "offset points", "va": "center", "fontsize": 9, "color": colour}
        axes.annotate(f"{mean:.3g}", (mean + length, at), **beside)

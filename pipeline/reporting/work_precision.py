"""Figures of error against run time, as SciMLBenchmarks draws them. In: rows and seconds. Out: SVG text.

Same rows and seconds, same bytes. Refuses to know how errors were found, and paths.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from math import ceil
from textwrap import fill
from typing import Any, TypeVar

import matplotlib as mpl
import pandas as pd

from pipeline.experiments.runtime.rows import CANDIDATES, ERROR_MAX, REFERENCE, Choice, Key, Precision, Seconds
from pipeline.reporting.figures import STYLE, svg
from pipeline.reporting.shown import tabulate, to_markdown

# Okabe & Ito 2008, told apart by colour-blind readers; their yellow is left out, which is pale on white.
COLOURS = ("#000000", "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
MARKERS = ("o", "s", "^", "D", "v", "P", "X")
LOWEST = 1e-16  # rounding: no error is drawn below it, for the axis is logarithmic
COLUMNS_N = 3
COMPUTED = (
    "Computed: what the stage cost when its results were computed, its trainings added up as if one ran after another "
    "(two run side by side, so that less time passes). Last run: what passed when it ran last; trainings that were "
    "finished before are reused."
)
CAPTION_LETTERS = 38  # in the width of a panel, and in that of the legend
STUDIES = ("quadratures", "integrators")
Kind = TypeVar("Kind", Precision, Seconds)


@dataclass(frozen=True)
class Words:
    """What a figure says besides its data: a line at `limit`, a ring around each of `rings`."""

    title: str
    error: str
    note: str = ""
    limit: float | None = None
    rings: Mapping[str, Key] = field(default_factory=dict)


def pages(numbers: Mapping[str, Any], *, source: str) -> dict[str, str]:
    """Draw and tabulate the studies that were done: text by file name; nothing where nothing was timed here."""
    tables = cost_tables(numbers, source)
    texts = {f"{name}.md": to_markdown(costs_table) for name, costs_table in tables.items()}
    for study in STUDIES:
        if study in tables:
            rows = [_of(Precision, row) for row in numbers[study]]
            seconds = [_of(Seconds, row) for row in numbers[study] if "median_s" in row]
            if study == "quadratures":
                texts["quadratures.svg"] = quadratures(rows, seconds, Choice(**numbers["choice"]), source=source)
            else:
                texts["integrators.svg"] = integrators(rows, seconds)
    return texts


def _of(kind: type[Kind], row: Mapping[str, Any]) -> Kind:
    return kind(**{part.name: row[part.name] for part in fields(kind)})


def cost_tables(numbers: Mapping[str, Any], source: str) -> dict[str, pd.DataFrame]:
    """Tabulate what stages cost, and the studies of which something was timed here, by name."""
    timed = [name for name in STUDIES if any("median_s" in row for row in numbers.get(name, []))]
    return {name: table(numbers[name], source) for name in timed} | {"stages": costs(numbers["stages"])}


def costs(stages: Mapping[str, Mapping[str, float]]) -> pd.DataFrame:
    """List what each stage cost when it was computed, and what its last run took."""
    rows = [
        {
            "stage": name,
            "computed, s": f"{cost['computed_s']:.1f}",
            "last run, s": f"{cost['seconds']:.1f}",
            "CPU of it, s": f"{cost['cpu_s']:.1f}" if "cpu_s" in cost else "–",  # older costs lack it
            "trainings": str(cost["trainings_n"]),
            "of them reused": str(cost["reused_n"]),
            "peak memory of a process, MB": f"{cost['peak_process_memory_MB']:.0f}",
        }
        for name, cost in stages.items()
    ]
    return tabulate(rows, meaning=COMPUTED)


def table(rows: Sequence[Mapping[str, Any]], source: str) -> pd.DataFrame:
    """List every way that was tried: its work, error and time, or why it failed."""
    return pd.DataFrame(
        {
            "study": row["study"],
            "method": row["method"],
            "setting": row["setting"],
            "nodes or right-hand sides": str(row["work_n"]),
            "error": "–" if row["error"] is None else f"{row['error']:.2g}",
            "median ms an indentation": f"{1e3 * row['median_s']:.3g}" if "median_s" in row else "–",
            "failed": row["failure"] or "",
            "source": source,
        }
        for row in rows
    )


def quadratures(rows: Sequence[Precision], seconds: Sequence[Seconds], choice: Choice, *, source: str) -> str:
    """Draw the study of quadratures, with its limit, the rule to be chosen and the one in use."""
    study = rows[0].study
    ringed = {"cheapest below it": choice.setting, "in use": choice.used_setting if choice.used_error else None}
    words = Words(
        title=f"Error of dB against run time ({source})",
        error="rms error / rms dB, worst skin and depth",
        note="Kernel alone and magpylib: the field only, their nodes were moved before. All else: flow and field.",
        limit=ERROR_MAX,
        rings={f"{what}: {setting}": (study, CANDIDATES, setting) for what, setting in ringed.items() if setting},
    )
    return draw(rows, seconds, words)


def integrators(rows: Sequence[Precision], seconds: Sequence[Seconds]) -> str:
    """Draw the study of integrators, a panel for each ratio of the slowest relaxation to the fastest."""
    words = Words(title="Error of the relaxed force against run time", error="rms error / rms force")
    return draw(rows, seconds, words)


def draw(rows: Sequence[Precision], seconds: Sequence[Seconds], words: Words) -> str:
    """Draw error against median time, log-log: a panel a study, a colour and a marker a method, failures below.

    Lines join what is best for its time.
    """
    from matplotlib.figure import Figure

    studies = list(dict.fromkeys(row.study for row in rows))
    methods = [name for name in dict.fromkeys(row.method for row in rows) if name != REFERENCE]
    columns_n = min(COLUMNS_N, len(studies))
    lines_n = ceil(len(studies) / columns_n)
    caption = "\n".join(fill(line, CAPTION_LETTERS * (1 + columns_n)) for line in (words.note, *failures(rows)))
    with mpl.rc_context(STYLE):
        size_in = (3.2 + 2.6 * columns_n, max(1.2 + 2.6 * lines_n + 0.15 * caption.count("\n"), 5.0))
        figure = Figure(figsize=size_in, layout="constrained")
        panels = figure.subplots(lines_n, columns_n, sharex=True, sharey=True, squeeze=False)
        points = _points_ms(rows, seconds)
        for axes, study in zip(panels.flat, studies, strict=False):
            axes.set(xscale="log", yscale="log")
            axes.grid(alpha=0.25)
            axes.set_title(study, loc="left", fontsize=9)
            _lines(axes, {key: point for key, point in points.items() if key[0] == study}, methods)
            _marks(axes, [row.error for row in rows if row.key[:2] == (study, REFERENCE)], points, words)
        _frame(figure, panels, len(studies), words.error)
        figure.suptitle(words.title, x=0.01, ha="left", fontsize=10)
        figure.supxlabel(caption, x=0.01, ha="left", fontsize=9)
        return svg(figure)


def failures(rows: Sequence[Precision]) -> list[str]:
    """List what failed: a line for each method and kind of failure, with the studies and settings where it did."""
    found: dict[tuple[str, str], dict[str, list[str]]] = {}
    for row in rows:
        if row.failure is not None:
            kind = row.failure.split(":")[0]
            found.setdefault((row.method, kind), {}).setdefault(row.study, []).append(row.setting)
    return [
        f"Failed: {method}, {kind}: " + "; ".join(f"{study} ({', '.join(where)})" for study, where in places.items())
        for (method, kind), places in found.items()
    ]


def front(points: Iterable[tuple[float, float]]) -> list[tuple[float, float]]:
    """Keep the points (time, error) than which none is both faster and more exact, by time."""
    kept: list[tuple[float, float]] = []
    for time, error in sorted(points):
        if not kept or error < kept[-1][1]:
            kept.append((time, error))
    return kept


def _points_ms(rows: Sequence[Precision], seconds: Sequence[Seconds]) -> dict[Key, tuple[float, float]]:
    times_ms = {time.key: 1e3 * time.median_s for time in seconds}
    timed = [row for row in rows if row.error is not None and row.method != REFERENCE]
    return {row.key: (times_ms[row.key], max(row.error or 0.0, LOWEST)) for row in timed}


def _lines(axes: Any, points: Mapping[Key, tuple[float, float]], methods: Sequence[str]) -> None:
    for i, method in enumerate(methods):
        of_method = [point for key, point in points.items() if key[1] == method]
        if of_method:
            colour, marker = COLOURS[i % len(COLOURS)], MARKERS[i % len(MARKERS)]
            axes.plot(*zip(*front(of_method), strict=True), color=colour, linewidth=1)
            axes.plot(*zip(*of_method, strict=True), marker, color=colour, markersize=4.5, label=method)


def _marks(
    axes: Any, reference: Sequence[float | None], points: Mapping[Key, tuple[float, float]], words: Words
) -> None:
    for error in reference:
        axes.axhline(error, color="0.5", linestyle=":", linewidth=1, label=f"{REFERENCE}'s own error, at most")
    if words.limit is not None:
        axes.axhline(words.limit, color="0.3", linestyle="--", linewidth=1, label=f"{100 * words.limit:.3g} %")
    for size, (label, key) in enumerate(words.rings.items()):
        axes.plot(*points[key], "so"[size % 2], color="0.2", fillstyle="none", markersize=11 + 2 * size, label=label)


def _frame(figure: Any, panels: Any, studies_n: int, error: str) -> None:
    # Words at the outer axes only, and each label of the legend once, though it stands in every panel.
    for axes in panels[-1]:
        axes.set_xlabel("median time an indentation / ms")
    for axes in panels[:, 0]:
        axes.set_ylabel(error)
    named: dict[str, Any] = {}
    for axes in panels.flat[:studies_n]:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            named.setdefault(label, handle)
    for axes in panels.flat[studies_n:]:
        axes.set_axis_off()
    figure.legend(named.values(), named.keys(), loc="outside right upper", frameon=False, fontsize=8)

"""Tables and figures of error against the run times measured on this machine (`reports/<scene>/runtime`)."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import pandas as pd

from pipeline.experiments.runtime import CANDIDATES, ERROR_MAX, REFERENCE
from pipeline.formatting import scored, tabulate, to_markdown
from pipeline.plot import COLOURS, MARKERS, drawing, svg

STUDIES = ("quadratures", "integrators")
COMPUTED = (
    "Column computed is the time that a stage takes to compute all its results if its training runs run one after "
    "another. By default, two training runs run at the same time, so less time passes. Columns last run are about the "
    "last run of the stage. The last run may have taken less time than computed, because it reuses training runs that "
    "were completed before."
)
# About the size of rounding errors. Smaller errors are drawn at this value, because a logarithmic axis cannot show 0.
ERROR_SHOWN_MIN = 1e-16

Row = Mapping[str, Any]
Rows = Sequence[Row]


def cost_pages(runtime: Row, source: str) -> dict[str, str]:
    """Draw and tabulate errors against run times; return the texts of the figures and tables by file name."""
    texts = {f"{name}.md": to_markdown(table) for name, table in cost_tables(runtime, source).items()}
    if "quadratures.md" in texts:
        texts["quadratures.svg"] = quadratures(runtime["quadratures"], runtime["choice"], source)
    if "integrators.md" in texts:
        texts["integrators.svg"] = integrators(runtime["integrators"])
    return texts


def cost_tables(runtime: Row, source: str) -> dict[str, pd.DataFrame]:
    """Tabulate the costs of stages, and the errors and costs of adaptation and timed studies, by name."""
    adaptations = [
        {"pokes": str(row["pokes_n"]), "adaptation, s": _time(row, "seconds"), "source": source} | scored(row)
        for row in sorted(runtime.get("adaptation", []), key=lambda row: row["pokes_n"])
    ]
    tables = {"adaptation": tabulate(adaptations)} if "adaptation" in runtime else {}
    timed = [name for name in STUDIES if any("median_s" in row for row in runtime.get(name, []))]
    tables |= {name: study_table(runtime[name], source) for name in timed}
    return tables | ({"stages": stage_costs(runtime["stages"])} if "stages" in runtime else {})


def stage_costs(stages: Mapping[str, Mapping[str, float]]) -> pd.DataFrame:
    """List the cost of computing each stage and the time of its last run."""
    lines = [
        {
            "stage": name,
            "computed, s": f"{cost['computed_s']:.1f}",
            "last run, s": f"{cost['seconds']:.1f}",
            "last run, CPU s": f"{cost['cpu_s']:.1f}" if "cpu_s" in cost else "–",  # missing in older records of costs
            "training runs": str(cost["trainings_n"]),
            "reused training runs": str(cost["reused_n"]),
            "peak memory per process, MB": f"{cost['peak_process_memory_MB']:.0f}",
        }
        for name, cost in stages.items()
    ]
    return tabulate(lines, meaning=COMPUTED)


def study_table(rows: Rows, source: str) -> pd.DataFrame:
    """List every method and setting of a study with its work, error and time, or with the reason for its failure."""
    lines = [
        {
            "study": row["study"],
            "method": row["method"],
            "setting": row["setting"],
            "number of nodes or right-hand sides": str(row["work_n"]),
            "error": "–" if row["error"] is None else f"{row['error']:.2g}",
            "median ms per indentation": f"{1e3 * row['median_s']:.3g}" if "median_s" in row else "–",
            "failure": row["failure"] or "",
            "source": source,
        }
        for row in rows
    ]
    return tabulate(lines)


def _time(row: Row, name: str) -> str:
    return f"{row[name]:.3g}" if name in row else "–"


def front(points: Iterable[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return the Pareto front of points (cost, error), sorted by cost."""
    kept: list[tuple[float, float]] = []
    for cost, error in sorted(points):
        if not kept or error < kept[-1][1]:
            kept.append((cost, error))
    return kept


def quadratures(rows: Rows, choice: Mapping[str, Any], source: str) -> str:
    """Draw error against run time of quadratures; mark the error limit, the cheapest rule below it, and that in use."""
    study = rows[0]["study"]
    rings = {}
    if choice["setting"]:
        rings[f"cheapest below the limit: {choice['setting']}"] = (study, CANDIDATES, choice["setting"])
    if choice["used_error"]:
        rings[f"in use: {choice['used_setting']}"] = (study, CANDIDATES, choice["used_setting"])
    return draw_study(
        rows,
        title=f"Error of the field change dB against run time ({source})",
        error="rms error / rms dB (worst skin and depth)",
        note="Times of method kernel alone and of magpylib include only the computation of the field, because the "
        "nodes were moved before. Times of all other methods include the motion of the nodes (flow) and the field.",
        limit=ERROR_MAX,
        rings=rings,
    )


def integrators(rows: Rows) -> str:
    """Draw error against run time of integrators, with one panel per ratio of slowest to fastest relaxation."""
    return draw_study(rows, title="Error of the relaxed force against run time", error="rms error / rms force")


def draw_study(
    rows: Rows,
    *,
    title: str,
    error: str,
    note: str = "",
    limit: float | None = None,
    rings: Mapping[str, tuple[str, str, str]] | None = None,
) -> str:
    """Draw error against median time on logarithmic axes, with one panel per study; list failures below the panels.

    Each method has its own colour and marker, and a line joins the points on its Pareto front. `limit` is an error that
    is drawn as a line. `rings` maps a label to the study, method and setting of a point that is marked with a ring.
    Rows that were not timed are left out.
    """
    studies = list(dict.fromkeys(row["study"] for row in rows))
    methods = [name for name in dict.fromkeys(row["method"] for row in rows) if name != REFERENCE]
    points_ms = {
        (row["study"], row["method"], row["setting"]): (1e3 * row["median_s"], max(row["error"], ERROR_SHOWN_MIN))
        for row in rows
        if row["method"] != REFERENCE and row["error"] is not None and "median_s" in row
    }
    with drawing(4.7, 2.5 + 1.9 * len(studies)) as figure:
        panels = figure.subplots(len(studies), 1, sharex=True, sharey=True, squeeze=False)[:, 0]
        for axes, study in zip(panels, studies, strict=True):
            axes.set(xscale="log", yscale="log")
            axes.grid(alpha=0.25)
            axes.set_title(study, loc="left", fontsize=9)
            for i, method in enumerate(methods):
                points = [point for key, point in points_ms.items() if key[:2] == (study, method)]
                if points:
                    colour, marker = COLOURS[i % len(COLOURS)], MARKERS[i % len(MARKERS)]
                    axes.plot(*zip(*front(points), strict=True), color=colour, linewidth=1)
                    axes.plot(*zip(*points, strict=True), marker, color=colour, markersize=4.5, label=method)
            for row in rows:
                if (row["study"], row["method"]) == (study, REFERENCE):
                    label = f"upper bound of the {REFERENCE}'s own error"
                    axes.axhline(row["error"], color="0.5", linestyle=":", linewidth=1, label=label)
            if limit is not None:
                axes.axhline(limit, color="0.3", linestyle="--", linewidth=1, label=f"limit: {100 * limit:.3g} %")
            for i, (label, key) in enumerate((rings or {}).items()):
                if key not in points_ms:
                    continue
                ring = {"color": "0.2", "fillstyle": "none", "markersize": 11 + 2 * i}
                axes.plot(*points_ms[key], "so"[i % 2], label=label, **ring)
        panels[-1].set_xlabel("median time per indentation / ms")
        panels[len(panels) // 2].set_ylabel(error)
        labelled = [axes.get_legend_handles_labels() for axes in panels]
        handles = {label: handle for panel in reversed(labelled) for handle, label in zip(*panel, strict=True)}
        names = dict.fromkeys(label for _, labels in labelled for label in labels)
        look = {"loc": "outside lower left", "frameon": False, "fontsize": 8, "alignment": "left"}
        caption = "\n".join(line for line in (note, *failures(rows)) if line)
        figure.legend([handles[name] for name in names], names, title=caption, title_fontsize=8, ncols=2, **look)
        figure.suptitle(title, x=0.01, ha="left", fontsize=10)
        return svg(figure)


def failures(rows: Rows) -> list[str]:
    """List failures, with one line per method and kind of failure that names the failed settings of each study."""
    failed: dict[tuple[str, str], dict[str, list[str]]] = {}
    for row in rows:
        if row["failure"] is not None:
            kind = row["failure"].split(":")[0]
            failed.setdefault((row["method"], kind), {}).setdefault(row["study"], []).append(row["setting"])
    return [
        f"Failed: {method}, {kind}: "
        + "; ".join(f"{study} ({', '.join(settings)})" for study, settings in by_study.items())
        for (method, kind), by_study in failed.items()
    ]

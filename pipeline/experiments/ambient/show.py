"""Fields from outside and iron nearby: numbers -> a table and a figure. Sees no model, no physics and no path.

The paper has no number to stand beside: it names the question as future work (section 7).
"""

from collections.abc import Mapping, Sequence
from typing import Any

import pandas as pd

from pipeline.report.drawing import COLOURS, MARKERS, drawing, svg
from pipeline.report.formatting import show_digits

COLUMNS = {
    "accuracy_pct": ("accuracy, %", 1), "mse_xy_mm2": ("MSE_xy, mm²", 2), "mse_f_N2": ("MSE_F, N²", 3),
}  # fmt: skip
DASHES = ("-", "--", "-.")  # two arms lie on each other where nothing is regained


def tables(numbers: Mapping[str, Any], source: str) -> dict[str, pd.DataFrame]:
    """Tabulate every arm in every field, over held-out boards and on the last one, where every arm was tried."""
    last = numbers["last_board"]
    parts = (("all held out", numbers), (str(last["board"]), last))
    rows = [
        {"field": words, "boards": boards, "method": arm} | _scores(row[arm]) | {"source": source}
        for boards, part in parts
        for kind in ("uniform", "iron")
        for row in part[kind]
        for words in [_field(kind, row)]
        for arm in numbers["arms"]
        if arm in row and (boards == last["board"] or row[arm]["mse_xy_mm2"]["n"] == numbers["boards_n"])
    ]
    table = pd.DataFrame(rows)
    meanings = "; ".join(f"{arm}: {words}" for arm, words in numbers["arms"].items())
    table.attrs["meaning"] = (
        "The field comes up after the no-load reading, so it stays in the change of field. The direction of a uniform "
        f"field: {numbers['directions']}. The ball of iron, {2 * numbers['iron_radius_mm']:g} mm across, "
        f"lies right above the skin's middle, in the earth's field ({numbers['earth_uT']:g} µT, dipping "
        f"{numbers['earth_dip_deg']:g}°) and the skin's own. {meanings}. The last arm is trained for board "
        f"{last['board']} alone: compare arms there. [low, high] is the 95 % interval over held-out boards (Student's "
        f"t); ± (seeds) the standard deviation over {numbers['seeds_n']} network seeds on one board, mean over boards. "
        "The paper gives no number (section 7: future work)."
    )
    return {"ambient": table}


def figures(numbers: Mapping[str, Any], drawn: Mapping[str, Any], source: str) -> dict[str, str]:
    """Draw accuracy against the strength of a uniform field and the distance of the iron, on the last board."""
    last, arms = numbers["last_board"], list(numbers["arms"])
    with drawing(7.8, 4.6) as figure:
        left, right = figure.subplots(1, 2, sharey=True)
        _draw(left, last["uniform"], "field_uT", arms)
        _draw(right, last["iron"], "distance_mm", arms)
        left.axvline(numbers["earth_uT"], color="0.5", linestyle=":")
        left.annotate(
            "earth", (numbers["earth_uT"], 98), xytext=(3, 0), textcoords="offset points", va="top", fontsize=9
        )
        left.set(xlabel="uniform field / µT", ylabel="accuracy / %", ylim=(0, 100))
        right.set(xscale="log", xlabel="iron ball above the skin / mm")
        ticks_mm = [row["distance_mm"] for row in last["iron"]]
        right.set_xticks(ticks_mm, [f"{mm:g}" for mm in ticks_mm])
        right.minorticks_off()
        handles, labels = left.get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", frameon=False, fontsize=9, ncols=2)
        words = f"Fields from outside, board {last['board']} never seen ({source})"
        figure.suptitle(words, x=0.01, ha="left", fontsize=11)
        return {"ambient.svg": svg(figure)}


def _draw(axes: Any, rows: Sequence[Mapping[str, Any]], axis: str, arms: Sequence[str]) -> None:
    for i, arm in enumerate(arms):
        shown = [(row[axis], row[arm]["accuracy_pct"]["mean"]) for row in rows]
        axes.plot(*zip(*shown, strict=True), color=COLOURS[i], marker=MARKERS[i], linestyle=DASHES[i], label=arm)
    axes.grid(alpha=0.25)


def _field(kind: str, row: Mapping[str, Any]) -> str:
    if kind == "uniform":
        return f"uniform, {row['field_uT']:g} µT"
    return f"iron at {row['distance_mm']:g} mm ({row['field_uT']:.2g} µT at the chips)"


def _scores(stats: Mapping[str, Mapping[str, Any]]) -> dict[str, str]:
    return {words: show_digits(stats[name], digits) for name, (words, digits) in COLUMNS.items() if name in stats}

"""Two contacts at once: numbers -> a table and a figure. Sees no model, no reading and no path.

The paper has no number to stand beside: it names the question as future work (section 7).
"""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import pandas as pd

from pipeline.report.drawing import COLOURS, MARKERS, drawing, svg
from pipeline.report.formatting import show_digits

MEANING = (
    "Two contacts are the sum of two changes of field that were read of one held-out skin, so their noise is that of "
    "two readings. A network that knows single contacts answers one place and one force. Detected: odder, by a "
    "detector, than all but the asked share of single contacts of training skins; of the held-out boards' single "
    "contacts the share called so too is the realised false alarm. The networks behind residual and networks disagree "
    "were trained on the contacts that thresholds are set on, so their thresholds may be too low. At 0 mm both pokes "
    "are at one place: what strength and noise alone do. [low, high] is the 95 % interval over "
    "held-out boards (Student's t). The paper gives no number (section 7: future work)."
)
TWO_TIPS = "Two tips cannot stand nearer than they are wide; smaller distances are sums all the same."


def tables(numbers: Mapping[str, Any], source: str) -> dict[str, pd.DataFrame]:
    """Tabulate what is answered and what is told, by distance; and how far fields are from adding."""
    rows = [_row(numbers["same_place"], numbers), *(_row(one, numbers) for one in numbers["by_separation"])]
    false_alarm = {"distance of the two, mm": "single contacts"} | {
        f"detected by {name}, %": show_digits(one["realised"], 1) for name, one in numbers["false_alarm_pct"].items()
    }
    table = pd.DataFrame([*rows, false_alarm]).fillna("–").assign(source=source)
    asked = next(iter(numbers["false_alarm_pct"].values()))["asked"]
    table.attrs["meaning"] = f"{MEANING} Thresholds ask for {asked:g} % false alarms. {TWO_TIPS}"
    found = {"contacts": table}
    if "superposition" in numbers:
        found["superposition"] = _superposition(numbers["superposition"], source)
    return found


def figures(numbers: Mapping[str, Any], drawn: Mapping[str, Any], source: str) -> dict[str, str]:
    """Draw where answers fall between two contacts, and how often two are told from one."""
    with drawing(7.8, 4.4) as figure:
        left, right = figure.subplots(1, 2)
        _draw_places(left, drawn["along"])
        _draw_detection(right, numbers)
        figure.suptitle(f"Two contacts at once on skins never seen ({source})", x=0.01, ha="left", fontsize=11)
        return {"contacts.svg": svg(figure)}


def _draw_places(axes: Any, along: Mapping[str, Sequence[float]]) -> None:
    separations_mm = sorted(map(float, along))
    width_mm = 0.5 * min([b - a for a, b in pairwise(separations_mm)] or [1.0])
    places_mm = [[mm * share for share in along[f"{mm:g}"]] for mm in separations_mm]
    boxes = {"widths": width_mm, "showfliers": False, "manage_ticks": False, "medianprops": {"color": COLOURS[0]}}
    axes.boxplot(places_mm, positions=separations_mm, whis=(5, 95), **boxes)
    ends_mm = [separations_mm[0] - width_mm, separations_mm[-1] + width_mm]
    axes.plot(ends_mm, ends_mm, color=COLOURS[2], label="stronger contact")
    axes.plot(ends_mm, [0, 0], color=COLOURS[1], linestyle="--", label="weaker contact")
    axes.set(xlabel="distance of the two / mm", ylabel="answer, along their line / mm")
    axes.set_title("One answer (box: half; whiskers: 90 %)", loc="left", fontsize=10)
    axes.set_ylim(top=1.45 * ends_mm[1])
    axes.legend(frameon=False, loc="upper left", fontsize=9)


def _draw_detection(axes: Any, numbers: Mapping[str, Any]) -> None:
    rows, together = numbers["by_separation"], numbers["same_place"]
    distance_mm = [row["separation_mm"] for row in rows]
    for i, (name, alarm) in enumerate(numbers["false_alarm_pct"].items()):
        told = [row["detected_pct"][name]["mean"] for row in rows]
        colour, marker = COLOURS[i % len(COLOURS)], MARKERS[i % len(MARKERS)]
        axes.plot(distance_mm, told, color=colour, marker=marker, label=name)
        at_one = together["detected_pct"][name]["mean"]
        axes.plot(
            together["separation_mm"], at_one, color=colour, marker=marker, markerfacecolor="white", clip_on=False
        )
        axes.axhline(alarm["realised"]["mean"], color=colour, linestyle=":", linewidth=1)
    axes.set(xlabel="distance of the two / mm", ylabel="called two contacts / %", ylim=(0, 100))
    axes.set_title("Told as two (dotted: one called two;\nhollow: both at one place)", loc="left", fontsize=10)
    axes.legend(frameon=False, loc="upper left", fontsize=9)


def _row(one: Mapping[str, Any], numbers: Mapping[str, Any]) -> dict[str, str]:
    row = {
        "distance of the two, mm": f"{one['separation_mm']:g}",
        "answer within 1 mm of either, %": show_digits(one["near_either_pct"], 1),
        "distance to the nearer, mm": show_digits(one["nearest_mm"], 2),
    }
    optional = {
        "along": "along the line (0 weaker, 1 stronger)",
        "force_over_sum": "force / sum of both",
        "force_over_larger": "force / larger of both",
    }
    row |= {words: show_digits(one[name], 2) for name, words in optional.items() if name in one}
    return row | {
        f"detected by {name}, %": show_digits(one["detected_pct"][name], 1) for name in numbers["false_alarm_pct"]
    }


def _superposition(rows: Sequence[Mapping[str, Any]], source: str) -> pd.DataFrame:
    table = pd.DataFrame(
        {
            "depth of both, mm": f"{row['depth_mm']:g}",
            "distance of the two, mm": f"{row['separation_mm']:g}",
            "error of the sum, % of the change of field": f"{row['error_pct']:.1f}",
            "orders differ by, %": f"{row['orders_differ_pct']:.1f}",
            "pairs": row["pairs_n"],
            "source": source,
        }
        for row in rows
    )
    table.attrs["meaning"] = (
        "The sum of two changes of field against both contacts on one skin, the second displacing what the first has "
        "moved (mean of both orders; rms over chips and pairs). How one contact lowers the surface under the other is "
        "left out."
    )
    return table

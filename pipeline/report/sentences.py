"""Sentences below figures: what a figure shows, with numbers from the results, or what to look for."""

import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from pipeline.formatting import TITLES
from pipeline.paper import TABLE_2
from pipeline.report.figures import HEADLINE, IN_CONTEXT, unseen_rows

Numbers = Mapping[str, Any]  # numbers.json of one scene
# Places where no line break is allowed: between a number and its unit.
UNIT, NO_BREAK = re.compile(r"(?<=\d) (?=%|N\b|mm\b)"), "\u00a0"
MAPS = "Colours show the mean error at each place of the skin. A colour means the same error in all maps."
# The sentences that contain no results, by figure. They tell the reader what to look for in the figure.
LOOK = {
    "variation_time.svg": "Each line shows how much the field has changed since the first press at this place. The "
    "colour of a line is the number of contacts before it.",
    "variation_skins.svg": "The indentations are equal on all skins, but the fields differ. A network has to cope with "
    "this difference if it is used on a new skin.",
    "drift.svg": "Where the line of a policy is worse than the others, its no-load readings are too old. The skin also "
    "softens with every contact.",
    "drift_force.svg": "Points above the line are forces that are estimated too high.",
    "sensitivity.svg": "At the difference in weight where a curve crosses the line of 95 %, 95 of 100 pairs of "
    "readings are ordered correctly.",
    "logs.svg": "Where the two lines of the force differ, the model misses a contact, reports a contact that does not "
    "exist, or estimates a wrong force.",
    "interference.svg": "Look for values of the option external_uT at which false contacts are rare and places are "
    "still accurate.",
    "gripper.svg": "Marks inside the band belong to runs in which the gripper held the intended force within the "
    "stated tolerance.",
    "compare_growth.svg": "If the recorded and the simulated points lie on each other, the field grows with the force "
    "in the simulation as it does on the board.",
    "quadratures.svg": "Among the points below the line of the limit, the point farthest to the left takes the least "
    "time.",
    "integrators.svg": "The best points are at the lower left: they have small errors and take little time. Failures "
    "are listed below the panels.",
}


def sentences(numbers: Numbers) -> dict[str, str]:
    """Return a sentence for each figure of a scene's report, by file name."""
    maps = {f"error_grid_{name}.svg": MAPS for name in numbers.get("variants", ())}
    found = LOOK | maps
    for key, write in WRITERS.items():
        if numbers.get(key):
            found |= write(numbers)
    return {name: UNIT.sub(NO_BREAK, sentence) for name, sentence in found.items()}


def _table2(numbers: Numbers) -> dict[str, str]:
    ours = {name: row for name, row in numbers["table2"].items() if name in ("single", "multi", "adapted")}
    parts = [
        f"{TITLES[name]} {row['accuracy_pct']['mean']:.0f} % (paper: {TABLE_2[name]['accuracy_pct'][0]:.0f} %)"
        for name, row in ours.items()
    ]
    return {HEADLINE: f"Share of readings within 1 mm: {'; '.join(parts)}."}


def _unseen(numbers: Numbers) -> dict[str, str]:
    rows = sorted((row for row in unseen_rows(numbers) if row["labels_n"] != 1), key=lambda row: row["labels_n"])
    parts = []
    for method, name in IN_CONTEXT.items():
        swept = [row for row in rows if row["method"] == method]
        if swept:
            first, last = (row["accuracy_pct"]["mean"] for row in (swept[0], swept[-1]))
            ends = f"{first:.0f} % with {swept[0]['labels_n']} labels"
            parts.append(f"{name}: {ends}, {last:.0f} % with {swept[-1]['labels_n']}")
    return {HEADLINE: f"Share of readings within 1 mm, mean over the boards: {'; '.join(parts)}."} if parts else {}


def _pokes(numbers: Numbers) -> dict[str, str]:
    rows = sorted(numbers["sweep_pokes"], key=lambda row: row["pokes_n"])
    ends = [f"{row['accuracy_pct']['mean']:.1f} % with {row['pokes_n']} pokes" for row in _spaced(rows)]
    bars = "The bars are intervals of single scores over boards, not of the difference between two scores"
    if difference := _gain_from_pokes(numbers):
        bars += f": this difference is {difference}"
    return {"sweep_pokes.svg": f"Mean accuracy: {', '.join(ends)}. {bars}."}


def _gain_from_pokes(numbers: Numbers) -> str:
    """Write the paired difference in accuracy from adaptation to the default number of pokes."""
    pokes_n = numbers.get("adapt", {}).get("pokes_n")
    for pair in numbers.get("paired", ()):
        if (pair["of"], pair["over"]) == ("adapted", "triplet") and "ci95" in pair["accuracy_pct"] and pokes_n:
            stat = pair["accuracy_pct"]
            low, high = stat["ci95"]
            return f"{stat['mean']:+.1f} points [{low:.2f}, {high:.2f}] from 0 to {pokes_n} pokes"
    return ""


def _spaced(rows: Sequence[Numbers]) -> list[Numbers]:
    """Return the first, the second and the last row."""
    return [rows[i] for i in dict.fromkeys((0, min(1, len(rows) - 1), len(rows) - 1))]


def _sensors(numbers: Numbers) -> dict[str, str]:
    means = {(row["method"], row["skins_n"]): row["accuracy_pct"]["mean"] for row in numbers["sweep_sensors"]}
    counts = sorted({n for method, n in means if method == "adapted" and ("triplet", n) in means})
    gains = [
        f"{means['adapted', n] - means['triplet', n]:+.1f} points with {n} training skin{'s' if n > 1 else ''}"
        for n in dict.fromkeys((*counts[:1], *counts[-1:]))
    ]
    return {"sweep_sensors.svg": f"Adaptation changes the mean accuracy by {', '.join(gains)}."} if gains else {}


def _shear(numbers: Numbers) -> dict[str, str]:
    names = ("explained_fxy", "explained_fz")
    by_line = numbers["shear"].get("by_line", {})  # the figure shows networks that were tested on whole lines
    if not all(name in by_line for name in names):
        return {"shear.svg": "Points on the diagonal are exact."}
    shares = [100 * by_line[name]["mean"] for name in names]
    share = "{:.2f} % of the variance of the sideways forces and {:.2f} % of the variance of the normal forces".format(
        *shares
    )
    return {"shear.svg": f"Points on the diagonal are exact. The networks explain {share}."}


def _flexible(numbers: Numbers) -> dict[str, str]:
    bias_N = [numbers["flexible"]["bias_f_N"][name]["mean"] for name in ("before", "after")]
    ends = "{:+.1f} N before adaptation and {:+.1f} N after it".format(*bias_N)
    return {"flexible.svg": f"Points above the line are forces that are estimated too high: the mean error is {ends}."}


def _sleeve(numbers: Numbers) -> dict[str, str]:
    parts = {"near_seam": "near a border between boards", "inside": "elsewhere"}
    found = [
        f"{numbers['sleeve'][name]['median_error_mm']['mean']:.2f} mm {where}"
        for name, where in parts.items()
        if name in numbers["sleeve"]
    ]
    return {"sleeve.svg": f"Median error: {' and '.join(found)}."}


WRITERS: dict[str, Callable[[Numbers], dict[str, str]]] = {
    "table2": _table2, "new_board": _unseen, "sweep_pokes": _pokes, "sweep_sensors": _sensors,
    "shear": _shear, "flexible": _flexible, "sleeve": _sleeve,
}  # fmt: skip

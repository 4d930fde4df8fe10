"""Touches at numbered places: numbers -> tables. Sees no reading and no path."""

from collections.abc import Mapping
from typing import Any

import pandas as pd

from pipeline.report.formatting import show_digits

BY_TIME = "later in the same recordings"
ONCE = (
    "Each place was recorded once, so what is tested later in the same recordings may be told by the recording as well "
    "as by the place: only a recording of other days, or a place left out, is free of that."
)
APART = "Single touches and two at once are in different recordings; data/README.md says of which days."
NO_MM = "The pitch of the 3 x 3 places is stated nowhere, so nothing is given in mm."


def tables(numbers: Mapping[str, Any], source: str) -> dict[str, pd.DataFrame]:
    """Tabulate what one touch tells, how two add up, and whether two are told from one."""
    if "not_computed" in numbers:
        return {"touches": _not_computed(numbers, source)}
    found = {"touches": _single(numbers), "touches_detection": _detection(numbers["detection"])}
    if numbers["superposition"]["pairs"]:
        found["touches_superposition"] = _superposition(numbers["superposition"])
    for table in found.values():
        table["source"] = source
    return found


def figures(numbers: Mapping[str, Any], drawn: Mapping[str, Any], source: str) -> dict[str, str]:
    """Nothing: tables say it all."""
    return {}


def _single(numbers: Mapping[str, Any]) -> pd.DataFrame:
    place, force = numbers["place"], numbers["force"]
    rows = [_row(f"place of one touch, {BY_TIME}", place["by_time"], "%", f"{place['by_time']['chance_pct']:.1f}")]
    if "one_of_two" in place:
        two = place["one_of_two"]
        chance = f"{two['chance_pct']:.1f}"
        rows.append(_row("two touches, in their own recordings: answer is one of the two", two, "%", chance))
    variance = f"{force['variance']['mean']:.3g} (variance)"
    for way, words in (("by_time", BY_TIME), ("place_left_out", "at a place left out of training")):
        rows.append(_row(f"force of one touch, squared error, {words}", force[way], "N²", variance))
    table = pd.DataFrame(rows)
    single, double = numbers["single"], numbers["double"]
    table.attrs["meaning"] = (
        f"{single['rows_n']} rows of {single['recordings_n']} recordings of one touch, {double['rows_n']} rows of "
        f"{double['recordings_n']} of two, with {numbers['force_min_N']:g} N or more. Place: the nearest directions of "
        f"the change of field; force: ridge regression on it. Means and ± sd over n recordings. {ONCE} {APART} {NO_MM}"
        f"{_left_out(numbers)}"
    )
    return table


def _not_computed(numbers: Mapping[str, Any], source: str) -> pd.DataFrame:
    rows = [{"recordings": "all", "not used because": numbers["not_computed"]}]
    rows += [{"recordings": name, "not used because": reason} for name, reason in numbers["left_out"].items()]
    table = pd.DataFrame(rows).assign(source=source)
    table.attrs["meaning"] = (
        f"Nothing was computed from {numbers['single']['recordings_n']} usable recordings of one touch and "
        f"{numbers['double']['recordings_n']} of two."
    )
    return table


def _left_out(numbers: Mapping[str, Any]) -> str:
    return "".join(f" Left out: {name} ({reason})." for name, reason in numbers.get("left_out", {}).items())


def _row(what: str, stat: Mapping[str, Any], unit: str, chance: str) -> dict[str, Any]:
    spread = f" ± {stat['sd']:.3g}" if "sd" in stat else ""
    return {"what": what, "result": f"{stat['mean']:.3g}{spread} {unit}", "by chance": chance, "n": stat["n"]}


def _superposition(numbers: Mapping[str, Any]) -> pd.DataFrame:
    rows = [
        {
            "places": " and ".join(map(str, pair["places"])),
            "sum of both, %": f"{pair['left_over_pct']:.0f}",
            "the stronger alone, %": f"{pair['stronger_alone_pct']:.0f}",
            "the best of all places alone, %": f"{pair['best_alone_pct']:.0f} (place {pair['best_alone']})",
            "other pairs, mean, %": f"{pair['other_pairs_pct']:.0f}",
            "rank among pairs": f"{pair['rank']} of {pair['pairs_n']}",
            "rows": f"{pair['rows_n']}",
        }
        for pair in numbers["pairs"]
    ]
    means = {
        "sum of both, %": "mean_left_over_pct", "the stronger alone, %": "mean_stronger_alone_pct",
        "other pairs, mean, %": "mean_other_pairs_pct",
    }  # fmt: skip
    rows.append({"places": "mean"} | {title: show_digits(numbers[name], 0) for title, name in means.items()})
    table = pd.DataFrame(rows).fillna("–")
    table.attrs["meaning"] = (
        "What is left of a recorded change of field of two touches, as a share of it (median over rows), when it is "
        "fitted by the mean directions of single touches at these places, each times an amplitude of 0 or more: how "
        "hard each was pressed is not recorded. A direction that changes with force counts as left over: of single "
        f"touches themselves it is {show_digits(numbers['single_touches_pct'], 0)} %. Two amplitudes fit better than "
        f"one of themselves; the other pairs have two as well. {APART}"
    )
    return table


def _detection(numbers: Mapping[str, Any]) -> pd.DataFrame:
    columns = {
        "two touches called two, %": "detected_pct",
        "single touches called two, %": "false_alarm_pct",
        "a single touch at an unknown place called two, %": "unseen_place_called_two_pct",
        "sums of two single touches called two, %": "sums_called_two_pct",
    }
    rows = [
        {"detector": name}
        | {title: f"{numbers[key][name]:.0f}" for title, key in columns.items() if key in numbers}
        | ({"area under the ROC curve": f"{numbers['auc'][name]:.3f}"} if "auc" in numbers else {})
        for name in numbers["false_alarm_pct"]
    ]
    table = pd.DataFrame(rows)
    table.attrs["meaning"] = (
        f"Thresholds ask for {numbers['false_alarm_asked_pct']:g} % false alarms, as in question contacts, and are set "
        "on single touches between those that are known and those that are tested. A detector that calls a single "
        "touch at a place it does not know two has found what is new, not what is two: then the first column is no "
        f"evidence for more. {APART}"
    )
    return table

"""Rivals, told: numbers -> four tables. Sees no reading, no model and no path."""

from collections.abc import Mapping
from typing import Any

import pandas as pd

from pipeline.report.formatting import COLUMNS, OF_FORCE, n_of, scores, show, show_difference, tabulate

Row = Mapping[str, Any]
NONE = "–"
# What each can do and what it cannot, by its mechanism; whether it helps is in the columns beside it.
WHY = {
    "channels matched": "undoes a gain of each channel; a seat or a turn mixes channels, and where forces differ so do "
    "deviations",
    "CORAL": "also undoes what mixes channels, as far as the pokes tell all their covariances; many maps have the same "
    "covariances, and it knows not which keeps places",
    "direct standardisation": "knows which places belong together, but has as many unknowns as channels squared, and a "
    "linear map is not how a seat changes a field",
    "labels as rows": "says where this skin's fields lie, at the labelled places alone",
    "network, domain-adversarial": "makes features of both boards alike as a whole; nothing says that like features "
    "have like places",
}
TOLD = ("universal", "physics inversion")  # methods that are told unlabelled pokes
GAIN = "accuracy, points"
BASELINES = (
    "Regressors and networks of the known boards on the held-out one; aligned by all its unlabelled pokes, or by so "
    "many labelled ones, each paired with what known boards read at its place and force. Paired: difference to the row "
    "without it (the same regressor, no label; the network, trained as long), board by board. Ridge of direct "
    "standardisation: by leaving out these pairs one by one, as one training board has no second to be validated on. "
    "Nothing else was searched."
)
OF_TOLD = (
    "No label of the held-out board. Paired: difference to the same method told the skin's own pokes, board by board. "
    "Physics inversion: a law's eight numbers, and place and force of each poke, by least squares from nominal "
    "numbers, whose stiffness and slide are the middle of recorded boards, these included; then each reading is "
    "searched in that law. Centred: places shifted so that the pokes' mean is the middle, as maps and networks assume "
    "too. Its stiffness is nominal, so its forces are in nominal units. Another skin's: the pokes of "
    "the next board, beside the held-out board's own field at rest."
)
OF_ALARM = (
    "Left over: |dB - simulated| / |dB| of the best place in the law, the median over readings. The alarm is raised "
    "above the limit that {asked:g} % of readings of boards not held out exceed; limit {limit}. Area under the ROC "
    "curve: 0.5 tells nothing, 1 all. Strangers are recorded readings of the same board with changed chips; the law is "
    "that of the right skin, or fitted anew to the stranger's own pokes and field at rest. n boards; "
    "[low, high]: 95 % interval over them (Student's t, which knows no bounds)."
)
OF_FLAGGED = (
    "Each told the right skin's own unlabelled pokes and no label. Flagged: above the limit that {asked:g} % of "
    "readings of boards not held out exceed. n boards; an error is of those that flag any reading. A misfit says that "
    "dB is none of such a skin, a standard deviation that several places would read alike: only the latter is about "
    "the place."
)
PLACES = ("accuracy_pct", "mse_xy_mm2")


def tables(numbers: Row, source: str) -> dict[str, pd.DataFrame]:
    """Tabulate baselines, what unlabelled pokes are worth, the alarm, and errors of what is flagged."""
    rows = numbers["methods"]
    told = [row for row in rows if row["method"].startswith(TOLD)]
    others = [row for row in rows if row not in told]
    alarm = numbers["alarm"]
    right = {"stranger": "none: the right skin", "law": "the right skin's"} | alarm["right"]
    unpaired = f" {numbers['unpaired_n']} labelled pokes had no pair." if numbers["unpaired_n"] else ""
    return {
        "rivals": tabulate(
            [_line(row, source) | {"why": _why(row["method"])} for row in others], meaning=BASELINES + unpaired
        ),
        "rivals_told": tabulate([_line(row, source) for row in told], meaning=OF_TOLD),
        "rivals_alarm": tabulate(
            [_alarm(row, source) for row in (right, *alarm["strangers"])],
            meaning=OF_ALARM.format(asked=alarm["asked_pct"], limit=show(alarm["limit"])),
        ),
        "rivals_flagged": tabulate(
            [_flagged(row, source) for row in numbers["flagged"]],
            meaning=OF_FLAGGED.format(asked=alarm["asked_pct"]),
        ),
    }


def _flagged(row: Row, source: str) -> dict[str, str]:
    of = {"flagged": "flagged", "others": "all others"}
    titles = {f"{metric}_{name}": f"{COLUMNS[metric]} ({words})" for metric in PLACES for name, words in of.items()}
    line = {"method": row["method"], "flagged by": row["by"], "flagged, %": show(row["flagged_pct"])}
    line |= {title: show(row[name]) if name in row else NONE for name, title in titles.items()}
    return line | {"n": str(row["flagged_pct"]["n"]), "source": source}


def figures(numbers: Row, drawn: Row, source: str) -> dict[str, str]:
    """Nothing: tables say it all."""
    return {}


def _line(row: Row, source: str) -> dict[str, str]:
    places = {metric: f"{title} (registered)" for metric, title in COLUMNS.items() if metric not in OF_FORCE}
    line = {"method": row["method"], "unlabelled pokes": row["pokes"], "labels": str(row["labels_n"]), "source": source}
    line |= scores(row["as_labelled"]) | scores(row["registered"], places)
    over = row.get("over", {})
    paired = {f"paired, {GAIN}": "accuracy_pct", "paired, MSE_xy, mm²": "mse_xy_mm2"}
    return (
        line
        | {title: show_difference(over.get(name)) for title, name in paired.items()}
        | {"n": n_of(row["as_labelled"])}
    )


def _why(method: str) -> str:
    return next((words for name, words in WHY.items() if method.endswith(name)), NONE)


def _alarm(row: Row, source: str) -> dict[str, str]:
    return {
        "stranger": row["stranger"], "law": row["law"], "alarm, % of readings": show(row["alarm_pct"]),
        "area under ROC": show(row["auc"]), "left over": show(row["left_median"]), "n": str(row["auc"]["n"]),
        "source": source,
    }  # fmt: skip

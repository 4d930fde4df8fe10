"""Numbers of the questions about many skins: cards and points of sweeps -> plain words. Refuses to know how they show.

A question that was not asked is absent.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from pipeline.evaluation.comparison import over_boards, paired, paired_where_tested
from pipeline.evaluation.metrics import METRICS
from pipeline.evaluation.summary import pool_skins
from pipeline.reporting.contrasts import contrasts_of_pokes, contrasts_of_sensors

Cards = Sequence[dict[str, Any]]
Seconds = Sequence[Mapping[str, Any]]
PAIRS = (
    ("multi", "single"),
    ("triplet", "multi"),
    ("adapted", "triplet"),
    ("adapted", "control"),
    ("control", "triplet"),
    ("adapted", "multi"),
)
NETWORKS = {"lobo": "network", "triplet": "network + triplet", "adapt": "network, adapted"}  # by question
TRAINED_IN = {"lobo": "train_multi", "triplet": "train_triplet", "adapt": "adapt"}
CONTROL = "control"  # the recipe of adaptation that fine-tunes as long, without the new skin's pokes


def learned(cards: Cards, points: Mapping[str, Cards], *, headline: str) -> dict[str, Any]:
    """Compose what the pooled, triplet and adapted networks say together; `points` are those of the sweeps."""
    rows = _rows(cards, headline)
    table2 = {name: over_boards(own) for name, own in rows.items() if name in ("triplet", "adapted")}
    numbers: dict[str, Any] = {"table2": table2} if table2 else {}
    if CONTROL in rows:
        numbers["adapt"] = {"pokes_n": _pokes_n(cards, headline), "control": over_boards(rows[CONTROL])}
    pairs = [(of, over) for of, over in PAIRS if of in rows and over in rows]
    if pairs:
        numbers["paired"] = [{"of": of, "over": over, **_compare(rows, of, over)} for of, over in pairs]
    if "pokes" in points:
        numbers["sweep_pokes"] = list(_pokes(points["pokes"]))
        numbers["contrasts"] = contrasts_of_pokes(points["pokes"])
    if "sensors" in points:
        numbers["sweep_sensors"] = list(_sensors(points["sensors"]))
        numbers["contrasts"] = numbers.get("contrasts", {}) | contrasts_of_sensors(points["sensors"])
    if "baselines" in points:
        numbers["baselines"] = [*_networks(cards), *_classical(points["baselines"])]
    if "labels" in points:
        numbers["labels"] = list(_labels(points["labels"]))
    return numbers


def curves_of(points: Mapping[str, Cards]) -> dict[str, list[tuple[str, int, dict[str, float]]]]:
    """Give the points of sweeps as curves: by question, the method, the step on its axis, the mean of each score."""
    numbers = learned([], points, headline="")
    axes = {
        "pokes": ("sweep_pokes", "pokes_n"),
        "sensors": ("sweep_sensors", "skins_n"),
        "labels": ("labels", "labels_n"),
    }
    curves = {}
    for question, (key, axis) in axes.items():
        if key in numbers:
            curves[question] = [(_curve_name(row), row[axis], _score_means(row)) for row in numbers[key]]
    return curves


def timed_learning(numbers: Mapping[str, Any], seconds: Mapping[str, Seconds]) -> dict[str, Any]:
    """Put what was timed here, by stage and name of a training, beside the errors; what was not has no time."""
    joined: dict[str, Any] = {}
    if "baselines" in numbers:
        joined["learning"] = [row | _times(row, seconds) for row in numbers["baselines"]]
    if "sweep_pokes" in numbers:
        took = seconds.get("sweep_pokes", [])
        joined["adaptation"] = []
        for row in numbers["sweep_pokes"]:
            own = [one["train_s"] for one in took if f".{row['pokes_n']}pokes." in one["name"]]
            joined["adaptation"].append(row | ({"seconds": float(np.median(own))} if own else {}))
    return joined


def by_fold(cards: Cards) -> Cards:
    """Give cards by fold: those of networks adapted to one skin each are put together."""
    return pool_skins(cards) if cards and cards[0]["question"] == "adapt" else cards


def _curve_name(row: Mapping[str, Any]) -> str:
    words = (row.get("method", "adapted"), row.get("inputs", ""))
    return "_".join(word for word in words if word).replace(", ", "_").replace(" ", "_").replace("+", "and")


def _score_means(row: Mapping[str, Any]) -> dict[str, float]:
    return {name: row.get("as_labelled", row)[name]["mean"] for name in METRICS if name in row.get("as_labelled", row)}


def _rows(cards: Cards, headline: str) -> dict[str, Cards]:
    wanted = {
        "single": ("transfer", headline), "multi": ("lobo", headline), "triplet": ("triplet", headline),
        "adapted": ("adapt", headline), CONTROL: ("adapt", CONTROL),
    }  # fmt: skip
    rows = {
        name: by_fold([card for card in cards if (card["question"], card["recipe_name"]) == key])
        for name, key in wanted.items()
    }
    return {name: own for name, own in rows.items() if own}


def _compare(rows: Mapping[str, Cards], of: str, over: str) -> dict[str, Any]:
    """Compare on the same test rows: one skin on others was tested on some boards only."""
    return (paired_where_tested if over == "single" else paired)(rows[of], rows[over])


def _pokes_n(cards: Cards, headline: str) -> int:
    return next(c["tuning"]["pokes_n"] for c in cards if (c["question"], c["recipe_name"]) == ("adapt", headline))


def _networks(cards: Cards) -> Iterable[dict[str, Any]]:
    for question, method in NETWORKS.items():
        own = [card for card in cards if card["question"] == question and card["recipe"]["architecture"] == "paper"]
        for name in dict.fromkeys(card["recipe_name"] for card in own if card["recipe_name"] != CONTROL):
            named = [card for card in own if card["recipe_name"] == name]
            words = {"method": method, "inputs": named[0]["recipe"]["inputs"], "name": name}
            words |= {"base": named[0]["tuning"]["settings"]["base"]} if "tuning" in named[0] else {}
            yield {**words, "rows_n": named[0]["train_rows_n"], **over_boards(by_fold(named))}


def _classical(points: Cards) -> Iterable[dict[str, Any]]:
    for name in dict.fromkeys(point["name"] for point in points):
        own = [point for point in points if point["name"] == name]
        words = {"method": own[0]["method"], "inputs": own[0]["inputs"], "name": name, "rows_n": own[0]["rows_n"]}
        yield {**words, **over_boards(own)}


def _labels(points: Cards) -> Iterable[dict[str, Any]]:
    for method, inputs in dict.fromkeys((point["method"], point["inputs"]) for point in points):
        for labels_n in sorted({point["labels_n"] for point in points}):
            key = (method, inputs, labels_n)
            own = [point for point in points if (point["method"], point["inputs"], point["labels_n"]) == key]
            parts = {"as_labelled": over_boards(own), "registered": over_boards(own, "registered")}
            yield {"method": method, "inputs": inputs, "labels_n": labels_n, **parts}


def _times(row: Mapping[str, Any], seconds: Mapping[str, Seconds]) -> dict[str, float]:
    """Give the median seconds of a method's trainings; an adapted network was also trained before."""
    question = next((q for q, method in NETWORKS.items() if method == row["method"]), None)
    if question is None:
        return _median_times(seconds.get("train_classical", []), f"{row['name']}.")
    own = _median_times(seconds.get(TRAINED_IN[question], []), f"{question}.{row['name']}.")
    if question != "adapt" or not own:
        return own
    base = _median_times(seconds.get("train_triplet", []), f"triplet.{row['base']}.")
    return own | {"train_s": own["train_s"] + base["train_s"]} if base else {}


def _median_times(took: Seconds, start: str) -> dict[str, float]:
    own = [one for one in took if one["name"].startswith(start)]
    if not own:
        return {}
    return {
        "train_s": float(np.median([one["train_s"] for one in own])),
        "inference_us": 1e6 * float(np.median([one["one_reading_s"] for one in own])),
    }


def _pokes(points: Cards) -> Iterable[dict[str, Any]]:
    for pokes_n in sorted({point["pokes_n"] for point in points}):
        own = [point for point in points if point["pokes_n"] == pokes_n]
        yield {"pokes_n": pokes_n, **over_boards(pool_skins(own) if pokes_n else own)}


def _sensors(points: Cards) -> Iterable[dict[str, Any]]:
    for method in ("multi", "triplet", "adapted"):
        for skins_n in sorted({point["trained_on_skins_n"] for point in points}):
            own = [point for point in points if (point["method"], point["trained_on_skins_n"]) == (method, skins_n)]
            yield {"method": method, "skins_n": skins_n, **over_boards(pool_skins(own))}

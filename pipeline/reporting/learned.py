"""Numbers of the questions about many skins: cards and points of sweeps -> plain words. Refuses to know how they show.

A question that was not asked is absent.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from pipeline.evaluation.summary import over_folds, paired, pool_skins

Cards = Sequence[dict[str, Any]]
PAIRS = (
    ("triplet", "multi"),
    ("adapted", "triplet"),
    ("adapted", "control"),
    ("control", "triplet"),
    ("adapted", "multi"),
)
CONTROL = "control"  # the recipe of adaptation that fine-tunes as long, without the new skin's pokes


def learned(cards: Cards, points: Mapping[str, Cards], *, headline: str) -> dict[str, Any]:
    """Compose what the pooled, triplet and adapted networks say together; `points` are those of the sweeps."""
    rows = _rows(cards, headline)
    table2 = {name: over_folds(own) for name, own in rows.items() if name in ("triplet", "adapted")}
    numbers: dict[str, Any] = {"table2": table2} if table2 else {}
    if CONTROL in rows:
        numbers["adapt"] = {"pokes_n": _pokes_n(cards, headline), "control": over_folds(rows[CONTROL])}
    pairs = [(of, over) for of, over in PAIRS if of in rows and over in rows]
    if pairs:
        numbers["paired"] = [{"of": of, "over": over, **paired(rows[of], rows[over])} for of, over in pairs]
    if "pokes" in points:
        numbers["sweep_pokes"] = list(_pokes(points["pokes"]))
    if "sensors" in points:
        numbers["sweep_sensors"] = list(_sensors(points["sensors"]))
    return numbers


def by_fold(cards: Cards) -> Cards:
    """Give cards by fold: those of networks adapted to one skin each are put together."""
    return pool_skins(cards) if cards and cards[0]["question"] == "adapt" else cards


def _rows(cards: Cards, headline: str) -> dict[str, Cards]:
    wanted = {
        "multi": ("lobo", headline), "triplet": ("triplet", headline), "adapted": ("adapt", headline),
        CONTROL: ("adapt", CONTROL),
    }  # fmt: skip
    rows = {
        name: by_fold([card for card in cards if (card["question"], card["recipe_name"]) == key])
        for name, key in wanted.items()
    }
    return {name: own for name, own in rows.items() if own}


def _pokes_n(cards: Cards, headline: str) -> int:
    return next(c["tuning"]["pokes_n"] for c in cards if (c["question"], c["recipe_name"]) == ("adapt", headline))


def _pokes(points: Cards) -> Iterable[dict[str, Any]]:
    for pokes_n in sorted({point["pokes_n"] for point in points}):
        own = [point for point in points if point["pokes_n"] == pokes_n]
        yield {"pokes_n": pokes_n, **over_folds(pool_skins(own) if pokes_n else own)}


def _sensors(points: Cards) -> Iterable[dict[str, Any]]:
    for method in ("multi", "triplet", "adapted"):
        for skins_n in sorted({point["trained_on_skins_n"] for point in points}):
            own = [point for point in points if (point["method"], point["trained_on_skins_n"]) == (method, skins_n)]
            yield {"method": method, "skins_n": skins_n, **over_folds(pool_skins(own))}

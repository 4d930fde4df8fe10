"""What the paper says of its figures 6a and 6b, as paired differences a board. In: points of sweeps. Out: numbers.

A contrast that a sweep does not reach is absent. Refuses to know how it is judged and shown.
"""

from collections.abc import Mapping, Sequence
from typing import Any

from pipeline.evaluation.comparison import paired
from pipeline.evaluation.inference import summarise_boards
from pipeline.reporting.paper import PLATEAU_POKES_N

METHODS = ("multi", "triplet", "adapted")
Cards = Sequence[dict[str, Any]]
Contrast = dict[str, Any]  # what is compared, each metric's difference over boards, and by board


def contrasts_of_pokes(points: Cards) -> dict[str, Contrast]:
    """Compare none with the fewest pokes, with those where the paper sees its plateau, and these with the most."""
    at = {pokes_n: [one for one in points if one["pokes_n"] == pokes_n] for pokes_n in _counts(points, "pokes_n")}
    if 0 not in at or len(at) < 2:
        return {}
    known = sorted(at)
    plateau_n = max((pokes_n for pokes_n in known if 0 < pokes_n <= PLATEAU_POKES_N), default=known[1])
    steps = {"pokes_first": (0, known[1]), "pokes_gain": (0, plateau_n), "pokes_plateau": (plateau_n, known[-1])}
    return {
        name: {"from_pokes_n": few, "to_pokes_n": many, **paired(at[many], at[few])}
        for name, (few, many) in steps.items()
        if few < many and (name != "pokes_plateau" or plateau_n == PLATEAU_POKES_N)
    }


def contrasts_of_sensors(points: Cards) -> dict[str, Any]:
    """Compare most with fewest training skins, adapted networks with others, and their gain with few and many skins."""
    counts = _counts(points, "trained_on_skins_n")

    def own(method: str, skins_n: int) -> Cards:
        return [one for one in points if (one["method"], one["trained_on_skins_n"]) == (method, skins_n)]

    adapted = {
        f"sensors_adapted_over_{other}": [
            {"skins_n": skins_n, **paired(own("adapted", skins_n), own(other, skins_n))} for skins_n in counts
        ]
        for other in ("multi", "triplet")
    }
    if len(counts) < 2:
        return adapted
    few, many = counts[0], counts[-1]
    words = {"from_skins_n": few, "to_skins_n": many}
    more = {f"sensors_more_{name}": words | paired(own(name, many), own(name, few)) for name in METHODS}
    gains = adapted["sensors_adapted_over_triplet"]
    return adapted | more | {"sensors_gain_fewer": words | _less(gains[0]["by_board"], gains[-1]["by_board"])}


def _less(ours: Mapping[str, Mapping[str, float]], theirs: Mapping[str, Mapping[str, float]]) -> Contrast:
    by_board = {board: {name: own[name] - theirs[board][name] for name in own} for board, own in ours.items()}
    return {**summarise_boards(by_board), "by_board": by_board}


def _counts(points: Cards, key: str) -> list[int]:
    return sorted({point[key] for point in points})

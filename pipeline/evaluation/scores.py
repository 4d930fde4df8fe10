"""The scores of learning: one tidy table, and its only statistics. In: cards, points of sweeps. Out: plain numbers.

A row is one training on one skin, or on all skins that it was tested on. The unit of inference is the board: its skins
share it and the network that never saw it. Refuses to know networks, files, and who claims what.
"""

from collections.abc import Hashable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float

from pipeline.core.errors import SchemaError
from pipeline.evaluation.metrics import METRICS

NAMES = ("question", "method", "recipe", "inputs", "architecture", "base", "fold", "board", "skin", "places")
COUNTS = (
    "seed", "labels_n", "pokes_n", "contacts_n", "trained_on_skins_n", "trained_on_rows_n", "rows_n",
)  # fmt: skip
KEYS = (*NAMES, *COUNTS)  # every other column is a metric
SURENESS = ("coverage_pct", "half_width_mm")  # of 90 % intervals, where a method tells how sure it is
ALL_SKINS = ""  # in column `skin`: all rows that a training was tested on
AS_LABELLED, REGISTERED = "as_labelled", "registered"  # places: the latter after one offset a board, a diagnosis
METHODS = {"triplet": "network + triplet", "adapt": "network, adapted"}  # of cards, by question
CONFIDENCE = 0.95  # convention
ABOVE_ROUNDING = 12  # decimals of a difference in %, mm2 or N2: what lies below is of float sums
YES, NO, INCONCLUSIVE = "yes", "no", "inconclusive"
ONE_BOARD = "inconclusive (one board)"
VERDICTS = (
    "Yes: the 95 % interval lies wholly on the claim's side of 0 or of the stated threshold. No: wholly on the other "
    "side. Inconclusive: it includes 0 or the threshold; one board has no interval. The interval is over boards "
    "(Student's t of the boards' means; skins and networks of a board are averaged first)."
)

Cards = Sequence[Mapping[str, Any]]
Values = Sequence[float] | Float[np.ndarray, " n"] | pd.Series
Stat = Mapping[str, Any]  # mean, n; where n > 1 also sd, and where n are boards ci95: [low, high]


def tidy(cards: Cards, points: Mapping[str, Cards] | None = None) -> pd.DataFrame:
    """Tabulate what cards of models and points of curves, by question, say of their scores.

    Networks adapted to one skin each have a row for all skins of their fold too, by fold and seed.
    """
    keyed = [(_keys_of_card(card), card["scores"]) for card in cards]
    keyed += [
        (_keys_of_point(question, point), point["scores"]) for question, own in (points or {}).items() for point in own
    ]
    rows = [dict.fromkeys(NAMES, "") | row for keys, scores in keyed for row in _rows(keys, scores)]
    alike: dict[Hashable, list[dict[str, Any]]] = {}  # for all skins: one training, or one for each skin
    for row in (row for row in rows if row["skin"] == ALL_SKINS):
        alike.setdefault(tuple(row.get(key) for key in KEYS if key != "rows_n"), []).append(row)
    kept = [*map(_pool, alike.values()), *(row for row in rows if row["skin"] != ALL_SKINS)]
    return pd.DataFrame(kept, columns=[*KEYS, *METRICS, *SURENESS]).astype(
        dict.fromkeys((*COUNTS, *METRICS, *SURENESS), float)
    )


def to_csv(table: pd.DataFrame) -> str:
    """Write the table with six significant digits, as numbers.json has."""
    return table.convert_dtypes().to_csv(index=False, float_format="%.6g")


def select(rows: pd.DataFrame, **words: str | float) -> pd.DataFrame:
    """Keep the rows whose columns say these words."""
    for column, word in words.items():
        rows = rows[rows[column] == word]
    return rows


def whole(rows: pd.DataFrame, places: str = AS_LABELLED) -> pd.DataFrame:
    """Keep a row a training: all skins that it was tested on."""
    return select(rows, skin=ALL_SKINS, places=places)


def by_skin(rows: pd.DataFrame) -> pd.DataFrame:
    """Keep a row a training and skin."""
    return rows[rows["skin"] != ALL_SKINS]


def interval(values: Values) -> list[float] | None:
    """Give the two-sided 95 % interval of a mean by Student's t with n - 1 degrees of freedom; None below two values.

    >>> interval([1.0]) is None
    True
    >>> [round(float(end), 2) for end in interval([1.0, 3.0])]  # t is 12.71 with one degree of freedom
    [-10.71, 14.71]
    """
    n = len(values)
    if n < 2:
        return None
    from scipy.special import stdtrit  # late: only where there are intervals

    mean = float(np.mean(values))
    reach = float(stdtrit(n - 1, (1 + CONFIDENCE) / 2) * np.std(values, ddof=1) / np.sqrt(n))
    return [mean - reach, mean + reach]


def statistic(values: Values, *, boards: bool = False) -> dict[str, Any]:
    """Give mean and number, and of two values or more sd (n - 1) and, if they are `boards`, the interval `ci95`."""
    stat = {"mean": float(np.mean(values)), "n": len(values)}
    if len(values) < 2:
        return stat
    return stat | {"sd": float(np.std(values, ddof=1))} | ({"ci95": interval(values)} if boards else {})


def summarise(units: pd.DataFrame, *, boards: bool = False) -> dict[str, dict[str, Any]]:
    """Summarise each column over the rows that have it."""
    known = {str(name): units[name].dropna().to_numpy() for name in units}
    return {name: statistic(values, boards=boards) for name, values in known.items() if len(values)}


def over_units(rows: pd.DataFrame, *unit: str, boards: bool = False) -> dict[str, dict[str, Any]]:
    """Summarise every metric over units, each the mean of its rows; `sd_seeds` is the mean sd within a unit.

    Over several boards there is no `sd_seeds`.
    """
    groups = rows.groupby(list(unit))[_metrics(rows)]
    summary = summarise(groups.mean(), boards=boards)
    return with_seeds(summary, rows, *unit) if not boards or groups.ngroups == 1 else summary


def with_seeds(summary: Mapping[str, Stat], rows: pd.DataFrame, *unit: str) -> dict[str, dict[str, Any]]:
    """Add `sd_seeds` to each statistic: the standard deviation (n - 1) of the rows of a unit, mean over units.

    The rows of a unit are networks that differ in their seed. A metric whose units have one row each is left as it is.
    """
    sds = rows.groupby(list(unit))[_metrics(rows)].std().mean().dropna()
    return {
        name: {**stat, "sd_seeds": float(sds[name])} if name in sds else dict(stat) for name, stat in summary.items()
    }


def over_folds(rows: pd.DataFrame) -> dict[str, dict[str, Any]]:
    """Summarise trainings over folds, each the mean of its seeds."""
    return over_units(whole(rows), "fold")


def over_boards(rows: pd.DataFrame, places: str = AS_LABELLED) -> dict[str, dict[str, Any]]:
    """Summarise trainings over held-out boards, each the mean of its trainings (seeds, draws of skins)."""
    return over_units(whole(rows, places), "board", boards=True)


def over_pairs(rows: pd.DataFrame) -> dict[str, dict[str, Any]]:
    """Summarise pairs of a training and a test skin, as the paper does (3 x 9 pairs), `ci95` over test boards.

    The same few networks answer on every board, so the interval says nothing of other training skins.
    """
    pairs = over_units(by_skin(rows), "fold", "skin")
    boards = summarise(board_means(by_skin(rows)), boards=True)
    return {name: stat | {key: boards[name][key] for key in ("ci95",) if key in boards[name]}
            for name, stat in pairs.items()}  # fmt: skip


def board_means(rows: pd.DataFrame) -> pd.DataFrame:
    """Average networks on each skin, then the skins of each board: a row a board."""
    return _skin_means(rows).groupby("board").mean()


def differences(of: pd.DataFrame, over: pd.DataFrame, *, where_tested: bool = False) -> pd.DataFrame:
    """Subtract skin by skin, each side the mean of its networks there; a row a board, the mean of its skins.

    Both sides have the same skins, or are compared where the second was tested: one skin on others is on some boards.
    """
    ours, theirs = _skin_means(of), _skin_means(over)
    if where_tested:
        ours = ours[ours.index.isin(theirs.index)]
    if not ours.index.equals(theirs.index):
        unpaired = sorted(ours.index.symmetric_difference(theirs.index))
        remedy = "Train both on the same folds."
        raise SchemaError("a paired difference", "held-out skins", "the same on both sides", unpaired, remedy)
    return (ours - theirs).groupby("board").mean()


def with_boards(by_board: pd.DataFrame) -> dict[str, Any]:
    """Summarise over boards, and give `by_board` each board's value; what is left of equal sides is 0."""
    summary = summarise(by_board, boards=True)
    means = {name: stat | {"mean": round(stat["mean"], ABOVE_ROUNDING)} for name, stat in summary.items()}
    return {**means, "by_board": records(by_board)}


def paired(of: pd.DataFrame, over: pd.DataFrame, *, where_tested: bool = False) -> dict[str, Any]:
    """Compare two sides of equal skins: every metric's difference over boards, and `by_board`."""
    return with_boards(differences(of, over, where_tested=where_tested))


def records(rows: pd.DataFrame) -> dict[str, dict[str, float]]:
    """Give known numbers by index and column."""
    known = {str(index): row.dropna() for index, row in rows.iterrows()}
    return {index: {str(name): float(value) for name, value in row.items()} for index, row in known.items()}


def verdict(stat: Stat, *, above: float = 0.0) -> str:
    """Judge whether a mean over boards is above a threshold, by its interval."""
    if "ci95" not in stat:
        return ONE_BOARD
    low, high = stat["ci95"]
    return YES if low > above else NO if high < above else INCONCLUSIVE


def verdict_within(stat: Stat, reach: float) -> str:
    """Judge whether a mean over boards is nearer to 0 than `reach`, by its interval (equivalence)."""
    if "ci95" not in stat:
        return ONE_BOARD
    low, high = stat["ci95"]
    if -reach < low and high < reach:
        return YES
    return NO if low > reach or high < -reach else INCONCLUSIVE


def negated(stat: Stat) -> dict[str, Any]:
    """Turn a difference round: of an error, less is a gain."""
    turned = {**stat, "mean": -stat["mean"]}
    return turned | ({"ci95": [-end for end in reversed(stat["ci95"])]} if "ci95" in stat else {})


def all_of(verdicts: Sequence[str]) -> str:
    """Judge a claim of several parts: one no is enough to deny it, and only yes throughout affirms it."""
    return next((word for word in (NO, ONE_BOARD, INCONCLUSIVE) if word in verdicts), YES)


def tally(trainings: Iterable[Mapping[str, Any]]) -> dict[str, int]:
    """Count trainings: all, those that collapsed, and those of them that were kept as no other draw went better.

    >>> tally([{"collapsed": False, "collapsed_before_n": 1}, {"collapsed": True, "collapsed_before_n": 2}])
    {'trainings_n': 5, 'collapsed_n': 4, 'kept_collapsed_n': 1}
    """
    counted = [(training["collapsed"], training["collapsed_before_n"]) for training in trainings]
    kept_n, before_n = sum(collapsed for collapsed, _ in counted), sum(before_n for _, before_n in counted)
    return {"trainings_n": len(counted) + before_n, "collapsed_n": before_n + kept_n, "kept_collapsed_n": kept_n}


def _metrics(rows: pd.DataFrame) -> list[str]:
    return [str(name) for name in rows if name not in KEYS]


def _skin_means(rows: pd.DataFrame) -> pd.DataFrame:
    return rows.groupby(["board", "skin"])[_metrics(rows)].mean()


def _keys_of_card(card: Mapping[str, Any]) -> dict[str, Any]:
    keys = {key: card[key] for key in ("question", "fold")} | {"recipe": card["recipe_name"], "seed": card["seed_i"]}
    keys |= {key: card["recipe"][key] for key in ("inputs", "architecture")}
    keys |= {"method": METHODS.get(card["question"], "network"), "trained_on_skins_n": len(card["train_skins"])}
    keys |= {"trained_on_rows_n": card["train_rows_n"]}
    tuning = card.get("tuning")
    return keys | ({"base": tuning["settings"]["base"], "pokes_n": tuning["pokes_n"]} if tuning else {})


def _keys_of_point(question: str, point: Mapping[str, Any]) -> dict[str, Any]:
    named = {"name": "recipe", "seed_i": "seed", "rows_n": "trained_on_rows_n"}
    keys = {named.get(key, key): value for key, value in point.items()}
    return {key: value for key, value in keys.items() if key in KEYS} | {"question": question}


def _rows(keys: Mapping[str, Any], scores: Mapping[str, Any]) -> list[dict[str, Any]]:
    boards = {*scores["board_of"].values()}
    every = {**keys, "skin": ALL_SKINS, "board": boards.pop() if len(boards) == 1 else "", "rows_n": scores["rows_n"]}
    rows = [every | {"places": AS_LABELLED} | scores["all"], every | {"places": REGISTERED} | scores["registered"]]
    for skin, own in scores["by_skin"].items():
        rows.append({**keys, "skin": skin, "board": scores["board_of"][skin], "places": AS_LABELLED, **own})
    return rows


def _pool(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Put the scores of one fold and seed together that were tested on a skin each, by their numbers of rows."""
    rows_n = [row["rows_n"] for row in rows]
    scores = {
        name: float(np.average([row[name] for row in rows], weights=rows_n)) for name in METRICS if name in rows[0]
    }
    return {**rows[0], **scores, "rows_n": sum(rows_n)}

"""The table of scores of all training runs, and the statistics over boards that reports compute from it.

A row of the table contains the scores of one network on one skin, or its joint scores on all skins on which it was
tested. In statistical tests, one board counts as one observation. The skins of a board are not independent
observations, because they share the board and are tested with the same networks, which were trained without this board.
"""

from collections.abc import Hashable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float

from reskin.errors import SchemaError
from reskin.metrics import METRICS, TRUTH

NAMES = ("question", "method", "recipe", "inputs", "architecture", "base", "fold", "board", "skin", "places")
COUNTS = (
    "seed", "labels_n", "pokes_n", "contacts_n", "trained_on_skins_n", "trained_on_rows_n", "rows_n",
)  # fmt: skip
KEYS = (*NAMES, *COUNTS)  # all other columns are metrics
UNCERTAINTY = ("coverage_pct", "half_width_mm")  # metrics of 90 % intervals, for methods that state an uncertainty
ALL_SKINS = ""  # value of column `skin` in joint rows, which are for all skins on which a network was tested
# Values of column `places`. In rows AS_LABELLED, predicted positions are scored without a correction. In rows
# REGISTERED, the mean error of each board, which is estimated from its labels, was first subtracted from the positions.
AS_LABELLED, REGISTERED = "as_labelled", "registered"
METHODS = {
    "triplet": "network + triplet",
    "adapt": "network, adapted",
}  # names of methods by experiment; "network" for all other experiments
CONFIDENCE = 0.95  # confidence level of intervals; the usual convention
PERCENTAGES = ("accuracy_pct", "coverage_pct", "coverage_f_pct")  # metrics between 0 and 100
AT_MOST_1 = ("r2_f", "cosine_mean", "explained_median")  # metrics that are at most 1
DECIMALS = 12  # differences in %, mm2 or N2 are rounded to this many decimals, to remove rounding errors
BOARDS_MIN = 4  # with fewer boards, no interval is computed; the value of each board is given instead
SUPPORTED, CONTRADICTED, UNDECIDED = "supported", "contradicted", "undecided"
FEW_BOARDS = f"not judged (fewer than {BOARDS_MIN} boards)"
VERDICTS = (
    "Supported: the whole 95 % interval is on the claim's side of the threshold, which is 0 unless another threshold "
    "is stated. Contradicted: the whole interval is on the other side. Undecided: the interval includes the threshold. "
    f"Not judged: with fewer than {BOARDS_MIN} boards there is no interval, and the values of the boards are given. "
    "Intervals are over boards (Student's t): the value of a board is the mean over its skins and networks. So that "
    "intervals contain only possible values, they are computed from the logit of accuracies and from the logarithm of "
    "squared errors. Differences are not transformed. The networks for two tested boards are trained partly on the "
    "same boards; the intervals do not account for this."
)

Cards = Sequence[Mapping[str, Any]]
Values = Sequence[float] | Float[np.ndarray, " n"] | pd.Series
# A statistic with keys `mean` and `n`, and with `sd` if n > 1. If the values belong to boards, it also has `ci95`
# ([low, high]), or `values` (one value per board) if there are few boards.
Stat = Mapping[str, Any]


# --- The table of scores ---


def tidy(cards: Cards, points: Mapping[str, Cards] | None = None) -> pd.DataFrame:
    """Tabulate the scores of all training runs.

    Parameters
    ----------
    cards
        Model cards, which are the JSON descriptions of trained networks. If each network is adapted to one skin, the
        networks of the same fold and seed also have a joint row for all their skins.
    points
        Points of the curves of sweeps, by experiment. Each point has the scores of one training run.

    Returns
    -------
    DataFrame
        Columns `KEYS`, then metrics; NaN where a method has no such metric.
    """
    keyed = [(_keys_of_card(card), card["scores"]) for card in cards]
    keyed += [
        (_keys_of_point(experiment, point), point["scores"])
        for experiment, experiment_points in (points or {}).items()
        for point in experiment_points
    ]
    rows = [dict.fromkeys(NAMES, "") | row for keys, scores in keyed for row in _rows(keys, scores)]
    # Joint rows by fold and seed. There are several rows for a fold and seed if each network is adapted to one skin.
    groups: dict[Hashable, list[dict[str, Any]]] = {}
    for row in (row for row in rows if row["skin"] == ALL_SKINS):
        groups.setdefault(tuple(row.get(key) for key in KEYS if key != "rows_n"), []).append(row)
    kept = [*map(_pool, groups.values()), *(row for row in rows if row["skin"] != ALL_SKINS)]
    return pd.DataFrame(kept, columns=[*KEYS, *METRICS, *UNCERTAINTY]).astype(
        dict.fromkeys((*COUNTS, *METRICS, *UNCERTAINTY), float)
    )


def _keys_of_card(card: Mapping[str, Any]) -> dict[str, Any]:
    keys = {key: card[key] for key in ("question", "fold")} | {"recipe": card["recipe_name"], "seed": card["seed_i"]}
    keys |= {key: card["recipe"][key] for key in ("inputs", "architecture")}
    keys |= {"method": METHODS.get(card["question"], "network"), "trained_on_skins_n": len(card["train_skins"])}
    keys |= {"trained_on_rows_n": card["train_rows_n"]}
    tuning = card.get("tuning")
    return keys | ({"base": tuning["settings"]["base"], "pokes_n": tuning["pokes_n"]} if tuning else {})


def _keys_of_point(experiment: str, point: Mapping[str, Any]) -> dict[str, Any]:
    renamed = {"name": "recipe", "seed_i": "seed", "rows_n": "trained_on_rows_n"}
    keys = {renamed.get(key, key): value for key, value in point.items()}
    return {key: value for key, value in keys.items() if key in KEYS} | {"question": experiment}


def _rows(keys: Mapping[str, Any], scores: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the rows of one training run.

    The first two rows are joint rows for all skins, one with positions as labelled, and one with registered positions.
    One row for each skin follows.
    """
    boards = {*scores["board_of"].values()}
    joint = {**keys, "skin": ALL_SKINS, "board": boards.pop() if len(boards) == 1 else "", "rows_n": scores["rows_n"]}
    rows = [joint | {"places": AS_LABELLED} | scores["all"], joint | {"places": REGISTERED} | scores["registered"]]
    for skin, skin_scores in scores["by_skin"].items():
        rows.append({**keys, "skin": skin, "board": scores["board_of"][skin], "places": AS_LABELLED, **skin_scores})
    return rows


def _pool(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Average the scores of the networks of one fold and seed, weighted by the number of test rows of each network."""
    rows_n = np.array([row["rows_n"] for row in rows])
    known = [name for name in (*METRICS, *TRUTH) if all(name in row for row in rows)]
    parts = {name: np.array([row[name] for row in rows]) for name in known}
    scores = {name: float(np.average(values, weights=rows_n)) for name, values in parts.items()}
    if "r2_f" in parts:
        between_N2 = (parts["force_mean_N"] - scores["force_mean_N"]) ** 2
        scores["force_var_N2"] += float(np.average(between_N2, weights=rows_n))
        scores["r2_f"] = 1 - scores["mse_f_N2"] / scores["force_var_N2"]
    return {**rows[0], **scores, "rows_n": int(rows_n.sum())}


def to_csv(table: pd.DataFrame) -> str:
    """Return the table as CSV text with six significant digits, as in numbers.json."""
    return table.convert_dtypes().to_csv(index=False, float_format="%.6g")


def select(rows: pd.DataFrame, **values: str | float) -> pd.DataFrame:
    """Select the rows that have the given values in these columns."""
    for column, value in values.items():
        rows = rows[rows[column] == value]
    return rows


def whole(rows: pd.DataFrame, places: str = AS_LABELLED) -> pd.DataFrame:
    """Select the joint rows for all skins that a network was tested on, one row per training run."""
    return select(rows, skin=ALL_SKINS, places=places)


def by_skin(rows: pd.DataFrame) -> pd.DataFrame:
    """Select the rows for single skins."""
    return rows[rows["skin"] != ALL_SKINS]


def records(rows: pd.DataFrame) -> dict[str, dict[str, float]]:
    """Return the values as a dict of dicts, by index and column, without NaN."""
    known = {str(index): row.dropna() for index, row in rows.iterrows()}
    return {index: {str(name): float(value) for name, value in row.items()} for index, row in known.items()}


def tally(trainings: Iterable[Mapping[str, Any]]) -> dict[str, int]:
    """Count all training runs, including repeated ones, and the collapsed training runs among them.

    A training run has collapsed if the output of its network is nearly constant. It is then repeated. If every repeat
    also collapses, the last network is kept, and counted in `kept_collapsed_n`.

    >>> tally([{"collapsed": False, "collapsed_before_n": 1}, {"collapsed": True, "collapsed_before_n": 2}])
    {'trainings_n': 5, 'collapsed_n': 4, 'kept_collapsed_n': 1}
    """
    counted = [(training["collapsed"], training["collapsed_before_n"]) for training in trainings]
    kept_n, before_n = sum(collapsed for collapsed, _ in counted), sum(before_n for _, before_n in counted)
    return {"trainings_n": len(counted) + before_n, "collapsed_n": before_n + kept_n, "kept_collapsed_n": kept_n}


# --- Intervals and p-values ---


def interval(values: Values, metric: str = "") -> list[float] | None:
    """Compute the two-sided 95 % interval of a mean by Student's t (see `t_interval`).

    Returns None if there are fewer than two values.

    >>> interval([1.0]) is None
    True
    >>> [round(float(end), 2) for end in interval([1.0, 3.0])]  # t is 12.71 with one degree of freedom
    [-10.71, 14.71]
    >>> [round(float(end), 1) for end in interval([60.0, 90.0, 99.0, 95.0], "accuracy_pct")]
    [37.1, 98.5]
    """
    n = len(values)
    if n < 2:
        return None
    return t_interval(float(np.mean(values)), float(np.std(values, ddof=1) / np.sqrt(n)), n - 1, metric)


def t_interval(mean: float, se: float, df: float, metric: str = "") -> list[float]:
    """Compute the 95 % interval of a mean from its standard error by Student's t, within the metric's possible range.

    The delta method gives the interval g(mean) +- t g'(mean) se, which is transformed back by the inverse of g. The
    transformation g(x) is the logit for percentages, the logarithm for squared errors, -log(1 - x) for metrics that are
    at most 1, and x for all other metrics.
    """
    from scipy.special import expit, logit, stdtrit  # imported late, because SciPy is only needed for intervals

    half_width = float(stdtrit(df, (1 + CONFIDENCE) / 2)) * se
    if half_width == 0:
        return [mean, mean]
    ends = np.array([-half_width, half_width])
    if metric in PERCENTAGES:
        fraction = mean / 100
        return [float(end) for end in 100 * expit(logit(fraction) + ends / (100 * fraction * (1 - fraction)))]
    if metric.startswith("mse_"):
        return [float(end) for end in mean * np.exp(ends / mean)]
    if metric in AT_MOST_1:
        return [float(end) for end in 1 - (1 - mean) * np.exp(-ends / (1 - mean))]
    return [float(end) for end in mean + ends]


def p_value(mean: float, se: float, df: float) -> float:
    """Compute the two-sided p-value of a mean difference by Student's t; the null hypothesis is a difference of 0."""
    from scipy.special import stdtr

    if se == 0:
        return 1.0 if mean == 0 else 0.0
    return float(2 * stdtr(df, -abs(mean) / se))


def holm(p_values: Mapping[str, float]) -> dict[str, float]:
    """Adjust the p-values of a family of tests for the number of tests by Holm's method (Holm 1979).

    >>> holm({"a": 0.01, "b": 0.04, "c": 0.03})
    {'a': 0.03, 'c': 0.06, 'b': 0.06}
    """
    adjusted, lower_bound = {}, 0.0
    for i, name in enumerate(sorted(p_values, key=lambda key: p_values[key])):
        lower_bound = max(lower_bound, min(1.0, (len(p_values) - i) * p_values[name]))
        adjusted[name] = lower_bound
    return adjusted


# --- Summaries over boards, folds, pairs ---


def statistic(values: Values, *, boards: bool = False, metric: str = "") -> dict[str, Any]:
    """Summarise values by their mean, their number and their spread.

    The summary has the keys `mean` and `n` and, if there are two or more values, the standard deviation `sd` (with
    divisor n - 1). If each value belongs to one board (`boards`), the summary of two or more values also has the 95 %
    confidence interval `ci95`. If there are fewer than `BOARDS_MIN` values, it has `values` instead of the interval:
    the values themselves, in the order of the boards.
    """
    stat = {"mean": float(np.mean(values)), "n": len(values)}
    if len(values) < 2:
        return stat
    stat["sd"] = float(np.std(values, ddof=1))
    if not boards:
        return stat
    few = len(values) < BOARDS_MIN
    return stat | ({"values": [float(value) for value in values]} if few else {"ci95": interval(values, metric)})


def summarise(units: pd.DataFrame, *, boards: bool = False, differences: bool = False) -> dict[str, dict[str, Any]]:
    """Summarise each column over its values that are not NaN.

    differences: whether the columns are differences of metrics. Intervals of metrics are limited to possible values,
    such as 0 to 100 %. These limits do not hold for differences of a metric.
    """
    known = {str(name): units[name].dropna().to_numpy() for name in units}
    return {
        name: statistic(values, boards=boards, metric="" if differences else name)
        for name, values in known.items()
        if len(values)
    }


def over_units(rows: pd.DataFrame, *unit: str, boards: bool = False) -> dict[str, dict[str, Any]]:
    """Summarise every metric over units, which are the groups of rows with equal values in the columns `unit`.

    The value of a unit is the mean of its rows. The summary also has `sd_seeds`, the standard deviation within a unit,
    averaged over units. `sd_seeds` is left out if the units are two or more boards.
    """
    groups = rows.groupby(list(unit))[_metrics(rows)]
    summary = summarise(groups.mean(), boards=boards)
    return add_seed_sd(summary, rows, *unit) if not boards or groups.ngroups == 1 else summary


def add_seed_sd(summary: Mapping[str, Stat], rows: pd.DataFrame, *unit: str) -> dict[str, dict[str, Any]]:
    """Add `sd_seeds` to each statistic: the standard deviation (n - 1) of the rows of a unit, averaged over units.

    The rows of a unit are networks that differ in their seed. If every unit has only one row, `sd_seeds` is not added.
    """
    sds = rows.groupby(list(unit))[_metrics(rows)].std().mean().dropna()
    return {
        name: {**stat, "sd_seeds": float(sds[name])} if name in sds else dict(stat) for name, stat in summary.items()
    }


def over_folds(rows: pd.DataFrame) -> dict[str, dict[str, Any]]:
    """Summarise training runs over folds; the value of a fold is the mean over its seeds."""
    return over_units(whole(rows), "fold")


def over_boards(rows: pd.DataFrame, places: str = AS_LABELLED) -> dict[str, dict[str, Any]]:
    """Summarise training runs over held-out boards; a board's value is the mean over seeds and draws of skins."""
    return over_units(whole(rows, places), "board", boards=True)


def over_pairs(rows: pd.DataFrame) -> dict[str, dict[str, Any]]:
    """Summarise over pairs of a training skin and a test skin, as the paper does (3 x 9 pairs).

    The interval `ci95` treats both training skins and test boards as samples (`two_way_error`). `training_n` is the
    number of training skins, `boards_n` the number of test boards.
    """
    skin_rows = by_skin(rows)
    pairs = over_units(skin_rows, "fold", "skin")
    crossed = skin_rows.groupby(["fold", "board"])[_metrics(skin_rows)].mean()
    summary = {}
    for name, stat in pairs.items():
        table = crossed[name].dropna().unstack()
        error = two_way_error(table)
        summary[name] = stat | {"training_n": len(table), "boards_n": len(table.columns)}
        if error is not None:
            summary[name]["ci95"] = t_interval(stat["mean"], *error, name)
    return summary


def two_way_error(table: pd.DataFrame) -> tuple[float, float] | None:
    """Compute the standard error of a table's mean, and its degrees of freedom, if both rows and columns are samples.

    Rows are training skins and columns are test boards; cells may be missing. The squared standard error is the sum of
    two terms: the variance of the row means divided by the number of rows, and the variance of the column means divided
    by the number of columns. This sum is slightly too large, because the residual variance of the cells is in both
    terms. The degrees of freedom are Satterthwaite's. Returns None if there are fewer than two rows or fewer than
    `BOARDS_MIN` columns.
    """
    if len(table) < 2 or len(table.columns) < BOARDS_MIN:
        return None
    factors = [table.mean(axis=axis).to_numpy() for axis in (1, 0)]
    parts = [float(means.var(ddof=1)) / len(means) for means in factors]
    weight = sum(part**2 / (len(means) - 1) for part, means in zip(parts, factors, strict=True))
    return sum(parts) ** 0.5, sum(parts) ** 2 / weight if weight else 1.0


def board_means(rows: pd.DataFrame) -> pd.DataFrame:
    """Average scores over the networks on each skin, then over the skins of each board; return one row per board."""
    return _skin_means(rows).groupby("board").mean()


def _metrics(rows: pd.DataFrame) -> list[str]:
    return [str(name) for name in rows if name not in (*KEYS, *TRUTH)]


def _skin_means(rows: pd.DataFrame) -> pd.DataFrame:
    return rows.groupby(["board", "skin"])[_metrics(rows)].mean()


# --- Paired differences ---


def paired(method: pd.DataFrame, other: pd.DataFrame) -> dict[str, Any]:
    """Summarise the differences between two methods on the same skins over boards.

    Key `by_board` of the result contains the difference of each board.
    """
    return summarise_differences(differences(method, other))


def differences(method: pd.DataFrame, other: pd.DataFrame) -> pd.DataFrame:
    """Compute the scores of `method` minus those of `other`; return one row per board.

    Networks are averaged on each skin first, then the differences are averaged over the skins of a board.
    """
    ours, theirs = _skin_means(method), _skin_means(other)
    if not ours.index.equals(theirs.index):
        raise _unpaired(sorted(ours.index.symmetric_difference(theirs.index)))
    return (ours - theirs).groupby("board").mean()


def summarise_differences(by_board: pd.DataFrame) -> dict[str, Any]:
    """Summarise differences over boards.

    Key `by_board` of the result contains the differences of each board. If there are `BOARDS_MIN` boards or more, the
    summary of each metric has the standard error `se`, the degrees of freedom `df`, and the p-value `p` that follows
    from them under the null hypothesis of no difference.
    """
    summary = summarise(by_board, boards=True, differences=True)
    means = {name: stat | {"mean": round(stat["mean"], DECIMALS)} for name, stat in summary.items()}
    for stat in means.values():
        if "ci95" in stat:
            stat |= _t_test(stat["mean"], stat["sd"] / stat["n"] ** 0.5, stat["n"] - 1)
    return {**means, "by_board": records(by_board)}


def paired_with_single(method: pd.DataFrame, single: pd.DataFrame) -> dict[str, Any]:
    """Summarise the differences between `method` and `single`, each of whose networks is trained on only one skin.

    The differences are computed on the skins on which `single` was tested. The result has the same form as the result
    of `paired`. Its interval and p-value are computed with `two_way_error`, because both the test boards and the
    training skins of `single` are samples.
    """
    theirs = single.groupby(["fold", "board", "skin"])[_metrics(single)].mean()
    ours, skins = _skin_means(method), pd.MultiIndex.from_tuples([pair[1:] for pair in theirs.index])
    if unpaired := sorted(set(skins) - set(ours.index)):
        raise _unpaired(unpaired)
    by_pair = (ours.loc[skins, theirs.columns].set_axis(theirs.index) - theirs).groupby(["fold", "board"]).mean()
    summary = summarise_differences(by_pair.groupby("board").mean())
    for name in by_pair:
        if name in summary:
            stat = {key: value for key, value in summary[name].items() if key in ("mean", "sd", "n", "values")}
            error = two_way_error(by_pair[name].dropna().unstack())
            summary[name] = stat if error is None else stat | _t_test(stat["mean"], *error)
    return summary


def _t_test(mean: float, se: float, df: float) -> dict[str, Any]:
    return {"ci95": t_interval(mean, se, df), "se": se, "df": df, "p": p_value(mean, se, df)}


def _unpaired(skins: Sequence[Any]) -> SchemaError:
    remedy = "Train both methods on the same folds."
    return SchemaError(
        "a paired difference needs scores of both methods on the same held-out skins, but only one method has scores "
        f"on {skins}. {remedy}"
    )


def negate(stat: Stat) -> dict[str, Any]:
    """Change the sign of a difference: its mean, its values and its interval."""
    negative = {**stat, "mean": -stat["mean"]}
    negative |= {"values": [-value for value in stat["values"]]} if "values" in stat else {}
    return negative | ({"ci95": [-end for end in reversed(stat["ci95"])]} if "ci95" in stat else {})


# --- Verdicts ---


def verdict(stat: Stat, *, above: float = 0.0) -> str:
    """Judge from the 95 % interval whether a mean over boards is above a threshold."""
    if "ci95" not in stat:
        return FEW_BOARDS
    low, high = stat["ci95"]
    return SUPPORTED if low > above else CONTRADICTED if high < above else UNDECIDED


def verdict_within(stat: Stat, margin: float) -> str:
    """Judge from the 95 % interval whether a mean over boards is nearer to 0 than `margin` (a test of equivalence)."""
    if "ci95" not in stat:
        return FEW_BOARDS
    low, high = stat["ci95"]
    if -margin < low and high < margin:
        return SUPPORTED
    return CONTRADICTED if low > margin or high < -margin else UNDECIDED


def combine_verdicts(verdicts: Sequence[str]) -> str:
    """Judge a claim with several parts from the verdicts on its parts.

    The claim is contradicted if any part is contradicted, and supported if all parts are supported.
    """
    return next((verdict for verdict in (CONTRADICTED, FEW_BOARDS, UNDECIDED) if verdict in verdicts), SUPPORTED)

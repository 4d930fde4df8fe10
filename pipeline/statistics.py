"""Statistics over boards, folds and pairs of skins, computed from rows of the table of scores.

In statistical tests, one board counts as one observation. The skins of a board are not independent observations,
because they share the board and are tested with the same networks, which were trained without this board.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float

from pipeline.scores import AS_LABELLED, KEYS, by_skin, whole
from reskin.errors import SchemaError
from reskin.metrics import TRUTH

CONFIDENCE = 0.95  # confidence level of intervals; the usual convention
PERCENTAGES = (
    "accuracy_pct",
    "coverage_pct",
    "coverage_f_pct",
    "false_pct",
    "detected_pct",
)  # metrics between 0 and 100
AT_MOST_1 = ("r2_f", "cosine_mean", "explained_median")  # metrics that are at most 1
DECIMALS = 12  # differences in %, mm2 or N2 are rounded to this many decimals, to remove rounding errors
BOARDS_MIN = 4  # with fewer boards, no interval is computed; the value of each board is given instead

Values = Sequence[float] | Float[np.ndarray, " n"] | pd.Series
Transformation = Callable[[Any], Any]


@dataclass(frozen=True)
class Stat:
    """The mean of a metric over n units (boards, folds, or pairs of skins), and its spread as far as it is known.

    - sd: standard deviation over the units.
    - ci95: 95 % interval of the mean over boards, from `BOARDS_MIN` boards on.
    - values: the values of the boards, in their order, if there are fewer boards.
    - sd_seeds: standard deviation over the networks of one unit that differ in their seed, averaged over units.
    - df: degrees of freedom of the interval of a mean difference.
    - training_n, boards_n: numbers of training skins and of test boards, if the units are pairs of both.
    """

    mean: float
    n: int
    sd: float | None = None
    ci95: tuple[float, float] | None = None
    values: tuple[float, ...] | None = None
    sd_seeds: float | None = None
    df: float | None = None
    training_n: int | None = None
    boards_n: int | None = None

    @classmethod
    def of(cls, stat: "Stat | Mapping[str, Any]") -> "Stat":
        """Return a statistic from its entry in numbers.json, which has the values of boards by name or in a list.

        An entry without `n` is a single number.
        """
        if isinstance(stat, Stat):
            return stat
        if "by_board" in stat:
            return cls(stat["mean"], len(stat["by_board"]), values=tuple(stat["by_board"].values()))
        return cls(**{"n": 1} | {name: stat[name] for name in _FIELDS if name in stat})

    @property
    def ends(self) -> tuple[float, ...]:
        """The ends of the interval, or the values of a few boards; empty if neither is known."""
        return tuple(self.ci95 or self.values or ())

    @property
    def few(self) -> bool:
        """Whether there are so few boards that their values replace the interval."""
        return self.values is not None

    def to_json(self) -> dict[str, Any]:
        """Return the entry of numbers.json: what is known, by name."""
        known = {name: value for name, value in asdict(self).items() if value is not None}
        return {name: list(value) if isinstance(value, tuple) else value for name, value in known.items()}


_FIELDS = tuple(field.name for field in fields(Stat))
Summary = dict[str, Stat]  # statistics by metric


def as_json(value: Any) -> Any:
    """Replace each statistic in nested dicts and lists by its entry of numbers.json."""
    if isinstance(value, Stat):
        return value.to_json()
    if isinstance(value, Mapping):
        return {key: as_json(item) for key, item in value.items()}
    return [as_json(item) for item in value] if isinstance(value, list | tuple) else value


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


def t_interval(mean: float, se: float, df: float, metric: str = "") -> tuple[float, float]:
    """Compute the 95 % interval of a mean from its standard error by Student's t, within the metric's possible range.

    The delta method gives the interval g(mean) +- t g'(mean) se, which is transformed back by the inverse of g (see
    `_transformation`).

    >>> [round(float(end), 2) for end in t_interval(2.0, 1.0, 1)]  # t is 12.71 with one degree of freedom
    [-10.71, 14.71]
    >>> [round(float(end), 1) for end in t_interval(86.0, 8.86, 3, "accuracy_pct")]
    [37.1, 98.5]
    """
    from scipy.special import stdtrit  # imported late, because SciPy is only needed for intervals

    half_width = float(stdtrit(df, (1 + CONFIDENCE) / 2)) * se
    if half_width == 0:
        return mean, mean
    g, slope, inverse = _transformation(metric)
    low, high = inverse(g(mean) + slope(mean) * np.array([-half_width, half_width]))
    return float(low), float(high)


def _transformation(metric: str) -> tuple[Transformation, Transformation, Transformation]:
    """Return the transformation g of a metric whose range is limited, its derivative, and its inverse.

    g(x) is the logit for percentages, the logarithm for squared errors, -log(1 - x) for metrics that are at most 1, and
    x for all other metrics.
    """
    from scipy.special import expit, logit

    if metric in PERCENTAGES:
        return lambda x: logit(x / 100), lambda x: 100 / (x * (100 - x)), lambda y: 100 * expit(y)
    if metric.startswith("mse_"):
        return np.log, lambda x: 1 / x, np.exp
    if metric in AT_MOST_1:
        return lambda x: -np.log(1 - x), lambda x: 1 / (1 - x), lambda y: 1 - np.exp(-y)
    return lambda x: x, lambda x: 1.0, lambda y: y


def p_value_of(stat: Stat, mean: float, metric: str = "") -> float:
    """Compute the two-sided p-value of the null hypothesis that the mean over boards equals `mean`, by Student's t.

    It agrees with the interval of `t_interval`: it is below 0.05 if and only if `mean` is outside `stat.ci95`. If
    `mean` is not a possible value of the metric, it is 0.
    """
    from scipy.special import stdtr, stdtrit

    assert stat.ci95 is not None, "the statistic has an interval over boards"
    df = stat.df or min(filter(None, (stat.training_n, stat.boards_n)), default=stat.n) - 1
    metric = metric if stat.ci95[0] < stat.ci95[1] else ""
    with np.errstate(divide="ignore", invalid="ignore"):
        low, high, ours, null = _transformation(metric)[0](np.array([*stat.ci95, stat.mean, mean]))
    if not np.isfinite(null):
        return 0.0
    se = (high - low) / 2 / stdtrit(df, (1 + CONFIDENCE) / 2)
    return float(2 * stdtr(df, -abs(ours - null) / se)) if se else float(ours == null)


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


def statistic(values: Values, *, boards: bool = False, metric: str = "") -> Stat:
    """Summarise values by their mean, their number and, if there are two or more, their standard deviation (n - 1).

    If each value belongs to one board (`boards`), the summary also has the 95 % interval of the mean, or the values
    themselves if there are fewer than `BOARDS_MIN`.
    """
    stat = Stat(float(np.mean(values)), len(values))
    if len(values) < 2:
        return stat
    sd = float(np.std(values, ddof=1))
    stat = replace(stat, sd=sd)
    if not boards:
        return stat
    if len(values) < BOARDS_MIN:
        return replace(stat, values=tuple(float(value) for value in values))
    return replace(stat, ci95=t_interval(stat.mean, sd / stat.n**0.5, stat.n - 1, metric))


def summarise(units: pd.DataFrame, *, boards: bool = False, differences: bool = False) -> Summary:
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


def over_units(rows: pd.DataFrame, *unit: str, boards: bool = False) -> Summary:
    """Summarise every metric over units, which are the groups of rows with equal values in the columns `unit`.

    The value of a unit is the mean of its rows. The summary also has `sd_seeds`, the standard deviation within a unit,
    averaged over units. `sd_seeds` is left out if the units are two or more boards.
    """
    groups = rows.groupby(list(unit))[_metrics(rows)]
    summary = summarise(groups.mean(), boards=boards)
    return add_seed_sd(summary, rows, *unit) if not boards or groups.ngroups == 1 else summary


def add_seed_sd(summary: Mapping[str, Stat], rows: pd.DataFrame, *unit: str) -> Summary:
    """Add `sd_seeds` to each statistic: the standard deviation (n - 1) of the rows of a unit, averaged over units.

    The rows of a unit are networks that differ in their seed. If every unit has only one row, `sd_seeds` is not added.
    """
    sds = rows.groupby(list(unit))[_metrics(rows)].std().mean().dropna()
    return {name: replace(stat, sd_seeds=float(sds[name])) if name in sds else stat for name, stat in summary.items()}


def over_folds(rows: pd.DataFrame) -> Summary:
    """Summarise training runs over folds; the value of a fold is the mean over its seeds."""
    return over_units(whole(rows), "fold")


def over_boards(rows: pd.DataFrame, places: str = AS_LABELLED) -> Summary:
    """Summarise training runs over held-out boards; a board's value is the mean over seeds and draws of skins."""
    return over_units(whole(rows, places), "board", boards=True)


def over_pairs(rows: pd.DataFrame) -> Summary:
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
        ci95 = None if error is None else t_interval(stat.mean, *error, name)
        summary[name] = replace(stat, ci95=ci95, training_n=len(table), boards_n=len(table.columns))
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


def records(rows: pd.DataFrame) -> dict[str, dict[str, float]]:
    """Return the values as a dict of dicts, by index and column, without NaN."""
    known = {str(index): row.dropna() for index, row in rows.iterrows()}
    return {index: {str(name): float(value) for name, value in row.items()} for index, row in known.items()}


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

    Key `by_board` of the result contains the differences of each board.
    """
    summary = summarise(by_board, boards=True, differences=True)
    stats = {name: replace(stat, mean=round(stat.mean, DECIMALS)) for name, stat in summary.items()}
    for name, stat in stats.items():
        if stat.ci95 is not None and stat.sd is not None:
            stats[name] = _with_interval(stat, stat.sd / stat.n**0.5, stat.n - 1)
    return {**stats, "by_board": records(by_board)}


def paired_with_single(method: pd.DataFrame, single: pd.DataFrame) -> dict[str, Any]:
    """Summarise the differences between `method` and `single`, each of whose networks is trained on only one skin.

    The differences are computed on the skins on which `single` was tested. The result has the same form as the result
    of `paired`. Its interval is computed with `two_way_error`, because both the test boards and the training skins of
    `single` are samples.
    """
    theirs = single.groupby(["fold", "board", "skin"])[_metrics(single)].mean()
    ours, skins = _skin_means(method), pd.MultiIndex.from_tuples([pair[1:] for pair in theirs.index])
    if unpaired := sorted(set(skins) - set(ours.index)):
        raise _unpaired(unpaired)
    by_pair = (ours.loc[skins, theirs.columns].set_axis(theirs.index) - theirs).groupby(["fold", "board"]).mean()
    summary = summarise_differences(by_pair.groupby("board").mean())
    for name in by_pair:
        if name in summary:
            stat = replace(summary[name], ci95=None, df=None)
            error = two_way_error(by_pair[name].dropna().unstack())
            summary[name] = stat if error is None else _with_interval(stat, *error)
    return summary


def _with_interval(stat: Stat, se: float, df: float) -> Stat:
    return replace(stat, ci95=t_interval(stat.mean, se, df), df=df)


def _unpaired(skins: Sequence[Any]) -> SchemaError:
    remedy = "Train both methods on the same folds."
    return SchemaError(
        "a paired difference needs scores of both methods on the same held-out skins, but only one method has scores "
        f"on {skins}. {remedy}"
    )

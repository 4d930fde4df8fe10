"""The checklist, which compares each result of the paper with ours and gives a verdict on each claim.

Its rows are read from `checklist.yaml`. The paper's numbers are constants of `pipeline.paper`.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import pandas as pd

from pipeline import paper, statistics
from pipeline.formatting import FEW_POINTS, gain, reworded, show, show_difference
from pipeline.report.table_2 import is_pooled
from pipeline.statistics import CONTRADICTED, FEW_BOARDS, SUPPORTED, UNDECIDED, VERDICTS, Stat
from reskin.config import Strict, parse, read_yaml
from reskin.errors import SchemaError

FILE = Path(__file__).with_name("checklist.yaml")
METRICS = {
    "accuracy_pct": "accuracy", "mse_xy_mm2": "MSE of the position", "mse_f_N2": "MSE of the force",
    "mse_fxy_N2": "MSE of the shear force", "mse_fz_N2": "MSE of the normal force",
}  # fmt: skip
UNITS = {"pct": "%", "mm2": "mm²", "N2": "N²", "mm": "mm", "N": "N", "hz": "Hz"}
CLAIM = "claim: "
NEAR = 0.10  # assumed: relative tolerance if the paper gives no standard deviation (sd)
SIZEABLE = 0.5  # assumed: a gain is sizeable if it is at least this fraction of the paper's gain
SIGNIFICANT = 0.05  # convention: a claim of the family is significant if its adjusted p-value is at most this
PLATEAU_POINTS = 1.0  # assumed: "seems to plateau" means a difference of less than this, in percentage points
NONE = "–"
NOT_RUN = "not run in this scene"
NOT_SIGNIFICANT = "not significant after Holm's correction"
NOT_REACHED = "the experiment of this scene is too small for this result"
SHORT_OF = "smaller than the paper's: "  # prefix of a note on the size of our experiment
ONE_SKIN = "not comparable with the paper, because each of our networks was trained on only one skin"
SETTING = "a setting of this scene, not a result"
TARGET = "an earlier simulation was calibrated to this number of the paper, so agreement is not evidence"
EQUIVALENT = (
    "equivalent to no difference, because the whole interval is nearer to 0 than half of the paper's difference"
)
# Paths of results that are comparable with the paper only if networks were trained on several skins.
NEEDS_POOLING = ("table2.multi.", "table2.triplet.", "table2.adapted.", "paired.", "contrasts.")
# Verdicts on numbers. They say whether our interval over boards includes the paper's mean.
AGREES, DIFFERS = "within interval", "significant difference"
NO_INTERVAL = "not judged (no interval over boards)"
DIFFERENCES = ("gain", "sizeable", "slight", "plateau")  # rules for differences, which are shown with a sign
FAMILY = (
    "The claims of section 5 about accuracy are tested as one family. The family was listed before any run "
    "(`family` in checklist.yaml). Its p-values (Student's t over boards) are adjusted for the number of tests by "
    "Holm's method. A claim of the family is supported or contradicted only if its adjusted p-value is "
    f"{SIGNIFICANT:g} or less. The verdicts on all other claims are not adjusted, and are therefore exploratory. A "
    f"gain is sizeable if it is at least {100 * SIZEABLE:g} % of the paper's difference. A difference is equivalent to "
    f"no difference if its whole interval is nearer to 0 than {100 * SIZEABLE:g} % of the paper's difference."
)
MEANING = (
    f"{reworded(VERDICTS)} If a number of the paper is not a claim, the verdict says whether our interval over boards "
    f'includes the paper\'s mean ("{AGREES}") or not ("{DIFFERS}"). These two verdicts do not take the standard '
    f"deviation of the paper's number into account. {FAMILY} Column met says whether our mean meets the criterion. "
    f'"Slightly" means that the accuracy changes by less than {FEW_POINTS:g} percentage points, and "plateau" means '
    f"that it changes by less than {PLATEAU_POINTS:g} percentage points. The reasons in column note are assumptions, "
    "which no run has tested. If a result is not a single number, column ours names the table or figure that shows it "
    '("see ...").'
)
CLAIMS_MEANING = f"{reworded(VERDICTS)} {FAMILY}"
NAMED_NUMBER = re.compile(r"\{([\w.]+)\}")  # the name of a number in the text of a reason


class Reach(Strict):
    """The sizes of the paper's experiment and of ours, for example the numbers of training readings.

    `paper` names a constant of `pipeline.paper`, and `ours` is a path in numbers.json.
    """

    paper: str
    ours: str
    of: str  # name of what is counted, for example "training readings"


class Row(Strict):
    """A row of the checklist: one result of the paper, and the path of our result in numbers.json.

    The rule says how our result is judged:

    - `near`: our number is close to the paper's.
    - `at_most`, `at_least`, `positive`: our number is within a limit.
    - `gain`: a paired difference is an improvement.
    - `sizeable`: a paired difference is an improvement of at least half of the paper's difference.
    - `each`: every paired difference in a list is an improvement.
    - `slight`, `plateau`: a paired difference is small.
    - `input`: like `near` in recorded scenes; not judged in simulated scenes, where the number is a setting.
    - `target`: like `near`; in simulated scenes, a note says that the number was a calibration target.
    - `setting`: not judged, because the number is a setting in every scene.
    - `view`: not judged, because the result is a figure or table to look at.
    """

    id: str
    where: str
    what: str
    paper: str | None = None  # the dotted name of a constant of `pipeline.paper`
    says: str | None = None  # the paper's words, if it gives no number
    ours: str | None = None
    experiment: str | None = None  # the experiment that computes `ours`, if this number is missing in small scenes
    rule: Literal[
        "near", "at_most", "at_least", "positive", "gain", "sizeable", "each", "slight", "plateau", "input", "setting",
         "target", "view",
    ] = "near"  # fmt: skip
    signs: tuple[str, str] | None = None  # meaning of a negative and of a positive number, in words
    family: bool = False  # whether the claim belongs to the family whose p-values are adjusted by Holm's method
    reach: Reach | None = None
    only: Literal["recorded", "simulated"] | None = None  # only scenes of this source show the row
    stage: str | None = None
    shown: tuple[str, ...] = ()
    why: str = ""  # a possible reason, shown if our result misses the criterion; {name} becomes the number at that path
    why_simulated: str = ""  # like `why`, for simulated scenes only

    @property
    def metric(self) -> str:
        """The last part of the path `ours`."""
        return (self.ours or "").rsplit(".", 1)[-1]


@dataclass(frozen=True)
class Judgement:
    """Verdict on a claim, its criterion, whether our mean meets the criterion, adjusted p-value, and notes."""

    verdict: str = NONE
    criterion: str = NONE
    met: str = NONE
    p_adjusted: float | None = None
    notes: tuple[str, ...] = ()


def read_rows() -> list[Row]:
    """Read the rows of the checklist, in the paper's order."""
    entries = read_yaml(FILE)
    return [parse(Row, row, f"checklist, row {row['id']}") for entry in entries for row in _by_metric(entry)]


def _by_metric(entry: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield one row per metric of an entry; an entry that lists no metrics yields one row."""
    row = dict(entry)
    metrics = row.pop("metrics", None)
    if metrics is None:
        yield row
    for metric in metrics or ():
        paths = {side: f"{row[side]}.{metric}" for side in ("paper", "ours") if side in row}
        yield row | paths | {"id": f"{row['id']}-{metric}", "what": f"{row['what']}: {METRICS[metric]}"}


def checklist(numbers: Mapping[str, Any], rows: Sequence[Row] | None = None) -> pd.DataFrame:
    """Tabulate every result of the paper beside ours, with the criterion by which our result is judged."""
    source = numbers["provenance"]["source"]
    rows = [row for row in (read_rows() if rows is None else rows) if row.only in (None, source)]
    p_adjusted = adjusted_p_values(numbers, rows)
    lines = []
    for row in rows:
        printed, ours = _paper_and_ours(numbers, row)
        judgement = judge(row, printed, ours, pooled=is_pooled(numbers), simulated=source == "simulated")
        if ours is None and row.experiment in numbers:
            judgement = Judgement(notes=(NOT_REACHED,))
        elif row.id in p_adjusted:
            judgement = adjust(judgement, p_adjusted[row.id])
        notes = [*_reach(numbers, row, ours), *judgement.notes, *_reason(numbers, row, judgement)]
        lines.append(
            {
                "in the paper": row.where,
                "result": row.what,
                "paper": row.says if printed is None else _show(row, printed),
                "ours": _show_ours(row, ours),
                "verdict": reworded(judgement.verdict),
                "criterion": judgement.criterion,
                "met": reworded(judgement.met),
                "paper in our interval": _paper_in_interval(printed, ours),
                "p (Holm)": NONE if judgement.p_adjusted is None else f"{judgement.p_adjusted:.2g}",
                "note": ". ".join(notes) or NONE,
                "stage": row.stage or NONE,
                "shown in": ", ".join(row.shown) if row.shown and (ours is not None or not row.ours) else NONE,
                "source": source,
            }
        )
    table = pd.DataFrame(lines)
    table.attrs["meaning"] = MEANING
    return table


def claims_table(table: pd.DataFrame) -> pd.DataFrame:
    """Select the judged claims of a checklist."""
    judged = table["result"].str.startswith(CLAIM) & (table["verdict"] != NONE)
    claims = table[judged].drop(columns=["stage", "shown in"])
    claims = claims.assign(result=claims["result"].str.removeprefix(CLAIM)).rename(columns={"result": "claim"})
    claims.attrs["meaning"] = CLAIMS_MEANING
    return claims


def adjusted_p_values(numbers: Mapping[str, Any], rows: Sequence[Row]) -> dict[str, float]:
    """Compute the p-values of the family of claims, adjusted by Holm's method; return them by row id."""
    p_values = {row.id: claim_p_value(row, *_paper_and_ours(numbers, row)) for row in rows if row.family}
    return statistics.holm({name: p for name, p in p_values.items() if p is not None})


def claim_p_value(row: Row, printed: Any, ours: Any) -> float | None:
    """Compute the p-value of a claim about differences over boards; None if too few boards were compared.

    A claim about every number of training skins has one p-value per number of skins. Such a claim holds only if it
    holds for every number of skins. Its p-value is therefore the largest of these p-values. If the results for some
    numbers of skins significantly contradict the claim, its p-value is the smallest p-value of the contradicting
    results, with Bonferroni's correction for all numbers of skins.
    """
    if isinstance(ours, Sequence):
        parts = [contrast["accuracy_pct"] for contrast in ours]
        p_values = [p for p in (claim_p_value(row, None, part) for part in parts) if p is not None]
        if not p_values or len(p_values) < len(parts):
            return None
        contradicting = [
            p for p, part in zip(p_values, parts, strict=True) if gain(part, row.metric).mean < 0 and p <= SIGNIFICANT
        ]
        return min(1.0, len(p_values) * min(contradicting)) if contradicting else max(p_values)
    if not isinstance(ours, Mapping) or "se" not in ours:
        return None
    limit = sizeable(mean_of(printed)) if row.rule == "sizeable" else 0.0
    return statistics.p_value(gain(ours, row.metric).mean - limit, ours["se"], ours["df"])


def adjust(judgement: Judgement, p_adjusted: float) -> Judgement:
    """Add the adjusted p-value to the judgement of a claim; a verdict that is not significant becomes undecided."""
    if judgement.verdict in (SUPPORTED, CONTRADICTED) and p_adjusted > SIGNIFICANT:
        return replace(judgement, verdict=UNDECIDED, p_adjusted=p_adjusted, notes=(*judgement.notes, NOT_SIGNIFICANT))
    return replace(judgement, p_adjusted=p_adjusted)


def judge(row: Row, printed: Any, ours: Any, *, pooled: bool, simulated: bool) -> Judgement:
    """Judge our result by the row's rule; the verdict on a claim about a mean over boards follows from its interval.

    `pooled`: whether some network was trained on several skins. `simulated`: whether the readings are simulated.
    """
    if row.ours is None:
        return Judgement()
    if ours is None:
        return Judgement(notes=(NOT_RUN,))
    if not pooled and row.ours.startswith(NEEDS_POOLING):
        return Judgement(notes=(ONE_SKIN,))
    if isinstance(ours, bool):
        return Judgement(FEW_BOARDS, "true on the measured board", _yes(ours))
    if row.rule == "setting" or (row.rule == "input" and simulated):
        return Judgement(notes=(SETTING,))
    if row.rule == "view":
        return Judgement()
    if row.rule == "each":
        return _judge_each(ours)
    if row.rule in DIFFERENCES:
        return _judge_difference(row, mean_of(printed), Stat.of(ours))
    if row.rule in ("at_most", "at_least", "positive"):
        limit = 0.0 if row.rule == "positive" else mean_of(printed)
        assert limit is not None, "a row with this rule has a number of the paper as its limit"
        return _judge_limit(row.rule, limit, Stat.of(ours) if isinstance(ours, Mapping) else Stat(float(ours), 1))
    return _judge_number(printed, ours, target=row.rule == "target" and simulated)


def _judge_difference(row: Row, printed: float | None, ours: Stat) -> Judgement:
    """Judge a paired difference: whether it is a gain above a limit, or equivalent to 0 within a margin."""
    if row.rule in ("slight", "plateau"):
        margin = FEW_POINTS if row.rule == "slight" else PLATEAU_POINTS
        verdict = statistics.verdict_within(ours, margin)
        return Judgement(verdict, f"change of less than {margin:g} points", _yes(abs(ours.mean) < margin))
    improvement = gain(ours, row.metric)
    limit, criterion = 0.0, "gain above 0"
    if row.rule == "sizeable":
        limit = sizeable(printed)
        criterion = f"gain above {limit:.3g} (half of the paper's gain)"
    low, high = improvement.ci95 or (-float("inf"), float("inf"))
    notes = (EQUIVALENT,) if printed and max(-low, high) < sizeable(printed) else ()
    return Judgement(
        statistics.verdict(improvement, above=limit), criterion, _yes(improvement.mean > limit), notes=notes
    )


def _judge_limit(rule: str, limit: float, ours: Stat) -> Judgement:
    """Judge whether a number is within a limit (the paper's number, or 0)."""
    mean = ours.mean
    if rule == "at_most":
        verdict = statistics.verdict(-ours, above=-limit)
        return Judgement(verdict, f"at most {limit:g}", _yes(mean <= limit))
    verdict = statistics.verdict(ours, above=limit)
    if rule == "at_least":
        return Judgement(verdict, f"at least {limit:g}", _yes(mean >= limit))
    return Judgement(verdict, "above 0", _yes(mean > 0))


def _judge_each(contrasts: Sequence[Mapping[str, Any]]) -> Judgement:
    """Judge a claim about accuracy that must hold for every number of training skins."""
    verdicts = {row["skins_n"]: statistics.verdict(Stat.of(row["accuracy_pct"])) for row in contrasts}
    counts = [f"with {n}{' training skin' * (i == 0)}{'s' * (i == 0 and n > 1)}" for i, n in enumerate(verdicts)]
    by_number = "; ".join(f"{count}: {verdict}" for count, verdict in zip(counts, verdicts.values(), strict=True))
    return Judgement(
        statistics.combine_verdicts(list(verdicts.values())),
        "gain above 0 for every number of training skins",
        _yes(all(row["accuracy_pct"]["mean"] > 0 for row in contrasts)),
        notes=(reworded(by_number),),
    )


def _judge_number(printed: Any, ours: Any, *, target: bool) -> Judgement:
    """Judge whether our interval includes the paper's mean.

    Also judge whether our mean is within one standard deviation of the paper's mean. If the paper gives no standard
    deviation, our mean must be within 10 % of the paper's number.
    """
    value, mean = mean_of(ours), mean_of(printed)
    if value is None or mean is None:
        return Judgement()
    tolerance, criterion = NEAR * abs(mean), f"within {100 * NEAR:g} % of the paper's number"
    if isinstance(printed, tuple):
        tolerance, criterion = printed[1], "within the paper's standard deviation"
    inside = {"yes": AGREES, "no": DIFFERS}.get(_paper_in_interval(printed, ours))
    few = FEW_BOARDS if isinstance(ours, Mapping) and Stat.of(ours).few else NO_INTERVAL
    met = _yes(abs(value - mean) <= tolerance)
    return Judgement(inside or few, criterion, met, notes=(TARGET,) if target else ())


def sizeable(printed: float | None) -> float:
    """Return the smallest sizeable gain: half of the paper's own gain."""
    assert printed is not None, "a row with rule `sizeable` has a difference of the paper"
    return SIZEABLE * abs(printed)


def _yes(holds: bool) -> str:
    return "yes" if holds else "no"


def _paper_and_ours(numbers: Mapping[str, Any], row: Row) -> tuple[Any, Any]:
    """Return the paper's number and our result; None if the row has no such number."""
    printed = look_up(numbers, row.paper) if row.paper else None
    return printed, resolve(numbers, row.ours) if row.ours else None


def resolve(numbers: Any, path: str) -> Any:
    """Follow a dotted path, in which `key=3,other=x` selects a row of a list; None if the scene has no such number."""
    value = numbers
    for part in path.split("."):
        if isinstance(value, list) and "=" in part:
            wanted = dict(pair.split("=", 1) for pair in part.split(","))
            value = next((row for row in value if wanted.items() <= {key: str(row[key]) for key in row}.items()), None)
        elif isinstance(value, Mapping) and part in value:
            value = value[part]
        else:
            return None
    return value


def look_up(numbers: Mapping[str, Any], name: str) -> Any:
    """Look up a dotted name: a constant of `pipeline.paper` (`SHEAR.mse_fz_N2`) or a path in numbers.json."""
    value = resolve(vars(paper) if name[0].isupper() else numbers, name)
    if value is None:
        problem = f"{name} is neither a constant of pipeline.paper nor a path in numbers.json"
        raise SchemaError(f"{FILE.name}: {problem}. Correct the name in {FILE.name}.")
    return value


def mean_of(value: Any) -> float | None:
    """Return the mean of a summary or of a pair (mean, sd), or a plain number, as a float; None for other values."""
    if isinstance(value, Mapping):
        return value.get("mean")
    if isinstance(value, tuple):
        return float(value[0])
    return float(value) if isinstance(value, int | float) else None


def _paper_in_interval(printed: Any, ours: Any) -> str:
    """If both exist, say whether our interval over boards includes the paper's number."""
    mean = mean_of(printed)
    ci95 = Stat.of(ours).ci95 if isinstance(ours, Mapping) and "mean" in ours else None
    if mean is None or ci95 is None:
        return NONE
    low, high = ci95
    return _yes(low <= mean <= high)


def _reach(numbers: Mapping[str, Any], row: Row, ours: Any) -> list[str]:
    """Return a note that compares the size of our experiment with the paper's; empty if the row names no sizes."""
    if row.reach is None or ours is None:
        return []
    ours_n, paper_n = resolve(numbers, row.reach.ours), look_up(numbers, row.reach.paper)
    if ours_n is None:
        return []
    return [f"{SHORT_OF if ours_n < paper_n else ''}{ours_n:,.0f} {row.reach.of} (paper: {paper_n:,.0f})"]


def _reason(numbers: Mapping[str, Any], row: Row, judgement: Judgement) -> list[str]:
    """Return the row's possible reason, with its numbers filled in, if our mean does not meet the criterion.

    If a reason names several numbers, the reason is that these numbers differ. It is therefore omitted if the numbers
    are equal after rounding.
    """
    why = row.why or (row.why_simulated if numbers["provenance"]["source"] == "simulated" else "")
    if not why or judgement.met != "no":
        return []
    named = [f"{look_up(numbers, name):.3g}" for name in NAMED_NUMBER.findall(why)]
    if len(named) > 1 and len(set(named)) == 1:
        return []
    shown = iter(named)
    return [NAMED_NUMBER.sub(lambda _: next(shown), why)]


def _show_ours(row: Row, ours: Any) -> str:
    if ours is None:
        return _see(row) if row.shown and not row.ours else NONE
    if isinstance(ours, bool):
        return _yes(ours)
    if isinstance(ours, int):
        return str(ours)
    return _see(row) if mean_of(ours) is None else _show(row, ours)


def _see(row: Row) -> str:
    """Name the table or figure that shows a result which is not a single number."""
    name = row.shown[0]
    return f"see {'figure' if name.endswith('.svg') else 'table'} {name.removesuffix('.svg')}"


def _show(row: Row, value: Any) -> str:
    """Write a number with the unit that a suffix of the path `ours` states; differences get a sign."""
    ends = [part.rsplit("_", 1)[-1] for part in reversed((row.ours or "").split("."))]
    unit = next((UNITS[end] for end in ends if end in UNITS), "")
    if row.rule in DIFFERENCES:
        text = show_difference(value if isinstance(value, Mapping) else {"mean": value})
        unit = "points" if unit == "%" else unit
    elif isinstance(value, tuple):
        text = "{:g} ± {:g}".format(*value)
    else:
        text = show(value) if isinstance(value, Mapping) else f"{value:.3g}"
    mean = mean_of(value)
    meaning = f" ({row.signs[mean > 0]})" if row.signs and mean else ""
    number, *uncertainty = text.split(" ", 1)
    return " ".join(filter(None, [number, unit, *uncertainty])) + meaning

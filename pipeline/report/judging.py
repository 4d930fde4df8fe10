"""How a row of the checklist is judged: a rule, the paper's number and ours -> a verdict and a sentence.

Verdicts are of `evaluation.scores`, by intervals over boards. Refuses to know which results there are.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from pipeline import statistics as inference
from pipeline.report.formatting import FEW_POINTS, gain
from pipeline.statistics import BOARDS_MIN, FEW_BOARDS, INCONCLUSIVE, NO, YES, Stat, negated
from reskin.config import Strict

NEAR = 0.10  # assumed: relative tolerance where the paper gives no sd
SIZEABLE = 0.5  # assumed: part of the paper's own difference that a sizeable one reaches, and a negligible one does not
SIGNIFICANT = 0.05  # convention: of p-values adjusted for the family of claims
PLATEAU_POINTS = 1.0  # assumed: "seems to plateau"
NOT_ASKED = "not asked in this scene"
NOT_REACHED = "not reached in this scene"
ONE_SKIN = "ours has one training skin: not comparable"
SETTING = "a setting of this scene, not a result"
TARGET = "a calibration target of the simulated spreads: agreement is no evidence"
POOLED = ("table2.multi.", "table2.triplet.", "table2.adapted.", "paired.", "contrasts.")  # networks of many skins
NONE = "–"
DIFFERENCES = ("gain", "sizeable", "slight", "plateau")  # rules about differences: shown with their sign


class Reach(Strict):
    """How far the paper looked (a constant of `reporting.paper`), and how far ours did (a path in numbers.json)."""

    paper: str
    ours: str
    of: str  # what is counted


class Row(Strict):
    """One result: where it stands in the paper, what the paper gives, and the path of ours in numbers.json."""

    id: str
    where: str
    what: str
    paper: str | None = None  # a constant of `reporting.paper`, its parts separated by dots
    says: str | None = None  # the paper's words, where it gives no number
    ours: str | None = None
    experiment: str | None = None  # the experiment that ours follows from, where a small scene may not have ours
    # gain: a paired difference is an improvement; sizeable: by half of the paper's at least; each: all of a list are
    # improvements; slight, plateau: it is small; finding:
    # judged by its experiment; view: a figure to look at; input: a setting of simulated scenes; setting: of all scenes;
    # target: where simulated, the calibration target of the spreads
    rule: Literal[
        "near", "at_most", "at_least", "positive", "gain", "sizeable", "each", "slight", "plateau", "finding", "input",
        "setting", "target", "view",
    ] = "near"  # fmt: skip
    family: bool = False  # one of the paper's claims that are tested together: p-values are adjusted by Holm's method
    reach: Reach | None = None
    only: Literal["recorded", "simulated"] | None = None  # scenes of such a source alone have the row
    stage: str | None = None
    shown: tuple[str, ...] = ()
    why: str = ""  # given where ours differs; numbers by their names in braces
    why_simulated: str = ""  # the same, for simulated scenes only


@dataclass(frozen=True)
class Verdict:
    """A sentence on ours beside the paper's, whether they differ, and for a claim the verdict on it."""

    sentence: str
    differs: bool = False
    word: str = NONE


def p_of(row: Row, printed: Any, ours: Any) -> float | None:
    """Give the p-value of a claim about differences over boards; None where too few boards were compared.

    A claim about every number of training skins holds only if it does for all: the largest p-value. One number that
    contradicts it is enough to deny it: then the smallest, by Bonferroni's correction for their number.
    """
    if isinstance(ours, Sequence):
        points = [one["accuracy_pct"] for one in ours]
        each = [p for p in (p_of(row, None, one) for one in points) if p is not None]
        if not each or len(each) < len(points):
            return None
        metric = str(row.ours).rsplit(".", 1)[-1]
        against = [p for p, one in zip(each, points, strict=True) if gain(one, metric)["mean"] < 0 and p <= SIGNIFICANT]
        return min(1.0, len(each) * min(against)) if against else max(each)
    if not isinstance(ours, Mapping) or "se" not in ours:
        return None
    limit = sizeable(mean_of(printed)) if row.rule == "sizeable" else 0.0
    better = gain(ours, str(row.ours).rsplit(".", 1)[-1])
    return inference.p_value(better["mean"] - limit, ours["se"], ours["df"])


def sizeable(printed: float | None) -> float:
    """Give the gain that counts as sizeable: a stated part of the paper's own difference."""
    assert printed is not None, "a row that is judged by the paper's difference prints one"
    return SIZEABLE * abs(printed)


def adjusted(row: Row, verdict: Verdict, p: float, family_n: int) -> Verdict:
    """Leave a claim of the family undecided unless it is significant among all of them."""
    sentence = f"{verdict.sentence}; p = {p:.2g}, adjusted for {family_n} claims"
    if verdict.word not in (YES, NO) or p <= SIGNIFICANT:
        return Verdict(sentence, verdict.differs, verdict.word)
    return Verdict(sentence, verdict.differs, INCONCLUSIVE)


def judge(row: Row, printed: Any, ours: Any, *, pooled: bool, simulated: bool) -> Verdict:
    """Judge ours against the paper's: a verdict on a claim, or the distance of two numbers."""
    if row.ours is None:
        return Verdict(NONE)
    if ours is None:
        return Verdict(NOT_ASKED)
    if not pooled and row.ours.startswith(POOLED):
        return Verdict(ONE_SKIN)
    if isinstance(ours, bool):
        return Verdict(f"{'holds' if ours else 'does not hold'} on the board that was measured", not ours, FEW_BOARDS)
    if row.rule == "setting" or (row.rule == "input" and simulated):
        return Verdict(SETTING)
    return _judge_by_rule(row, printed, ours, simulated=simulated)


def _judge_by_rule(row: Row, printed: Any, ours: Any, *, simulated: bool) -> Verdict:
    path = str(row.ours)
    match row.rule:
        case "view":
            return Verdict(NONE)
        case "gain" | "sizeable" | "slight" | "plateau":
            return _judge_difference(row.rule, path, mean_of(printed), ours)
        case "at_most" | "at_least" | "positive":
            limit = 0.0 if row.rule == "positive" else mean_of(printed)
            assert limit is not None, "a row that is judged by a limit prints one"
            return _judge_limit(row.rule, limit, ours if isinstance(ours, Mapping) else {"mean": float(ours)})
        case "each":
            return _judge_each(ours)
        case "finding":
            reason = f". {ours['why'].rstrip('.')}" if "why" in ours else ""
            sentence = f"over these trainings: {ours['of_trainings']}{reason}"
            return Verdict(sentence, ours["verdict"] == NO, ours["verdict"])
        case _:
            return _judge_number(path, printed, ours, target=row.rule == "target" and simulated)


def mean_of(value: Any) -> float | None:
    """Give the mean of a summary or of the paper's pair, or a plain number; None where there is none."""
    if isinstance(value, Mapping):
        return value.get("mean")
    if isinstance(value, tuple):
        return float(value[0])
    return float(value) if isinstance(value, int | float) else None


def _judge_difference(rule: str, path: str, printed: float | None, ours: Stat) -> Verdict:
    """Judge a paired difference by its interval, and say whether the interval includes the paper's difference."""
    better = gain(ours, path.rsplit(".", 1)[-1])
    if rule in ("gain", "sizeable"):
        limit = sizeable(printed) if rule == "sizeable" else 0.0
        what = f"half of the paper's difference, {limit:.3g}" if rule == "sizeable" else "0"
        word = inference.verdict(better, above=limit)
        words = {YES: f"lies beyond {what}, on the claimed side", NO: f"lies short of {what}",
                 INCONCLUSIVE: f"includes {what}"}  # fmt: skip
        alone = f"; ours is {'beyond' if better['mean'] > limit else 'short of'} {what}"
    else:
        limit = FEW_POINTS if rule == "slight" else PLATEAU_POINTS
        word = inference.verdict_within(ours, limit)
        words = {YES: "is within", NO: "is beyond", INCONCLUSIVE: "includes a limit of"}
        words = {key: f"{text} ±{limit:g} points" for key, text in words.items()}
        alone = ""
    sentence = f"fewer than {BOARDS_MIN} boards: no interval{alone}"
    if word != FEW_BOARDS:
        sentence = f"{_interval(ours)} {words[word]}{_negligible(better, printed) if rule != 'slight' else ''}"
    return Verdict(sentence + _including(ours, printed), word == NO, word)


def _negligible(better: Stat, printed: float | None) -> str:
    """Say that a gain is smaller than half of the paper's, by equivalence: the whole interval is."""
    if not printed:
        return ""
    low, high = better["ci95"]
    return "; equivalent to none within half of the paper's" if max(-low, high) < sizeable(printed) else ""


def _judge_limit(rule: str, limit: float, ours: Stat) -> Verdict:
    """Judge whether a number is beyond a limit (the paper's, or 0)."""
    at_most = rule == "at_most"
    word = inference.verdict(negated(ours), above=-limit) if at_most else inference.verdict(ours, above=limit)
    mean = ours["mean"]
    holds = {"at_most": mean <= limit, "at_least": mean >= limit, "positive": mean > 0}[rule]
    words = "above 0" if rule == "positive" else f"{rule.replace('_', ' ')} {limit:g}"
    sentence = f"ours is {'' if holds else 'not '}{words}"
    if word == INCONCLUSIVE:
        sentence += f"; {_interval(ours)} includes {limit:g}"
    return Verdict(sentence, not holds, word)


def _judge_each(contrasts: Sequence[Mapping[str, Any]]) -> Verdict:
    """Judge a claim that is to hold at every number of training skins, by accuracy."""
    words = {row["skins_n"]: inference.verdict(row["accuracy_pct"]) for row in contrasts}
    counts = {word: ", ".join(str(n) for n in words if words[n] == word) for word in words.values()}
    sentence = "; ".join(f"{word} with {ns}" for word, ns in counts.items()) + " training skins"
    word = inference.all_of(list(words.values()))
    return Verdict(sentence, word == NO, word)


def _judge_number(path: str, printed: Any, ours: Any, *, target: bool) -> Verdict:
    """Say how far our number is from the paper's, and whether the simulation was calibrated by it."""
    value, mean = mean_of(ours), mean_of(printed)
    if value is None or mean is None:
        return Verdict(NONE)
    tolerance = printed[1] if isinstance(printed, tuple) else NEAR * abs(mean)
    near = abs(value - mean) <= tolerance
    sentence = "the same"
    if value != mean:
        yard = "one sd of the paper's" if isinstance(printed, tuple) else f"{100 * NEAR:g} % of the paper's"
        sentence = f"ours is {_distance(path, value, mean)}; {'within' if near else 'outside'} {yard}"
    sentence += _including(ours, mean)
    return Verdict(f"{TARGET}; {sentence}") if target else Verdict(sentence, not near)


def _distance(path: str, ours: float, printed: float) -> str:
    """Write how far ours is from the paper's: in points of accuracy, else relative; of scores whether it is better."""
    accuracy, gap = "accuracy" in path, ours - printed
    side = "higher" if gap > 0 else "lower"
    if accuracy:
        size = f"{abs(gap):.2g} points {side}"
    elif ours >= 2 * printed:
        size = f"{ours / printed:{'.2g' if ours < 100 * printed else '.0f'}} times the paper's"
    else:
        size = f"{100 * abs(gap / printed):.2g} % {side}"
    better = (gap > 0) == accuracy
    return size + (f" ({'better' if better else 'worse'})" if accuracy or ".mse_" in f".{path}" else "")


def _including(ours: Any, printed: float | None) -> str:
    """Say whether our interval over boards includes the paper's number, where there is one."""
    if printed is None or not isinstance(ours, Mapping) or "ci95" not in ours:
        return ""
    low, high = ours["ci95"]
    return f"; our 95 % interval {'includes' if low <= printed <= high else 'excludes'} the paper's"


def _interval(stat: Stat) -> str:
    return f"the 95 % interval over {stat['n']} boards"

"""How one row of the checklist is judged: a rule, the paper's number, ours -> a verdict and a sentence.

Verdicts are of `evaluation.scores`, by intervals over boards. Refuses to know which results there are.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from pipeline.core.config import Strict
from pipeline.evaluation.scores import (
    INCONCLUSIVE,
    NO,
    ONE_BOARD,
    YES,
    Stat,
    all_of,
    negated,
    verdict,
    verdict_within,
)  # fmt: skip
from pipeline.reporting.order import FEW_POINTS, gain

NEAR = 0.10  # assumed: how far ours may be where the paper gives no sd
PLATEAU_POINTS = 1.0  # assumed: "seems to plateau"
NOT_ASKED = "not asked in this scene"
NOT_REACHED = "not reached in this scene"
ONE_SKIN = "ours learnt from one skin only: not the same question"
INPUT = "an input of the simulated rig, read back from the captures"
SETTING = "a setting of this scene, no result"
TARGET = "a calibration target of the simulated spreads: agreement is no evidence"
POOLED = ("table2.multi.", "table2.triplet.", "table2.adapted.", "paired.", "contrasts.")
NO_VERDICT = "–"
DIFFERENCES = ("gain", "slight", "plateau")  # rules about differences: shown with their sign


class Reach(Strict):
    """How far in the paper had gone when it looked, and the path of how far in ours had."""

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
    asked: str | None = None  # a path that is there where the question was asked, though ours may not reach so far
    # gain: a paired difference is an improvement; each: all of a list are; slight, plateau: it is small; finding:
    # judged where it was found; view: a figure is to be looked at; input: where simulated, a setting that came back
    # over the wire; setting: of the scene; target: where simulated, what the spreads were set by
    rule: Literal[
        "near", "at_most", "at_least", "positive", "gain", "each", "slight", "plateau", "finding", "input", "setting",
        "target", "view",
    ] = "near"  # fmt: skip
    reach: Reach | None = None
    stage: str | None = None
    shown: tuple[str, ...] = ()
    why: str = ""  # said only where ours differs; numbers by their names in braces
    simulated_only: bool = False  # the reason is about simulation: recorded scenes have none


@dataclass(frozen=True)
class Verdict:
    """One sentence about ours beside the paper's; `differs` is None where there is nothing to compare."""

    sentence: str
    differs: bool | None = None
    word: str = NO_VERDICT


def judge(row: Row, printed: Any, ours: Any, *, pooled: bool, simulated: bool) -> Verdict:
    """Say how ours stands to the paper's: a verdict on a claim, or the distance of two numbers."""
    if row.ours is None:
        return Verdict("–")
    if ours is None:
        return Verdict(NOT_ASKED)
    if not pooled and row.ours.startswith(POOLED):
        return Verdict(ONE_SKIN)
    if isinstance(ours, bool):
        return Verdict(f"{'holds' if ours else 'does not hold'} on the one that was measured", not ours, ONE_BOARD)
    return _read_back(row, simulated) or _JUDGED_BY[row.rule](row, printed, ours, simulated)


def _read_back(row: Row, simulated: bool) -> Verdict | None:
    """Tell what is no result: a setting, and what a simulated rig was given."""
    if row.rule == "setting":
        return Verdict(SETTING, False)
    return Verdict(INPUT, False) if row.rule == "input" and simulated else None


def mean_of(value: Any) -> float | None:
    """Give the mean of a summary or of the paper's pair, or a plain number; None where there is none."""
    if isinstance(value, Mapping):
        return value.get("mean")
    if isinstance(value, tuple):
        return float(value[0])
    return float(value) if isinstance(value, int | float) else None


def _judge_difference(row: Row, printed: Any, ours: Stat, _: bool) -> Verdict:
    """Judge a paired difference by its interval over boards, and say whether the paper's difference is inside it."""
    if row.rule == "gain":
        word = verdict(gain(ours, str(row.ours).rsplit(".", 1)[-1]))
        side = {YES: "is wholly on the claim's side of 0", NO: "is wholly on the other side of 0"}
        said = side.get(word, "includes 0")
    else:
        limit = FEW_POINTS if row.rule == "slight" else PLATEAU_POINTS
        word = verdict_within(ours, limit)
        side = {YES: f"is within ±{limit:g} points", NO: f"is beyond ±{limit:g} points"}
        said = side.get(word, f"includes a limit of ±{limit:g} points")
    sentence = f"one board: no interval{_way(row, ours)}" if word == ONE_BOARD else f"{_interval(ours)} {said}"
    return Verdict(sentence + _inside(ours, mean_of(printed)), word == NO, word)


def _judge_limit(row: Row, printed: Any, ours: Any, _: bool) -> Verdict:
    """Judge whether a number is beyond a limit; one that has no interval over boards says so of its one board."""
    stat: Stat = ours if isinstance(ours, Mapping) else {"mean": float(ours)}
    limit = 0.0 if row.rule == "positive" else _printed(printed)
    word = verdict(negated(stat), above=-limit) if row.rule == "at_most" else verdict(stat, above=limit)
    at_limit = row.rule != "positive" and stat["mean"] == limit
    beyond = stat["mean"] < limit if row.rule == "at_most" else stat["mean"] > limit
    words = {"at_most": f"at most {limit:g}", "at_least": f"at least {limit:g}", "positive": "above 0"}[row.rule]
    sentence = f"ours is {'' if beyond or at_limit else 'not '}{words}"
    if word == INCONCLUSIVE:
        sentence += f"; {_interval(stat)} includes {limit:g}"
    return Verdict(sentence, not (beyond or at_limit), word)


def _printed(printed: Any) -> float:
    value = mean_of(printed)
    assert value is not None, "a row that is judged by a limit prints one"
    return value


def _judge_each(_: Row, __: Any, contrasts: Sequence[Mapping[str, Any]], ___: bool) -> Verdict:
    """Judge a claim that is to hold at every number of training skins, by accuracy."""
    words = {one["skins_n"]: verdict(one["accuracy_pct"]) for one in contrasts}
    by_word = {word: [str(n) for n, own in words.items() if own == word] for word in dict.fromkeys(words.values())}
    sentence = "; ".join(f"{word} with {', '.join(counts)}" for word, counts in by_word.items()) + " training skins"
    judged = all_of(list(words.values()))
    return Verdict(sentence, judged == NO, judged)


def _judge_finding(_: Row, __: Any, found: Mapping[str, Any], ___: bool) -> Verdict:
    """Pass on what was judged where it was found, over boards and over trainings on these boards."""
    sentence = f"of these trainings: {found['of_trainings']}"
    sentence += f". {found['why'].rstrip('.')}" if "why" in found else ""
    return Verdict(sentence, found["verdict"] == NO, found["verdict"])


def _judge_number(row: Row, printed: Any, ours: Any, simulated: bool) -> Verdict:
    """Say how far our number is from the paper's, and whether it was set by it."""
    value = mean_of(ours)
    if value is None or printed is None:
        return Verdict("–")
    near = _judge_near(value, printed, str(row.ours))
    sentence = near.sentence + _inside(ours, mean_of(printed))
    if row.rule == "target" and simulated:
        return Verdict(f"{TARGET}; {sentence}", False)
    return Verdict(sentence, near.differs)


def _judge_near(ours: float, printed: Any, path: str) -> Verdict:
    mean, sd = printed if isinstance(printed, tuple) else (printed, None)
    gap = ours - mean
    reach = NEAR * abs(mean) if sd is None else sd
    side = "higher" if gap > 0 else "lower"
    percent = "accuracy" in path
    size = f"{abs(gap):.2g} points {side}" if percent else f"{100 * abs(gap / mean):.2g} % {side}"
    if not percent and ours >= 2 * mean:
        size = f"{ours / mean:{'.2g' if ours < 100 * mean else '.0f'}} times the paper's"
    good = {True: " (better)", False: " (worse)"}
    word = good[(gap > 0) == percent] if percent or ".mse_" in f".{path}" else ""
    within = "within" if abs(gap) <= reach else "outside"
    yard = f"{100 * NEAR:g} % of the paper's" if sd is None else "one sd of the paper's"
    if gap == 0:
        return Verdict("the same", False)
    return Verdict(f"ours is {size}{word}; {within} {yard}", within == "outside")


def _inside(ours: Any, printed: float | None) -> str:
    """Say whether the paper's number lies in our interval over boards, where there is one."""
    if printed is None or not isinstance(ours, Mapping) or "ci95" not in ours:
        return ""
    low, high = ours["ci95"]
    return f"; the paper's {'is inside' if low <= printed <= high else 'is outside'} our 95 % interval"


def _interval(stat: Stat) -> str:
    return f"the 95 % interval over {stat['n']} boards"


def _way(row: Row, ours: Stat) -> str:
    if row.rule != "gain":
        return ""
    better = gain(ours, str(row.ours).rsplit(".", 1)[-1])["mean"] > 0
    return f"; ours is {'on the claim' if better else 'not on the claim'}'s side of 0"


_JUDGED_BY: dict[str, Callable[[Row, Any, Any, bool], Verdict]] = {
    **dict.fromkeys(("near", "input", "target"), _judge_number),
    **dict.fromkeys(("at_most", "at_least", "positive"), _judge_limit),
    **dict.fromkeys(DIFFERENCES, _judge_difference),
    "each": _judge_each,
    "finding": _judge_finding,
    "view": lambda *_: Verdict("–"),
}

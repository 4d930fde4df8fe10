"""The checklist: each figure, table and numbered result of the paper beside ours. In: numbers.json. Out: one table.

Which results there are is data, `checklist.yaml`; the paper's numbers are constants of `reporting.paper`. Refuses to
know how ours were found.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import pandas as pd

from pipeline.errors import SchemaError, complain
from pipeline.reporting import paper
from pipeline.reporting.order import is_pooled
from pipeline.reporting.shown import show
from pipeline.strict import Strict, parse, read_yaml

FILE = Path(__file__).with_name("checklist.yaml")
NEAR = 0.10  # assumed: how far ours may be where the paper gives no sd
UNITS = {"pct": "%", "mm2": "mm²", "N2": "N²", "mm": "mm", "N": "N", "hz": "Hz"}
NOT_ASKED = "not asked in this scene"
ONE_SKIN = "ours learnt from one skin only: not the same question"
POOLED = ("table2.multi.", "table2.triplet.", "table2.adapted.")
MEANING = (
    f"A result differs where it is outside the paper's sd, or by more than {100 * NEAR:g} % where the paper gives "
    "none; within it, nothing is claimed about why. Reasons are guesses: no run measured them. Where no number can be "
    "compared, the file named last shows ours."
)
INPUT = "an input of the simulated rig, read back from the captures"
NAMED = re.compile(r"\{([\w.]+)\}")  # a number that a reason names: a constant of the paper, or a path of ours


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
    # view: a figure is to be looked at; input: where simulated, a setting that came back over the wire
    rule: Literal["near", "at_most", "at_least", "positive", "plateau", "input", "view"] = "near"
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


def read_rows() -> list[Row]:
    """Read the rows of the checklist, in the paper's order."""
    return [parse(Row, row, f"{FILE.name}, row {i}") for i, row in enumerate(read_yaml(FILE))]


def checklist(numbers: Mapping[str, Any], rows: Sequence[Row] | None = None) -> pd.DataFrame:
    """Put every result of the paper beside ours, with a sentence on how they differ."""
    source = numbers["provenance"]["source"]
    lines = []
    for row in read_rows() if rows is None else rows:
        printed = constant(row.paper) if row.paper else None
        found = resolve(numbers, row.ours) if row.ours else None
        verdict = judge(row, printed, found, pooled=is_pooled(numbers), simulated=source == "simulated")
        if row.reach and verdict.sentence != NOT_ASKED:
            verdict = _after(verdict, row.reach, numbers)
        lines.append(
            {
                "in the paper": row.where,
                "result": row.what,
                "paper": row.says if printed is None else _shown(printed, row.ours),
                "ours": _ours(row, found),
                "difference": _with_reason(verdict, row, numbers),
                "stage": row.stage or "–",
                "shown in": ", ".join(row.shown) if row.shown and (found is not None or not row.ours) else "–",
                "source": source,
            }
        )
    table = pd.DataFrame(lines)
    table.attrs["meaning"] = MEANING
    return table


def resolve(numbers: Any, path: str) -> Any:
    """Follow a dotted path; `name=3` picks that row of a list. None where the scene has no such number."""
    here = numbers
    for part in path.split("."):
        if isinstance(here, list) and "=" in part:
            name, _, wanted = part.partition("=")
            here = next((row for row in here if str(row[name]) == wanted), None)
        elif isinstance(here, Mapping) and part in here:
            here = here[part]
        else:
            return None
    return here


def constant(path: str) -> Any:
    """Find a constant of `reporting.paper` by its dotted name."""
    name, *parts = path.split(".")
    here = getattr(paper, name, None)
    for part in parts:
        here = here.get(part) if isinstance(here, Mapping) else None
    if here is None:
        raise SchemaError(complain(FILE.name, "paper", "a constant of reporting.paper", path, "Mend the name."))
    return here


def judge(row: Row, printed: Any, ours: Any, *, pooled: bool, simulated: bool) -> Verdict:
    """Say in one sentence how ours stands to the paper's."""
    if row.ours is None:
        return Verdict("–")
    if ours is None:
        return Verdict(NOT_ASKED)
    if not pooled and row.ours.startswith(POOLED):
        return Verdict(ONE_SKIN)
    if row.rule == "input" and simulated:
        return Verdict(INPUT, False)
    if row.rule == "plateau":
        return Verdict(_plateau(ours, printed))
    if isinstance(ours, bool):
        return Verdict("holds" if ours else "does not hold", not ours)
    return _judge_findings(ours) if _is_findings(ours) else _judge_number(row, printed, ours)


def _judge_number(row: Row, printed: Any, ours: Any) -> Verdict:
    value = _mean(ours)
    if row.rule == "view" or value is None or (printed is None and row.rule != "positive"):
        return Verdict("–")
    if row.rule in ("near", "input"):
        near = _judge_near(value, printed, str(row.ours))
        return replace(near, sentence=near.sentence + _own_spread(ours, printed))
    limit = 0.0 if row.rule == "positive" else float(_mean(printed) or 0.0)
    holds = value <= limit if row.rule == "at_most" else value >= limit if row.rule == "at_least" else value > 0
    words = {"at_most": f"at most {limit:g}", "at_least": f"at least {limit:g}", "positive": "above 0"}[row.rule]
    return Verdict(f"{'holds' if holds else 'does not hold'}: ours is {'' if holds else 'not '}{words}", not holds)


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


def _own_spread(ours: Any, printed: Any) -> str:
    """Where only ours has an sd, say whether the paper's number is within it too."""
    if isinstance(printed, tuple) or not isinstance(ours, Mapping) or "sd" not in ours:
        return ""
    side = "within" if abs(ours["mean"] - printed) <= ours["sd"] else "outside"
    return f"; {side} one sd of ours (n = {ours['n']:g})"


def _plateau(points: Sequence[Mapping[str, Any]], printed: int) -> str:
    """Give the accuracy without pokes, with the paper's pass of them, where it sees a plateau, and at our last."""
    at = {point["pokes_n"]: point["accuracy_pct"]["mean"] for point in points}
    shown = [pokes_n for pokes_n in sorted(at) if pokes_n in {0, paper.ADAPTED_POKES_N, printed, max(at)}]
    said = ", ".join(f"{at[pokes_n]:.3g} % at {pokes_n}" for pokes_n in shown)
    gains = ", ".join(f"{at[b] - at[a]:+.2g} points from {a} to {b}" for a, b in pairwise(shown))
    missed = "" if max(at) >= printed else f"not reached: ours up to {max(at)} pokes; "
    return f"{missed}accuracy is {said} pokes" + (f": {gains}" if gains else "")


def _after(verdict: Verdict, reach: Reach, numbers: Mapping[str, Any]) -> Verdict:
    """Say first how far in ours was looked at, and whether that is as far as in the paper."""
    ours_n, paper_n = resolve(numbers, reach.ours), constant(reach.paper)
    missed = "" if ours_n >= paper_n else "not reached: ours "
    return replace(verdict, sentence=f"{missed}after {ours_n:,.0f} {reach.of}; {verdict.sentence}")


def _with_reason(verdict: Verdict, row: Row, numbers: Mapping[str, Any]) -> str:
    said = not row.simulated_only or numbers["provenance"]["source"] == "simulated"
    if not (verdict.differs and row.why and said):
        return verdict.sentence

    def number(name: re.Match[str]) -> str:
        own = constant(name[1]) if name[1][0].isupper() else resolve(numbers, name[1])
        return f"{own:.3g}"

    return f"{verdict.sentence}. {NAMED.sub(number, row.why)}"


def _judge_findings(found: Sequence[Mapping[str, Any]]) -> Verdict:
    missing = [
        f"not here: {one['finding']} ({one['why'].rstrip('.')})" for one in found if not one["holds"]
    ]  # what holds has no why
    return Verdict("; ".join([f"{len(found) - len(missing)} of {len(found)} hold", *missing]), bool(missing))


def _is_findings(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and all("holds" in one and "finding" in one for one in value)


def _mean(value: Any) -> float | None:
    if isinstance(value, Mapping):
        return value.get("mean")
    if isinstance(value, tuple):
        return float(value[0])
    return float(value) if isinstance(value, int | float) else None


def _ours(row: Row, found: Any) -> str:
    if found is None:
        return "see file" if row.shown and not row.ours else "–"
    if isinstance(found, bool):
        return "yes" if found else "no"
    if isinstance(found, int):
        return str(found)
    return "see file" if _mean(found) is None else _shown(found, row.ours)


def _shown(value: Any, path: str | None) -> str:
    """Write a number with the unit that a name in its path says."""
    ends = [part.rsplit("_", 1)[-1] for part in reversed((path or "").split("."))]
    unit = next((UNITS[end] for end in ends if end in UNITS), "")
    if isinstance(value, tuple):
        text = "{:g} ± {:g}".format(*value)
    elif isinstance(value, Mapping):
        text = show(value)
    else:
        text = f"{value:.4g}"
    return f"{text} {unit}".strip()

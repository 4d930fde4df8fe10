"""The checklist: each figure, table and numbered result of the paper beside ours. In: numbers.json. Out: one table.

Which results there are is data, `checklist.yaml`; the paper's numbers are constants of `reporting.paper`. Refuses to
know how ours were found.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd

from pipeline.core.config import parse, read_yaml
from pipeline.core.errors import SchemaError
from pipeline.evaluation.scores import VERDICTS
from pipeline.reporting import paper
from pipeline.reporting.judging import (
    DIFFERENCES,
    NEAR,
    NOT_REACHED,
    PLATEAU_POINTS,
    Row,
    Verdict,
    judge,
    mean_of,
)  # fmt: skip
from pipeline.reporting.order import FEW_POINTS, is_pooled
from pipeline.reporting.shown import show, show_difference

FILE = Path(__file__).with_name("checklist.yaml")
UNITS = {"pct": "%", "mm2": "mm²", "N2": "N²", "mm": "mm", "N": "N", "hz": "Hz"}
MEANING = (
    f"Verdicts are about claims. {VERDICTS} Numbers beside numbers have no verdict: a number differs where it is "
    f"outside the paper's sd, or by more than {100 * NEAR:g} % where the paper gives none; within it, nothing is "
    f"claimed about why. Slightly: less than {FEW_POINTS:g} points of accuracy up or down; a plateau: less than "
    f"{PLATEAU_POINTS:g}. Reasons are guesses: no run measured them. Where no number can be compared, the file named "
    "last shows ours."
)
NAMED = re.compile(r"\{([\w.]+)\}")  # a number that a reason names: a constant of the paper, or a path of ours


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
        if found is None and row.asked and resolve(numbers, row.asked) is not None:
            verdict = Verdict(NOT_REACHED)
        if row.reach and found is not None:
            verdict = _after(verdict, row, numbers)
        lines.append(
            {
                "in the paper": row.where,
                "result": row.what,
                "paper": row.says if printed is None else _shown(row, printed),
                "ours": _ours(row, found),
                "verdict": verdict.word,
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
    """Follow a dotted path; `name=3,other=x` picks that row of a list. None where the scene has no such number."""
    here = numbers
    for part in path.split("."):
        if isinstance(here, list) and "=" in part:
            wanted = dict(one.split("=", 1) for one in part.split(","))
            here = next(
                (row for row in here if {name: str(row[name]) for name in wanted if name in row} == wanted), None
            )
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
        raise SchemaError(FILE.name, "paper", "a constant of reporting.paper", path, "Mend the name.")
    return here


def _after(verdict: Verdict, row: Row, numbers: Mapping[str, Any]) -> Verdict:
    """Say first how far in ours was looked at, and whether that is as far as in the paper."""
    assert row.reach is not None
    ours_n, paper_n = resolve(numbers, row.reach.ours), constant(row.reach.paper)
    missed = "" if ours_n >= paper_n else "not reached: ours "
    return replace(verdict, sentence=f"{missed}after {ours_n:,.0f} {row.reach.of}; {verdict.sentence}")


def _with_reason(verdict: Verdict, row: Row, numbers: Mapping[str, Any]) -> str:
    said = not row.simulated_only or numbers["provenance"]["source"] == "simulated"
    if not (verdict.differs and row.why and said):
        return verdict.sentence

    def number(name: re.Match[str]) -> str:
        own = constant(name[1]) if name[1][0].isupper() else resolve(numbers, name[1])
        return f"{own:.3g}"

    return f"{verdict.sentence}. {NAMED.sub(number, row.why)}"


def _ours(row: Row, found: Any) -> str:
    if found is None:
        return "see file" if row.shown and not row.ours else "–"
    if isinstance(found, bool):
        return "yes" if found else "no"
    if isinstance(found, int):
        return str(found)
    return "see file" if mean_of(found) is None else _shown(row, found)


def _shown(row: Row, value: Any) -> str:
    """Write a number with the unit that a name in the path of ours says; differences with their sign."""
    ends = [part.rsplit("_", 1)[-1] for part in reversed((row.ours or "").split("."))]
    unit = next((UNITS[end] for end in ends if end in UNITS), "")
    if row.rule in DIFFERENCES:
        unit = "points" if unit == "%" else unit
        return f"{show_difference(value if isinstance(value, Mapping) else {'mean': value})} {unit}".strip()
    if isinstance(value, tuple):
        text = "{:g} ± {:g}".format(*value)
    else:
        text = show(value) if isinstance(value, Mapping) else f"{value:.4g}"
    return f"{text} {unit}".strip()

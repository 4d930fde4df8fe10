"""The checklist: each figure, table and numbered result of the paper beside ours. In: numbers.json. Out: one table.

Its rows are data, `checklist.yaml` and the YAML file of each experiment; the paper's numbers are constants of
`reporting.paper`. Refuses to know how ours were computed.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd

from pipeline.report import judging, paper
from pipeline.report.formatting import FEW_POINTS, is_pooled, show, show_difference
from pipeline.report.judging import NONE, Row, Verdict, adjusted, judge, mean_of, p_of
from pipeline.report.parts import add_rows
from pipeline.statistics import VERDICTS, holm
from reskin.config import parse, read_yaml
from reskin.errors import SchemaError

FILE = Path(__file__).with_name("checklist.yaml")
METRICS = {
    "accuracy_pct": "accuracy", "mse_xy_mm2": "MSE of the place", "mse_f_N2": "MSE of the force",
    "mse_fxy_N2": "MSE of the shear force", "mse_fz_N2": "MSE of the normal force",
}  # fmt: skip
UNITS = {"pct": "%", "mm2": "mm²", "N2": "N²", "mm": "mm", "N": "N", "hz": "Hz"}
CLAIM = "claim: "
FAMILY = (
    "The claims of section 5 about accuracy, the primary score, are one family, listed before any run (checklist.yaml, "
    "family): their p-values (t over boards) are adjusted by Holm's method, and a claim is supported or contradicted "
    f"only if its adjusted p is {judging.SIGNIFICANT:g} or less. All other verdicts are unadjusted: exploratory. "
    f"Sizeable: at least {100 * judging.SIZEABLE:g} % of the paper's own difference; equivalent to none: the whole "
    "interval is nearer to 0 than that."
)
MEANING = (
    f"Verdicts are on claims. {VERDICTS} {FAMILY} Pairs of numbers have no verdict: a number differs where it is "
    f"outside the paper's sd, or by more than {100 * judging.NEAR:g} % where the paper gives none. Slightly: less than "
    f"{FEW_POINTS:g} points of accuracy up or down; a plateau: less than {judging.PLATEAU_POINTS:g}. Reasons are "
    "assumed: no run tested them. Where there is no number to compare, see the file named last."
)
NAMED = re.compile(r"\{([\w.]+)\}")  # a number that a reason names


def read_rows() -> list[Row]:
    """Read the rows of the checklist, in the paper's order."""
    entries = add_rows(read_yaml(FILE))
    return [parse(Row, row, f"checklist, row {row['id']}") for entry in entries for row in _by_metric(entry)]


def checklist(numbers: Mapping[str, Any], rows: Sequence[Row] | None = None) -> pd.DataFrame:
    """Put every result of the paper beside ours, with a sentence on how they differ."""
    source = numbers["provenance"]["source"]
    lines = []
    asked = [row for row in (read_rows() if rows is None else rows) if row.only in (None, source)]
    p_values = family_p(numbers, asked)
    for row in asked:
        printed, ours = _both(numbers, row)
        verdict = judge(row, printed, ours, pooled=is_pooled(numbers), simulated=source == "simulated")
        if row.id in p_values:
            verdict = adjusted(row, verdict, p_values[row.id], len(p_values))
        if ours is None and row.experiment in numbers:
            verdict = Verdict(judging.NOT_REACHED)
        lines.append(
            {
                "in the paper": row.where,
                "result": row.what,
                "paper": row.says if printed is None else _write(row, printed),
                "ours": _write_ours(row, ours),
                "verdict": verdict.word,
                "difference": _explain(verdict if ours is None else _after(verdict, row, numbers), row, numbers),
                "stage": row.stage or NONE,
                "shown in": ", ".join(row.shown) if row.shown and (ours is not None or not row.ours) else NONE,
                "source": source,
            }
        )
    table = pd.DataFrame(lines)
    table.attrs["meaning"] = MEANING
    return table


def claims_table(table: pd.DataFrame) -> pd.DataFrame:
    """Take of a checklist the paper's claims that are judged, with their verdicts."""
    judged = table["result"].str.startswith(CLAIM) & (table["verdict"] != NONE)
    claims = table[judged].drop(columns=["stage", "shown in"])
    claims = claims.assign(result=claims["result"].str.removeprefix(CLAIM)).rename(columns={"result": "claim"})
    claims.attrs["meaning"] = f"{VERDICTS} {FAMILY}"
    return claims


def family_p(numbers: Mapping[str, Any], rows: Sequence[Row]) -> dict[str, float]:
    """Give the p-values of the claims that are tested together, by row, adjusted for their number."""
    found = {row.id: p_of(row, *_both(numbers, row)) for row in rows if row.family}
    return holm({name: p for name, p in found.items() if p is not None})


def _both(numbers: Mapping[str, Any], row: Row) -> tuple[Any, Any]:
    """Find the paper's number and ours."""
    printed = look_up(numbers, row.paper) if row.paper else None
    return printed, resolve(numbers, row.ours) if row.ours else None


def resolve(numbers: Any, path: str) -> Any:
    """Follow a dotted path; `name=3,other=x` picks that row of a list. None where the scene has no such number."""
    here = numbers
    for part in path.split("."):
        if isinstance(here, list) and "=" in part:
            wanted = dict(pair.split("=", 1) for pair in part.split(","))
            here = next((row for row in here if wanted.items() <= {key: str(row[key]) for key in row}.items()), None)
        elif isinstance(here, Mapping) and part in here:
            here = here[part]
        else:
            return None
    return here


def look_up(numbers: Mapping[str, Any], name: str) -> Any:
    """Find a number by its dotted name: a constant of `reporting.paper` (`SHEAR.mse_fz_N2`), or one of ours."""
    found = resolve(vars(paper) if name[0].isupper() else numbers, name)
    if found is None:
        rule = "a constant of reporting.paper, or a path in numbers.json"
        raise SchemaError(FILE.name, "a number", rule, name, "Mend the name.")
    return found


def _by_metric(entry: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """Make a row for each metric that an entry of the file lists; an entry without metrics is one row."""
    row = dict(entry)
    metrics = row.pop("metrics", None)
    if metrics is None:
        yield row
    for metric in metrics or ():
        paths = {side: f"{row[side]}.{metric}" for side in ("paper", "ours")}
        yield row | paths | {"id": f"{row['id']}-{metric}", "what": f"{row['what']}: {METRICS[metric]}"}


def _after(verdict: Verdict, row: Row, numbers: Mapping[str, Any]) -> Verdict:
    """Say first how far ours looked, and whether that is as far as the paper did."""
    if row.reach is None:
        return verdict
    ours_n, paper_n = resolve(numbers, row.reach.ours), look_up(numbers, row.reach.paper)
    missed = "" if ours_n >= paper_n else "not reached: ours "
    return replace(verdict, sentence=f"{missed}after {ours_n:,.0f} {row.reach.of}; {verdict.sentence}")


def _explain(verdict: Verdict, row: Row, numbers: Mapping[str, Any]) -> str:
    why = row.why or (row.why_simulated if numbers["provenance"]["source"] == "simulated" else "")
    if not (verdict.differs and why):
        return verdict.sentence
    return f"{verdict.sentence}. {NAMED.sub(lambda name: f'{look_up(numbers, name[1]):.3g}', why)}"


def _write_ours(row: Row, ours: Any) -> str:
    if ours is None:
        return "see file" if row.shown and not row.ours else NONE
    if isinstance(ours, bool):
        return "yes" if ours else "no"
    if isinstance(ours, int):
        return str(ours)
    return "see file" if mean_of(ours) is None else _write(row, ours)


def _write(row: Row, value: Any) -> str:
    """Write a number with the unit of the last name with one in the path of ours; differences with their sign."""
    ends = [part.rsplit("_", 1)[-1] for part in reversed((row.ours or "").split("."))]
    unit = next((UNITS[end] for end in ends if end in UNITS), "")
    if row.rule in judging.DIFFERENCES:
        text = show_difference(value if isinstance(value, Mapping) else {"mean": value})
        unit = "points" if unit == "%" else unit
    elif isinstance(value, tuple):
        text = "{:g} ± {:g}".format(*value)
    else:
        text = show(value) if isinstance(value, Mapping) else f"{value:.4g}"
    return f"{text} {unit}".strip()

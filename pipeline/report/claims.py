"""Verdicts on the claims of the paper, which `claims.yaml` lists with the rule that decides each of them.

A claim says that a number of the report lies in a range, for example that a gain is above 0. If the number is a mean
over at least four boards, Student's t tests whether it lies on the nearest end of this range. The p-values of the
claims of a family are adjusted by Holm's method. If the adjusted p-value is at most 0.05, the claim is supported or
contradicted, depending on whether the number is in the range. Otherwise the result is inconclusive.
"""

from collections.abc import Mapping, Sequence
from math import inf, nan
from pathlib import Path
from typing import Any, Literal

import pandas as pd
from pydantic import model_validator

from pipeline import paper
from pipeline.formatting import show, show_difference, three_digits
from pipeline.statistics import Stat, holm, p_value_of
from reskin.config import Strict, parse, read_yaml
from reskin.errors import SchemaError

FILE = Path(__file__).with_name("claims.yaml")
SUPPORTED, CONTRADICTED, INCONCLUSIVE = "supported", "contradicted", "inconclusive"
NOT_TESTABLE, NOT_RUN = "not testable here", "not run"
SIGNIFICANT = 0.05  # convention
METRICS = {
    "accuracy_pct": "accuracy", "mse_xy_mm2": "MSE of the position", "mse_f_N2": "MSE of the force",
    "mse_fxy_N2": "MSE of the shear force", "mse_fz_N2": "MSE of the normal force",
}  # fmt: skip
Metric = Literal["accuracy_pct", "mse_xy_mm2", "mse_f_N2", "mse_fxy_N2", "mse_fz_N2"]
UNITS = {"pct": "%", "mm2": "mm²", "N2": "N²", "mm": "mm", "N": "N", "hz": "Hz", "mL": "mL"}
DIFFERENCES = {"gain_above", "loss_above", "gain_of_paper", "within"}  # rules for differences
Rule = Literal["gain_above", "loss_above", "gain_of_paper", "within", "at_least", "at_most", "near"]


class Claim(Strict):
    """A claim of the paper and the rule that decides it; `claims.yaml` explains each key."""

    id: str
    quote: str
    where: str
    tested: str = ""
    paper: str | None = None
    ours: str | None = None
    metrics: tuple[Metric, ...] = ()
    rule: dict[Rule, float | str] | None = None
    family: str | None = None
    reach: dict[str, str] | None = None
    verdict: Literal["not testable here"] | None = None
    note: str = ""

    @model_validator(mode="after")
    def _has_one_rule_or_a_reason(self) -> "Claim":
        if self.verdict is None and not (self.rule and len(self.rule) == 1 and self.ours and self.family):
            raise ValueError("a claim that is tested needs `ours`, `family` and one rule")
        if self.rule and self.rule.keys() & {"near", "gain_of_paper"} and not self.paper:
            raise ValueError("the rules near and gain_of_paper need `paper`")
        if self.verdict and (self.rule or self.family or not self.note):
            raise ValueError("a claim that is not testable here needs a `note` with the reason, and has no rule")
        return self

    @property
    def is_difference(self) -> bool:
        """Whether the number is a difference between two methods."""
        return bool(self.rule and self.rule.keys() & DIFFERENCES)

    def by_metric(self) -> "list[Claim]":
        """Return one claim per metric of the list `metrics`; the claim itself if it has no such list."""
        claims = []
        for metric in self.metrics:
            names = {key: f"{name}.{metric}" for key, name in (("paper", self.paper), ("ours", self.ours)) if name}
            tested = f"{self.tested}: {METRICS[metric]}".removeprefix(": ")
            claims.append(self.model_copy(update=names | {"id": f"{self.id}-{metric}", "tested": tested}))
        return claims or [self]


def read_claims(path: Path = FILE) -> list[Claim]:
    """Read the claims, in the paper's order, and check the names of the paper's numbers."""
    entries = [parse(Claim, row, f"{path.name}, claim {row.get('id', i)}") for i, row in enumerate(read_yaml(path))]
    claims = [claim for entry in entries for claim in entry.by_metric()]
    for claim in claims:
        for name in (claim.paper, *(claim.rule or {}).values(), *(claim.reach or {}).values()):
            _constant(claim, name)
    return claims


def evaluate(numbers: Mapping[str, Any], claims: Sequence[Claim]) -> pd.DataFrame:
    """Judge every claim from the numbers of a scene (numbers.json); return one row per claim."""
    found = {claim.id: judge(numbers, claim) for claim in claims}
    p_adjusted: dict[str, float] = {}
    for family in {claim.family for claim in claims}:
        p_values = {claim.id: found[claim.id][1] for claim in claims if claim.family == family}
        p_adjusted |= holm({name: p for name, p in p_values.items() if p is not None})
    rows = [
        {
            "id": claim.id,
            "where": claim.where,
            "claim": f"“{claim.quote}”" + f" ({claim.tested})" * bool(claim.tested),
            "paper": _show(claim, _constant(claim, claim.paper)),
            "ours": _show(claim, resolve(numbers, claim.ours)),
            "verdict": INCONCLUSIVE if p_adjusted.get(claim.id, 0) > SIGNIFICANT else found[claim.id][0],
            "p_adjusted": float(f"{p_adjusted.get(claim.id, nan):.3g}"),
            "note": claim.note,
        }
        for claim in claims
    ]
    return pd.DataFrame(rows).astype({"p_adjusted": object})  # readers replace missing numbers by text


def judge(numbers: Mapping[str, Any], claim: Claim) -> tuple[str, float | None]:
    """Return the verdict on a claim that is tested alone, and its p-value if there are enough boards.

    A claim about all rows of a list has to hold for each of them, so its p-value is their largest one. If some rows
    contradict it, its p-value is the smallest one of these rows, with Bonferroni's correction for all rows.
    """
    if claim.verdict:
        return claim.verdict, None
    ours, claimed = resolve(numbers, claim.ours), claimed_range(numbers, claim)
    short = any((resolve(numbers, path) or 0) < _constant(claim, n) for path, n in (claim.reach or {}).items())
    if ours is None or claimed is None or short:
        return NOT_RUN, None
    parts = ours if isinstance(ours, list) else [ours]
    if not parts or not all(isinstance(part, Mapping) and "mean" in part for part in parts):
        raise SchemaError(f"{FILE.name}, claim {claim.id}: {claim.ours} is not a statistic. Correct this path.")
    low, high = claimed
    stats = [Stat.of(part) for part in parts]
    if any(stat.ci95 is None for stat in stats):
        return INCONCLUSIVE, None
    metric = "" if claim.is_difference else _metric(claim)
    p_values = [max(p_value_of(stat, end, metric) for end in (low, high) if abs(end) < inf) for stat in stats]
    outside = [p for stat, p in zip(stats, p_values, strict=True) if not low < stat.mean < high]
    if outside and min(outside) <= SIGNIFICANT:
        return CONTRADICTED, min(1.0, len(parts) * min(outside))
    return SUPPORTED if max(p_values) <= SIGNIFICANT else INCONCLUSIVE, max(p_values)


def claimed_range(numbers: Mapping[str, Any], claim: Claim) -> tuple[float, float] | None:
    """Return the range in which our number lies if the claim holds; None if the scene lacks the limit of the range."""
    assert claim.rule, "a claim that is tested has a rule"
    ((rule, limit),) = claim.rule.items()
    if isinstance(limit, str):
        limit = resolve({**numbers, **vars(paper)}, limit)
        if limit is None:
            return None
    limit, printed = _mean(limit), _constant(claim, claim.paper)
    if rule == "near":
        tolerance = printed[1] if isinstance(printed, tuple) else limit * _mean(printed)
        return _mean(printed) - tolerance, _mean(printed) + tolerance
    if rule == "within":
        return -limit, limit
    if rule == "gain_of_paper":
        limit *= abs(_mean(printed))
    if claim.is_difference and (rule == "loss_above") != _metric(claim).startswith("mse_"):
        return -inf, -limit
    return (-inf, limit) if rule == "at_most" else (limit, inf)


def resolve(numbers: Any, path: str | None) -> Any:
    """Follow a dotted path in numbers.json; None if the scene has no such number.

    In a list, `key=3,other=x` selects a row, and `*` selects all rows.
    """
    if not path:
        return numbers if path == "" else None
    part, _, rest = path.partition(".")
    if isinstance(numbers, list):
        wanted = {} if part == "*" else dict(pair.split("=", 1) for pair in part.split(","))
        rows = [row for row in numbers if wanted.items() <= {key: str(value) for key, value in row.items()}.items()]
        found = [resolve(row, rest) for row in rows]
        return found if part == "*" else next(iter(found), None)
    return resolve(numbers[part], rest) if isinstance(numbers, Mapping) and part in numbers else None


def _constant(claim: Claim, name: Any) -> Any:
    """Return the constant of `pipeline.paper` that a name in capital letters stands for; other values are returned."""
    root = str(name).partition(".")[0]
    if not (root.isidentifier() and root.isupper()):
        return name
    value = resolve(vars(paper), name)
    if value is None:
        raise SchemaError(f"{FILE.name}, claim {claim.id}: pipeline.paper has no {name}. Correct this name.")
    return value


def _mean(value: Any) -> float:
    return float(value["mean"] if isinstance(value, Mapping) else value[0] if isinstance(value, tuple) else value)


def _metric(claim: Claim) -> str:
    return (claim.ours or "").rpartition(".")[2]


def _show(claim: Claim, value: Any) -> str:
    """Write a number with the unit that a suffix of the path `ours` states; differences get a sign."""
    if value is None or isinstance(value, str):
        return value or ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    ends = [part.rpartition("_")[2] for part in reversed((claim.ours or claim.paper or "").split("."))]
    unit = next((UNITS[end] for end in ends if end in UNITS), "")
    unit = "points" if claim.is_difference and unit == "%" else unit
    if isinstance(value, list):
        return f"{'; '.join(f'{_mean(part):+.3g}' for part in value)} {unit}"
    if isinstance(value, tuple):
        text = "{:g} ± {:g}".format(*value)
    elif isinstance(value, Mapping):
        text = show_difference(value) if claim.is_difference else show(value)
    else:
        text = f"{value:+g}" if claim.is_difference else three_digits(value)
    number, *uncertainty = text.split(" ", 1)
    return " ".join(filter(None, [number, unit, *uncertainty]))

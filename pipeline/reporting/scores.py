"""`scores.json`: a scene's headline scores, for `dvc metrics` and `dvc exp show`. In: numbers.json. Out: a few of it.

Nothing that differs between identical runs: no seconds, no commit, no machine. A question not asked is absent.
"""

from collections.abc import Mapping, Sequence
from typing import Any

from pipeline.evaluation.metrics import METRICS

Row = Mapping[str, Any]
SINGLE = {
    "by_reading": "single_random", "by_indentation": "single_indentation", "by_pass": "single_pass",
    "by_time": "single_temporal",
}  # fmt: skip
POLICIES = ("initial", "regular", "each")
OF_DRIFT = ("accuracy_pct", "mse_f_N2")
OF_SHEAR = ("mse_xy_mm2", "mse_fxy_N2", "mse_fz_N2")


def headline_scores(numbers: Row) -> dict[str, Any]:
    """Take a scene's headline scores, nested by question: means, a place's and a force's, with units in their names."""
    parts = {
        "table2": _table2(numbers),
        "lobo": {"registered": _means(numbers["lobo"]["registered"])} if _recorded(numbers, "lobo") else {},
        "labels": _labels(numbers["labels"]) if _recorded(numbers, "labels") else {},
        "single_sensor": {name: _means(numbers[question]) for name, question in SINGLE.items() if question in numbers},
        "drift_end": _drift_end(numbers.get("drift", {})),
        "shear": _means(numbers["shear"], OF_SHEAR) if "shear" in numbers else {},
    }
    return {name: part for name, part in parts.items() if part}


def _recorded(numbers: Row, question: str) -> bool:
    return question in numbers and numbers["provenance"]["source"] == "recorded"


def _table2(numbers: Row) -> dict[str, Any]:
    rows = dict(numbers.get("table2", {}))
    if "adapt" in numbers:
        rows["control"] = numbers["adapt"]["control"]
    return {name: _means(row) for name, row in rows.items()}


def _means(row: Row, names: Sequence[str] = METRICS) -> dict[str, float]:
    return {name: row[name]["mean"] for name in names if name in row}


def _drift_end(drift: Row) -> dict[str, Any]:
    """Take the last window of each policy, which is a mean over networks already."""
    last = {policy: drift[policy][-1] for policy in POLICIES if policy in drift}
    return {policy: {name: row[name] for name in OF_DRIFT if name in row} for policy, row in last.items()}


def _labels(rows: Sequence[Row]) -> dict[str, Any]:
    """Take the most accurate method without labels of the new board, and with the most of them."""
    found = {}
    for labels_n in sorted({min(row["labels_n"] for row in rows), max(row["labels_n"] for row in rows)}):
        own = [row for row in rows if row["labels_n"] == labels_n]
        best = max(own, key=lambda row: row["as_labelled"]["accuracy_pct"]["mean"])
        method = f"{best['method']} ({best['inputs']})"
        found[f"best_of_{labels_n}_labels"] = {"method": method} | _means(best["as_labelled"])
    return found

"""Tables of verification and stability. In: rows as plain words and numbers. Out: data frames for a page.

Refuses to judge: whether a row holds was decided where it was measured.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import pandas as pd

CHECKS = {
    "subject": "what", "law": "law", "against": "against", "error": "error", "tolerance": "allowed",
    "reason": "why so much",
}  # fmt: skip
CASES = {
    "area": "area", "case": "case", "should": "should", "happened": "happened", "error": "error", "limit": "allowed",
}  # fmt: skip


def verification_table(rows: Sequence[Mapping[str, Any]], source: str) -> pd.DataFrame:
    """Lay out checks: what was measured against what, its error, and why it may be so large."""
    return _table(rows, CHECKS, source)


def stability_table(rows: Sequence[Mapping[str, Any]], source: str) -> pd.DataFrame:
    """Lay out cases: what should happen, what happened, and by how much where that is a number."""
    return _table(rows, CASES, source)


def _table(rows: Sequence[Mapping[str, Any]], titles: Mapping[str, str], source: str) -> pd.DataFrame:
    return pd.DataFrame(
        {title: _show(row[name], row.get("unit", "1")) for name, title in titles.items()}
        | {"holds": "yes" if row["holds"] else "NO", "source": source}
        for row in rows
    )


def _show(value: str | float | None, unit: str) -> str:
    if value is None or isinstance(value, str):
        return value or "–"
    return f"{value:.2g}" if unit == "1" else f"{value:.2g} {unit}"

"""Tables of verification and stability. In: rows as plain words and numbers. Out: data frames for a page.

Refuses to judge: whether a row holds was decided where it was measured.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import pandas as pd


def verification_table(rows: Sequence[Mapping[str, Any]], source: str) -> pd.DataFrame:
    """Lay out checks: what was measured against what, its error, and why it may be so large."""
    lines = [
        {
            "what": row["subject"],
            "law": row["law"],
            "against": row["against"],
            "error": _with_unit(row["error"], row["unit"]),
            "allowed": _with_unit(row["tolerance"], row["unit"]),
            "why so much": row["reason"],
            "holds": _holds(row),
            "source": source,
        }
        for row in rows
    ]
    return pd.DataFrame(lines)


def stability_table(rows: Sequence[Mapping[str, Any]], source: str) -> pd.DataFrame:
    """Lay out cases: what should happen, what happened, and by how much where that is a number."""
    lines = [
        {
            "area": row["area"],
            "case": row["case"],
            "should": row["should"],
            "happened": row["happened"],
            "error": _number(row["error"]),
            "allowed": _number(row["limit"]),
            "holds": _holds(row),
            "source": source,
        }
        for row in rows
    ]
    return pd.DataFrame(lines)


def _with_unit(value: float, unit: str) -> str:
    return _number(value) if unit == "1" else f"{_number(value)} {unit}"


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.2g}"


def _holds(row: Mapping[str, Any]) -> str:
    return "yes" if row["holds"] else "NO"

"""What a scene's physics does without: measured rows -> one table. Sees numbers, never physics."""

from collections.abc import Mapping, Sequence
from typing import Any

import pandas as pd

MEANING = (
    "Errors that leaving a term out makes, measured on this scene's first skin under the main protocol, whichever "
    "protocols leave it out: of all changes of field together (root "
    "of the mean square), the largest of the field at rest before the no-load reading is taken off, and of the force. "
    "Not quantified, and always left out: the skin's corner tabs, and its screws one by one: all of it is held alike."
)


def left_out_table(rows: Sequence[Mapping[str, Any]], source: str) -> pd.DataFrame:
    """Show every term and the protocols that leave it out; what the main protocol leaves out first."""
    ordered = sorted(rows, key=lambda row: row["done"] != "left out")
    table = pd.DataFrame(
        {
            "term": row["term"],
            "in this scene": _where(row),
            "error of the change of field, %": _show(row["field_pct"]),
            "error of the field at rest, µT": _show(row["rest_uT"]),
            "error of the force, %": _show(row["force_pct"]),
            "measured": row["how"],
            "source": source,
        }
        for row in ordered
    )
    table.attrs["meaning"] = MEANING
    return table


def _where(row: Mapping[str, Any]) -> str:
    by = {"left out": row["left_out_by"], "computed": row["computed_by"]}
    return "; ".join(f"{what}: {', '.join(protocols)}" for what, protocols in by.items() if protocols) or row["done"]


def _show(value: float | None) -> str:
    if value is None:
        return "–"
    return f"{value:.0f}" if value >= 10 else f"{value:.2g}"

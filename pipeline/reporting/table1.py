"""The paper's table 1 from its data file, our measured column beside it. In: YAML, measured words. Out: one table.

The paper's cells are never overwritten. Refuses to know where measured words come from.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import pandas as pd
from pydantic import Field, model_validator

from pipeline.core.config import Strict, parse, read_yaml
from pipeline.core.errors import ParamsError
from pipeline.reporting.shown import show

PRINTED = Path(__file__).with_name("table1.yaml")
LOCALISATION = "Localisation (within 1 mm, new skin)"  # our row: the paper's table has none
OURS = "ours, measured"
NOT_GIVEN = "–"
READ_BACK = ", a setting read back from the captures"  # of a simulated rig: no result


class Column(Strict):
    """One sensor of the table, and what the paper cites for it."""

    source: Annotated[str, Field(min_length=1)]


class Table1(Strict):
    """The table as printed: a cell of each row for each column."""

    columns: Annotated[dict[str, Column], Field(min_length=1)]
    rows: Annotated[dict[str, tuple[str, ...]], Field(min_length=1)]

    @model_validator(mode="after")
    def _rows_fill_the_columns(self) -> "Table1":
        for name, cells in self.rows.items():
            if len(cells) != len(self.columns):
                raise ValueError(f"row {name!r} has {len(self.columns)} cells, one a column, not {len(cells)}")
        if OURS in self.columns or LOCALISATION in self.rows:
            raise ValueError(f"{OURS!r} and {LOCALISATION!r} are ours: the paper's table has neither")
        return self


def read_table1(path: Path = PRINTED) -> Table1:
    """Read and check the data file."""
    return parse(Table1, read_yaml(path), str(path))


def table1(data: Table1, measured: Mapping[str, str]) -> pd.DataFrame:
    """Put what we measured, by row, beside the paper's columns; rows we measured nothing of have a dash."""
    rows = data.rows | {LOCALISATION: (NOT_GIVEN,) * len(data.columns)}
    if unknown := sorted(measured.keys() - rows.keys()):
        raise ParamsError("table 1", "measured rows", f"among {sorted(rows)}", unknown, "Name them as the table does.")
    table = pd.DataFrame(
        {"": name, **dict(zip(data.columns, cells, strict=True)), OURS: measured.get(name, NOT_GIVEN)}
        for name, cells in rows.items()
    )
    sources = " ".join(f"{name}: {column.source}" for name, column in data.columns.items())
    table.attrs["meaning"] = (
        f"As printed in the paper (table 1); ? is its own. The last row and column are ours. {sources}"
    )
    return table


def measured(numbers: Mapping[str, Any]) -> dict[str, str]:
    """Say what a scene measured of the table's rows, or was set to, on which kind of skins; else nothing."""
    source = numbers["provenance"]["source"]
    described = [*numbers.get("described", {}).values()]
    rate = described[0]["over_skins"].get("rate_hz") if described else None
    simulated = source == "simulated"
    words = {"Frequency": f"{rate['mean']:.4g} Hz{READ_BACK if simulated else ''}"} if rate else {}
    if "sleeve" in numbers:
        own = numbers["sleeve"]
        area = " x ".join(f"{side:g}" for side in own["area_mm"])
        words["Area coverage"] = f"{own['chips_n']} chips under {area} mm{', a setting' if simulated else ''}"
    if "drift" in numbers:
        words["Durable (> 50k contacts)"] = _durable(numbers["drift"])
    best = next((row for row in ("adapted", "triplet", "multi") if row in numbers.get("table2", {})), None)
    if best:
        words[LOCALISATION] = f"{show(numbers['table2'][best]['accuracy_pct'])} % ({best})"
    return {row: f"{text}, {source}" for row, text in words.items()}


def _durable(drift: Mapping[str, Any]) -> str:
    policy = next(one for one in ("each", "regular", "initial") if one in drift)
    last = drift[policy][-1]
    return (
        f"{last['accuracy_pct']:.3g} % within 1 mm after {last['contacts_n']:,.0f} contacts, no-load reading: {policy}"
    )

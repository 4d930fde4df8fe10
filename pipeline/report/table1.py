"""The paper's table 1, our measured column beside it. In: table1.yaml, numbers.json. Out: one table.

The paper's cells are never overwritten. Refuses to know how ours were measured.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd
from pydantic import model_validator

from pipeline.report.formatting import show
from reskin.config import Strict, parse, read_yaml
from reskin.errors import ParamsError

PRINTED = Path(__file__).with_name("table1.yaml")
LOCALISATION = "Localisation (within 1 mm, new skin)"  # our row: the paper's table has none
OURS = "ours, measured"
NOT_GIVEN = "–"


class Table1(Strict):
    """The table as printed: by column the source that the paper cites, by row a cell for each column."""

    columns: dict[str, str]
    rows: dict[str, tuple[str, ...]]

    @model_validator(mode="after")
    def _rows_fill_the_columns(self) -> "Table1":
        for name, cells in self.rows.items():
            if len(cells) != len(self.columns):
                raise ValueError(f"row {name!r} must have {len(self.columns)} cells, not {len(cells)}")
        return self


def read_table1(path: Path = PRINTED) -> Table1:
    """Read and check the data file."""
    return parse(Table1, read_yaml(path), str(path))


def table1(data: Table1, measured: Mapping[str, str]) -> pd.DataFrame:
    """Put what we measured, by row, beside the paper's columns; a dash where we measured nothing."""
    rows = data.rows | {LOCALISATION: (NOT_GIVEN,) * len(data.columns)}
    if unknown := sorted(measured.keys() - rows.keys()):
        raise ParamsError("table 1", "measured rows", f"among {sorted(rows)}", unknown, "Name them as the table does.")
    table = pd.DataFrame(
        {"property": name, **dict(zip(data.columns, cells, strict=True)), OURS: measured.get(name, NOT_GIVEN)}
        for name, cells in rows.items()
    )
    sources = " ".join(f"{name}: {source}" for name, source in data.columns.items())
    table.attrs["meaning"] = (
        f"As printed in the paper (table 1), ? included. The last row and column are ours. {sources}"
    )
    return table


def measured(numbers: Mapping[str, Any]) -> dict[str, str]:
    """Write what a scene measured for rows of the table, or was set to, and whether on simulated skins."""
    source = numbers["provenance"]["source"]
    simulated = source == "simulated"
    described: Mapping[str, Any] = next(iter(numbers.get("described", {}).values()), {"over_skins": {}})
    words = {}
    if rate := described["over_skins"].get("rate_hz"):
        words["Frequency"] = f"{rate['mean']:.4g} Hz" + ", a setting read back from the captures" * simulated
    if sleeve := numbers.get("sleeve"):
        area = " x ".join(f"{side:g}" for side in sleeve["area_mm"])
        words["Area coverage"] = f"{sleeve['chips_n']} chips under {area} mm" + ", a setting" * simulated
    if drift := numbers.get("drift"):
        policy = next(name for name in ("each", "regular", "initial") if name in drift)
        last = drift[policy][-1]
        words["Durable (> 50k contacts)"] = (
            f"{last['accuracy_pct']:.3g} % within 1 mm after {last['contacts_n']:,.0f} contacts, "
            f"no-load reading: {policy}"
        )
    best = next((row for row in ("adapted", "triplet", "multi") if row in numbers.get("table2", {})), None)
    if best:
        words[LOCALISATION] = f"{show(numbers['table2'][best]['accuracy_pct'])} % ({best})"
    return {row: f"{text}, {source}" for row, text in words.items()}

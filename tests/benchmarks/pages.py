"""Write benchmark results into the generated blocks of pages in docs/."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from reskin import io

ROOT = Path(__file__).resolve().parents[2]
MEASURED = ROOT / "docs/measured"  # one file per benchmark; pages are generated from these files


def write_block(page: str, name: str, parts: Sequence[str]) -> None:
    """Replace the content between the markers of a block by paragraphs and tables."""
    file = ROOT / "docs" / page
    before, opening, _, closing, after = re.split(
        rf"(<!-- {name} -->\n)(.*?)(<!-- /{name} -->)", file.read_text(encoding="utf-8"), flags=re.DOTALL
    )
    text = "\n\n".join(parts)
    io.write_text(file, f"{before}{opening}{text}\n{closing}{after}")


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Format rows as a Markdown table; missing values become dashes."""
    frame = pd.DataFrame(rows).fillna("–").astype(str)
    return str(frame.to_markdown(index=False, disable_numparse=True)) + "\n"


def short(value: float) -> str:
    """Format a number with three significant digits: `0.00123`, `12.3`, `1,230`."""
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"

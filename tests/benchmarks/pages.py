"""What benchmarks measured, as generated parts of docs: a page, a block, its rows -> the page. No number is typed."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from pipeline.report.formatting import to_markdown
from pipeline.report.readme import fill
from reskin import io

ROOT = Path(__file__).resolve().parents[2]
MEASURED = ROOT / "docs/measured"  # one file a benchmark, and the page is made of it


def write_block(page: str, name: str, parts: Sequence[str]) -> None:
    """Put paragraphs and tables between the block's marks."""
    file = ROOT / "docs" / page
    io.write_text(file, fill({page: file.read_text(encoding="utf-8")}, {name: "\n\n".join(parts)})[page])


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Write rows as a table; what a row lacks is a dash."""
    frame = pd.DataFrame(rows).fillna("–").astype(str)
    return to_markdown(frame)


def short(value: float) -> str:
    """Write three digits: `0.00123`, `12.3`, `1,230`."""
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"

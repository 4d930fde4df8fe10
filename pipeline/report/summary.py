"""The main scores of a scene as a few lines for a terminal, and where to look next."""

from collections.abc import Mapping, Sequence
from typing import Any

from pipeline.formatting import PAPER_METRICS, TITLES
from pipeline.report.figures import unseen_rows
from pipeline.report.table_2 import models

SHORT_TITLES = {
    "accuracy_pct": "within 1 mm, %", "mse_xy_mm2": "MSE_xy, mm²", "mse_f_N2": "MSE_F, N²", "r2_f": "R² of F",
}  # fmt: skip
MEANING = "R² of F is 1 for exact forces, and 0 for the mean force. Intervals are on the report page."
RECORDED = "Recorded"
LABELLED = ("accuracy_pct", "r2_f")  # metrics that are shown for methods that use labels
Numbers = Mapping[str, Any]  # numbers.json of one scene


def summarise(numbers: Numbers) -> list[str]:
    """Return lines with the main scores of a scene on held-out boards; no lines if the scene holds out no board."""
    data = str(numbers["provenance"]["source"]).capitalize()
    if new_boards := unseen_rows(numbers):
        title = f"{data} boards not seen in training, by number of labelled presses:"
        lines = [title, *_table(_rows_of_new_boards(new_boards)), MEANING]
    elif numbers.get("table2"):
        rows = _rows_of_table_2(numbers)
        paper = " (in parentheses: the paper's, on recorded boards)" if "(" in str(rows[1:]) else ""
        lines = [f"{data} boards not seen in training: means{paper}", *_table(rows), MEANING]
    else:
        return []
    if data == RECORDED and (model := numbers.get("final_model")):
        lines.append(f"Model trained on all {model['boards_n']} boards, for use: reskin live --model {model['file']}")
    return lines


def _rows_of_table_2(numbers: Numbers) -> list[list[str]]:
    """Return the rows of table 2, with the paper's means beside simulated results."""
    rows = [["", *SHORT_TITLES.values()]]
    known, simulated = models(numbers), numbers["provenance"]["source"] == "simulated"
    for name, scores in numbers["table2"].items():
        cells = []
        for metric in SHORT_TITLES:
            paper = known[name].paper.get(metric) if simulated and metric in PAPER_METRICS else None
            cells.append(_show(scores, metric) + (f" ({_digits(paper[0])})" if paper else ""))
        rows.append([known[name].short, *cells])
    return rows


def _rows_of_new_boards(rows: Sequence[Mapping[str, Any]]) -> list[list[str]]:
    """Return the scores of the in-context models with the fewest and the most labels."""
    scores = {(row["method"], row["labels_n"]): row for row in rows}
    counts = sorted({row["labels_n"] for row in rows})
    ends = list(dict.fromkeys((counts[0], counts[-1])))
    table = [
        ["", *(cell for metric in LABELLED for cell in (SHORT_TITLES[metric], *[""] * (len(ends) - 1)))],
        ["labels:", *(str(labels_n) for _ in LABELLED for labels_n in ends)],
    ]
    for method in dict.fromkeys(row["method"] for row in rows):
        cells = [_show(scores.get((method, labels_n), {}), metric) for metric in LABELLED for labels_n in ends]
        table.append([TITLES[method], *cells])
    return table


def _show(scores: Mapping[str, Any], metric: str) -> str:
    return _digits(scores[metric]["mean"]) if metric in scores else "–"


def _digits(value: float) -> str:
    """Write a number with as many digits as a reader compares: 78, 2.2, 0.46."""
    return f"{value:.0f}" if abs(value) >= 10 else f"{value:.1f}" if abs(value) >= 1 else f"{value:.2f}"


def _table(rows: Sequence[Sequence[str]]) -> list[str]:
    """Align the cells of each column: names to the left, numbers to the right."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    lines = []
    for first, *others in rows:
        cells = [first.ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(others, widths[1:], strict=True))]
        lines.append("  " + "   ".join(cells).rstrip())
    return lines

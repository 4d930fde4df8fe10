"""The report page of a scene. In: its numbers, tables and figures. Out: one HTML file that needs nothing else.

Same inputs, same bytes; no script, no network. Refuses to know paths, and how anything was measured.
"""

import re
from base64 import b64encode
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import chain
from typing import Any

import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined

from pipeline.reporting import page_order
from pipeline.reporting.page_order import CAPTIONS, Section
from pipeline.reporting.shown import notes
from pipeline.reporting.sweeps import learning_costs
from pipeline.reporting.work_precision import cost_tables

NUMBER = re.compile(r"[-+−]?\d[\d.,]*(e[-+]?\d+)?( ± [\d.e+-]+)?( \(seeds\))?( (%|mm|N|mm²|N²|Hz|s|µT))?|–?")
SVG_WIDTH_PT = re.compile(r'<svg [^>]*?width="([\d.]+)pt"')
WIDE_PT = 500.0  # a figure that wide would have letters too small on a telephone: it scrolls in its card there
LONG = 40  # letters of a cell that needs a wide column
MEANT = {
    "simulated": "Every reading of this scene was simulated: no number on this page was measured on hardware.",
    "recorded": "Every reading of this scene was recorded from hardware.",
}


@dataclass(frozen=True)
class Column:
    """A column: its title, and whether it holds numbers, words or sentences."""

    title: str
    look: str

    @property
    def number(self) -> bool:
        """Tell whether its cells are numbers, which stand on the right."""
        return self.look == "number"


@dataclass(frozen=True)
class Table:
    """A table as the page shows it."""

    name: str
    caption: str
    columns: list[Column]
    rows: list[list[tuple[Column, str]]]
    notes: list[str]


@dataclass(frozen=True)
class Figure:
    """A figure as the page shows it: an image of its own, so that ids of two figures never meet."""

    data: str
    alt: str
    caption: str
    wide: bool


def page(
    numbers: Mapping[str, Any],
    tables: Mapping[str, pd.DataFrame],
    figures: Mapping[str, str],
    costs: Mapping[str, str],
) -> str:
    """Render the page of a scene; figures are SVG text by file name, `costs` those of the runtime folder."""
    source = numbers["provenance"]["source"]
    shown = {**tables, **cost_tables(numbers["runtime"], source), **learning_costs(numbers["runtime"], source)}
    drawn = {name: text for name, text in chain(figures.items(), costs.items()) if name.endswith(".svg")}
    ordered = list(arrange(shown, drawn))
    environment = Environment(
        loader=PackageLoader("pipeline.reporting", "."), autoescape=True, undefined=StrictUndefined
    )
    environment.tests["number_text"] = NUMBER.fullmatch
    return environment.get_template("page.html").render(
        scene=numbers["provenance"]["scene"],
        source=source,
        about=about(numbers),
        sections=[_fill(section, shown, drawn, source) for section in ordered],
        provenance=lay_out("provenance", _provenance(numbers["provenance"])),
    )


def arrange(tables: Iterable[str], figures: Iterable[str]) -> Iterator[Section]:
    """List the sections that have something to show, in order; what none of them names stands under "Further"."""
    order = page_order
    named = (order.HEADLINE, *order.QUESTIONS, order.LEFT_OUT, order.COSTS, order.CAPTURES)
    taken = {name for section in named for name in (*section.tables, *section.figures, *section.folded)}
    rest = order.FURTHER
    others = tuple(name for name in tables if name not in taken and name not in rest.folded)
    further = Section(
        rest.key, rest.title, rest.sentence, others, tuple(f for f in figures if f not in taken), rest.folded
    )
    there = {*tables, *figures}
    for section in (order.HEADLINE, *order.QUESTIONS, further, order.LEFT_OUT, order.COSTS, order.CAPTURES):
        if there & {*section.tables, *section.figures, *section.folded}:
            yield section


def about(numbers: Mapping[str, Any]) -> str:
    """Say what a scene is: where its readings come from, and how many of them its main captures hold."""
    counts = next(iter(numbers["described"].values()))["counts"]
    held = ", ".join(f"{n:,} {name.removesuffix('_n').replace('_', ' ')}" for name, n in counts.items() if n)
    return f"{MEANT[numbers['provenance']['source']]} Its main captures hold {held}."


def lay_out(name: str, table: pd.DataFrame) -> Table:
    """Lay a table out: its columns of numbers on the right, its notes below."""
    cells = table.fillna("").astype(str)
    columns = [Column(str(title), _look(cells[title])) for title in cells.columns]
    rows = [list(zip(columns, row, strict=True)) for row in cells.itertuples(index=False)]
    return Table(name, CAPTIONS.get(name, _words(name)), columns, rows, notes(table))


def _fill(
    section: Section, tables: Mapping[str, pd.DataFrame], figures: Mapping[str, str], source: str
) -> dict[str, Any]:
    return {
        "key": section.key,
        "title": section.title,
        "sentence": section.sentence,
        "tables": [lay_out(name, tables[name]) for name in section.tables if name in tables],
        "figures": [_figure(name, figures[name], source) for name in section.figures if name in figures],
        "folded": [lay_out(name, tables[name]) for name in section.folded if name in tables],
    }


def _figure(name: str, svg: str, source: str) -> Figure:
    words = CAPTIONS.get(name, _words(name.removesuffix(".svg")))
    caption = f"{words} ({source})"
    width = SVG_WIDTH_PT.search(svg)
    wide = width is not None and float(width[1]) > WIDE_PT
    return Figure(b64encode(svg.encode()).decode(), f"Figure: {caption}", caption, wide)


def _look(cells: "pd.Series[str]") -> str:
    if all(NUMBER.fullmatch(cell) for cell in cells) and any(cell not in ("", "–") for cell in cells):
        return "number"
    return "text long" if cells.str.len().max() > LONG else "text"


def _provenance(provenance: Mapping[str, Any]) -> pd.DataFrame:
    return pd.DataFrame([{"what": name, "value": str(value)} for name, value in provenance.items()])


def _words(name: str) -> str:
    text = name.replace("_", " ")
    return text[:1].upper() + text[1:]

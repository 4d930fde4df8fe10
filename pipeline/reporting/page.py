"""The report page of a scene. In: its numbers, tables and figures. Out: one HTML file that needs nothing else.

Same inputs, same bytes; no script, no network. Refuses to know paths, and how anything was measured.
"""

import re
from base64 import b64encode
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined
from pydantic import Field

from pipeline.core.config import Strict, parse, read_yaml
from pipeline.reporting.parts import add_sections
from pipeline.reporting.shown import notes
from pipeline.reporting.sweeps import learning_costs
from pipeline.reporting.work_precision import cost_tables

Captions = dict[str, str]  # by name of a table or figure
FILE = Path(__file__).with_name("page.yaml")
FURTHER = "further"  # the section of what no other section names
NUMBER = re.compile(r"[-+−]?\d[\d.,]*(e[-+]?\d+)?( ± [\d.e+-]+)?( \(seeds\))?( (%|mm|N|mm²|N²|Hz|s|µT))?|–?")
SVG_WIDTH_PT = re.compile(r'<svg [^>]*?width="([\d.]+)pt"')
WIDE_PT = 500.0  # above it, letters would be too small on a telephone: the figure scrolls there
LONG = 40  # letters of a cell that needs a wide column
SOURCES = {
    "simulated": "Every reading of this scene was simulated: no number on this page was measured on hardware.",
    "recorded": "Every reading of this scene was recorded from hardware.",
}


class Section(Strict):
    """A part of the page: its heading, what it answers, and what it shows, in order, with captions by name."""

    key: str
    title: str
    sentence: str
    tables: Captions = Field(default_factory=dict)
    figures: Captions = Field(default_factory=dict)
    folded: Captions = Field(default_factory=dict)  # tables so long that they open on demand

    @property
    def captions(self) -> Captions:
        """The captions of everything that the section shows, by name."""
        return self.tables | self.figures | self.folded


@dataclass(frozen=True)
class Table:
    """A table as the page shows it; the look of a column is `number` (aligned right), `text` or `text long`."""

    name: str
    caption: str
    columns: list[str]
    looks: list[str]
    rows: list[tuple[str, ...]]
    notes: list[str]


def page(
    numbers: Mapping[str, Any],
    tables: Mapping[str, pd.DataFrame],
    figures: Mapping[str, str],
    costs: Mapping[str, str],
) -> str:
    """Render the page of a scene; figures are SVG text by file name, `costs` the texts of the runtime folder."""
    source, runtime = numbers["provenance"]["source"], numbers["runtime"]
    shown = {**tables, **cost_tables(runtime, source), **learning_costs(runtime, source)}
    drawings = {name: text for name, text in {**figures, **costs}.items() if name.endswith(".svg")}
    environment = Environment(
        loader=PackageLoader("pipeline.reporting", "."), autoescape=True, undefined=StrictUndefined
    )
    environment.tests["number_text"] = NUMBER.fullmatch
    provenance = pd.DataFrame([{"what": key, "value": str(value)} for key, value in numbers["provenance"].items()])
    return environment.get_template("page.html").render(
        scene=numbers["provenance"]["scene"],
        source=source,
        about=about(numbers),
        sections=[_fill(section, shown, drawings, source) for section in arrange(shown, drawings)],
        provenance=lay_out("provenance", "Provenance", provenance),
    )


def read_sections() -> list[Section]:
    """Read the sections of a page, in order."""
    return [parse(Section, words, f"page, section {words['key']}") for words in add_sections(read_yaml(FILE))]


def arrange(tables: Iterable[str], figures: Iterable[str]) -> list[Section]:
    """List the sections that have something to show, in order, with captions for what no section names."""
    sections, names = read_sections(), {"tables": dict.fromkeys(tables), "figures": dict.fromkeys(figures)}
    named = {name for section in sections for name in section.captions}
    further = {kind: {name: _title(name) for name in all_ if name not in named} for kind, all_ in names.items()}
    filled = [s.model_copy(update=further) if s.key == FURTHER else s for s in sections]
    return [section for section in filled if section.captions.keys() & {*names["tables"], *names["figures"]}]


def about(numbers: Mapping[str, Any]) -> str:
    """Say what a scene is: where its readings come from, and how many of them its main captures hold."""
    counts = next(iter(numbers["described"].values()))["counts"]
    words = ", ".join(f"{n:,} {name.removesuffix('_n').replace('_', ' ')}" for name, n in counts.items() if n)
    return f"{SOURCES[numbers['provenance']['source']]} Its main captures hold {words}."


def lay_out(name: str, caption: str, table: pd.DataFrame) -> Table:
    """Lay a table out: the look of its columns, its cells as text, and its notes."""
    cells = table.fillna("").astype(str)
    looks = [_look(cells[title]) for title in cells.columns]
    return Table(name, caption, [*map(str, cells.columns)], looks, [*cells.itertuples(index=False)], notes(table))


def _fill(
    section: Section, tables: Mapping[str, pd.DataFrame], figures: Mapping[str, str], source: str
) -> dict[str, Any]:
    words = {name: getattr(section, name) for name in ("key", "title", "sentence")}
    for kind in ("tables", "folded"):
        captions = getattr(section, kind)
        words[kind] = [lay_out(name, text, tables[name]) for name, text in captions.items() if name in tables]
    captions = section.figures
    words["figures"] = [
        _figure(f"{text} ({source})", figures[name]) for name, text in captions.items() if name in figures
    ]
    return words


def _figure(caption: str, svg: str) -> dict[str, Any]:
    """Embed a figure as an image of its own, so that ids of two figures never meet."""
    width = SVG_WIDTH_PT.search(svg)
    wide = width is not None and float(width[1]) > WIDE_PT
    return {"data": b64encode(svg.encode()).decode(), "caption": caption, "wide": wide}


def _look(cells: "pd.Series[str]") -> str:
    if all(NUMBER.fullmatch(cell) for cell in cells) and any(cell not in ("", "–") for cell in cells):
        return "number"
    return "text long" if cells.str.len().max() > LONG else "text"


def _title(name: str) -> str:
    text = name.removesuffix(".svg").replace("_", " ")
    return text[:1].upper() + text[1:]

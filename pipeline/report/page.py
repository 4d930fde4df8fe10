"""The report page of a scene, and the page of all scenes."""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined, Template
from pydantic import Field

from pipeline.report import judging
from pipeline.report.figures import cost_tables, learning_costs
from pipeline.report.formatting import notes
from pipeline.report.headline import FILE, answer
from pipeline.report.parts import add_sections
from pipeline.stages import is_stage, module_name
from reskin.code import ROOT, file_of
from reskin.config import Strict, parse, read_yaml
from reskin.errors import SchemaError

Captions = dict[str, str]  # by name of a table or figure
PAGE_FILE = Path(__file__).with_name("page.yaml")
SHORT_OF = "not reached"  # how the checklist begins where ours did not look as far as the paper
NOTHING = ("–", "see file", "")  # cells of the checklist that say no number
PARTED = re.compile(r"(?<=\d) ± (?=\d)|\[[-+\d.e]+, [-+\d.e]+\]( (%|mm²|N²|mm|N)(?![\w]))?")
NO_BREAK = "\u00a0"
FURTHER = "further"  # the section of what no other section names
NUMBER = re.compile(r"[-+−]?\d[\d.,]*(e[-+]?\d+)?( ± [\d.e+-]+)?( \(seeds\))?( (%|mm|N|mm²|N²|Hz|s|µT))?|–?")
SVG_SIZE_PT = re.compile(r'<svg [^>]*?width="([\d.]+)pt" height="([\d.]+)pt"')
LETTERS_PT = re.compile(r"font(?:-size)?: ([\d.]+)px")  # in a file measured in points
PX_PER_PT = 4 / 3
WIDE_PT = 500.0  # above it, a figure has a row of its own
LEGIBLE_PX = 8.0  # no letter is shown smaller: where that needs more width than there is, the figure scrolls
NARROW_PX = 340.0  # what a telephone has
LONG = 40  # letters of a cell that needs a wide column
FINDINGS_N = 4  # sentences at the head of a section; the checklist holds all
OPEN = {"table2", "labels", "claims"}  # tables that answer the first question; all others open on demand
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
class Drawing:
    """A figure as the page shows it: its file, its size, and the width below which its smallest letters get lost."""

    file: str
    width_px: int
    height_px: int
    least_px: int
    wide: bool

    @property
    def scrolls(self) -> bool:
        """Whether it is wider than a telephone."""
        return self.least_px > NARROW_PX


@dataclass(frozen=True)
class Table:
    """A table as the page shows it; the look of a column is `number` (aligned right), `text` or `text long`."""

    name: str
    caption: str
    columns: list[str]
    looks: list[str]
    rows: list[tuple[str, ...]]
    notes: list[str]


def page(numbers: Mapping[str, Any], tables: Mapping[str, pd.DataFrame], figures: Mapping[str, str]) -> str:
    """Render the page of a scene, equal for equal runs; figures are SVG text by file name."""
    source = numbers["provenance"]["source"]
    drawings = {name: measure(f"figures/{name}", text) for name, text in figures.items()}
    found = tables.get("checklist", pd.DataFrame())
    return template("page.html").render(
        scene=numbers["provenance"]["scene"],
        source=source,
        about=about(numbers),
        answer=answer(numbers),
        sections=[
            _fill(section, tables, drawings, source)
            | {"findings": findings(section, found), "stages": stages_of(section, found)}
            for section in arrange(tables, drawings)
        ],
        saved=[*tables],
        opened=OPEN,
    )


def run_page(numbers: Mapping[str, Any], costs: Mapping[str, str]) -> str:
    """Render the page of one run, which the page of the scene embeds: its commit, machine, versions and times.

    `numbers` are joined with their provenance, `costs` the texts of the folder that the page stands in.
    """
    source, provenance = numbers["provenance"]["source"], _flat(numbers["provenance"])
    tables = cost_tables(numbers["runtime"], source) | learning_costs(numbers["runtime"], source)
    drawings = {name: measure(name, text) for name, text in costs.items() if name.endswith(".svg")}
    rows = pd.DataFrame([{"what": key, "value": value} for key, value in provenance.items()])
    return template("page.run.html").render(
        scene=numbers["provenance"]["scene"],
        source=source,
        provenance=lay_out("provenance", "Provenance", rows),
        sections=[_fill(section, tables, drawings, source) for section in arrange(tables, drawings)],
    )


def _flat(provenance: Mapping[str, Any]) -> dict[str, str]:
    """Write each value as text, a mapping as its names and values."""
    return {
        key: ", ".join(f"{name} {one}" for name, one in value.items()) if isinstance(value, Mapping) else str(value)
        for key, value in provenance.items()
    }


def template(name: str) -> Template:
    """Load a template of this folder."""
    environment = Environment(loader=PackageLoader("pipeline.report", "."), autoescape=True, undefined=StrictUndefined)
    environment.tests["number_text"] = NUMBER.fullmatch
    environment.filters["together"] = together
    return environment.get_template(name)


def together(text: str) -> str:
    """Keep a number with its deviation, and the ends of an interval, on one line."""
    return PARTED.sub(lambda found: found[0].replace(" ", NO_BREAK), text)


def read_sections() -> list[Section]:
    """Read the sections of a page, in order."""
    return [parse(Section, words, f"page, section {words['key']}") for words in add_sections(read_yaml(PAGE_FILE))]


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
    names = {name: name.removesuffix("_n").replace("_", " ") for name in counts}
    words = ", ".join(
        f"{n:,} {names[name].removesuffix('s') if n == 1 else names[name]}" for name, n in counts.items() if n
    )
    return f"{SOURCES[numbers['provenance']['source']]} Its main captures hold {words}."


def findings(section: Section, checklist: pd.DataFrame) -> list[str]:
    """Say what the checklist says of what a section shows: ours with its interval, and the paper's; verdicts first.

    Where ours did not look as far as the paper, the sentence says so; what cannot be compared is no finding.
    """
    rows = [
        row
        for row in _rows_of(section, checklist)
        if row["ours"] not in NOTHING and row["difference"] != judging.ONE_SKIN
    ]
    judged = sorted(rows, key=lambda row: row["verdict"] in NOTHING)
    return [
        f"{row['result']}: {row['ours']}; paper: {row['paper']}"
        + (f" ({row['difference'].split(';')[0]})" if row["difference"].startswith(SHORT_OF) else "")
        + ("" if row["verdict"] in NOTHING else f". {row['verdict'].capitalize()}.")
        for row in judged[:FINDINGS_N]
    ]


def stages_of(section: Section, checklist: pd.DataFrame) -> list[tuple[str, str]]:
    """Name the stages behind a section, and the files of their code."""
    stages = dict.fromkeys(row["stage"] for row in _rows_of(section, checklist) if row["stage"] not in NOTHING)
    return [(stage, str(file_of(module_name(stage)).relative_to(ROOT))) for stage in stages if is_stage(stage)]


def _rows_of(section: Section, checklist: pd.DataFrame) -> list[dict[str, str]]:
    if section.key == "checklist" or checklist.empty:
        return []
    cells = checklist.astype(str)
    rows = (dict(zip(cells.columns, row, strict=True)) for row in cells.itertuples(index=False))
    return [row for row in rows if section.captions.keys() & set(row["shown in"].split(", "))]


def measure(file: str, svg: str) -> Drawing:
    """Measure a figure from its text: its size in CSS pixels, and how far it may shrink."""
    size = SVG_SIZE_PT.search(svg)
    if size is None:
        raise SchemaError(
            file, "size", "in points, at the head of the file", svg[:80], "Was it written by drawing.svg?"
        )
    width_pt, height_pt = map(float, size.groups())
    smallest_pt = min(map(float, LETTERS_PT.findall(svg)), default=np.inf)
    least_px = min(LEGIBLE_PX / smallest_pt, PX_PER_PT) * width_pt
    width_px, height_px = (round(PX_PER_PT * side_pt) for side_pt in (width_pt, height_pt))
    return Drawing(file, width_px, height_px, round(least_px), width_pt > WIDE_PT)


def lay_out(name: str, caption: str, table: pd.DataFrame) -> Table:
    """Lay a table out: the look of its columns, its cells as text, and its notes."""
    cells = table.fillna("").astype(str)
    looks = [_look(cells[title]) for title in cells.columns]
    return Table(name, caption, [*map(str, cells.columns)], looks, [*cells.itertuples(index=False)], notes(table))


def _fill(
    section: Section, tables: Mapping[str, pd.DataFrame], figures: Mapping[str, Drawing], source: str
) -> dict[str, Any]:
    words: dict[str, Any] = {name: getattr(section, name) for name in ("key", "title", "sentence")}
    captions = section.tables | section.folded
    words["tables"] = [lay_out(name, text, tables[name]) for name, text in captions.items() if name in tables]
    words["figures"] = [
        (figures[name], f"{text} ({source})") for name, text in section.figures.items() if name in figures
    ]
    return words


def _look(cells: "pd.Series[str]") -> str:
    if all(NUMBER.fullmatch(cell) for cell in cells) and any(cell not in ("", "–") for cell in cells):
        return "number"
    return "text long" if cells.str.len().max() > LONG else "text"


def _title(name: str) -> str:
    text = name.removesuffix(".svg").replace("_", " ")
    return text[:1].upper() + text[1:]


KINDS = {"recorded": "Recorded boards", "simulated": "Simulated boards"}


@dataclass(frozen=True)
class Entry:
    """One scene: its name, its answer, what it says of itself, its headline figure, and whether it is out of date."""

    scene: str
    answer: str
    about: str
    figure: Drawing | None
    stale: bool


def index(results: Sequence[Mapping[str, Any]], drawn: Mapping[str, str]) -> str:
    """Render the page of all scenes, recorded ones first: they are what counts. `drawn`: headline figures by scene."""
    kinds = []
    for source, title in KINDS.items():
        own = [numbers for numbers in results if numbers["provenance"]["source"] == source]
        # Those that answer the question stand first.
        entries = sorted((_entry(numbers, drawn) for numbers in own), key=lambda entry: (not entry.answer, entry.scene))
        if entries:
            kinds.append({"source": source, "title": title, "sentence": SOURCES[source], "entries": entries})
    return template("page.index.html").render(kinds=kinds)


def _entry(numbers: Mapping[str, Any], drawn: Mapping[str, str]) -> Entry:
    scene, stale = str(numbers["provenance"]["scene"]), "trainings" not in numbers
    if stale:
        return Entry(scene, "", "", None, stale)
    words = about(numbers).removeprefix(SOURCES[numbers["provenance"]["source"]]).strip()
    figure = measure(f"{scene}/figures/{FILE}", drawn[scene]) if scene in drawn else None
    return Entry(scene, answer(numbers), words, figure, stale)

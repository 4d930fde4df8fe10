"""The report page of a scene, and the page of all scenes."""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined, Template
from pydantic import Field

from pipeline.report.checklist import ONE_SKIN
from pipeline.report.costs import cost_tables
from pipeline.report.experiments import add_sections
from pipeline.report.figures import HEADLINE
from pipeline.report.formatting import notes
from pipeline.report.sentences import sentences
from pipeline.report.tables import summary_table
from pipeline.stages import is_stage, module_name
from reskin.code import ROOT, file_of
from reskin.config import Strict, parse, read_yaml
from reskin.errors import SchemaError

Captions = dict[str, str]  # captions by the name of the table or figure
PAGE_FILE = Path(__file__).with_name("page.yaml")
NO_NUMBER = ("–", "see file", "")  # cells of the checklist that contain no number
FURTHER = "further"  # key of the section of tables and figures that no other section names
OPEN = {
    "table2",
    "labels",
    "claims",
    "final_model",
}  # tables that are unfolded when the page loads; all others are folded
BESIDE_N = 4  # a section lists at most this many results of the paper; the checklist has all
SUMMARY = "Main scores on held-out boards"
SOURCES = {
    "simulated": "Every reading of this scene was simulated: no number on this page was measured on hardware.",
    "recorded": "Every reading of this scene was recorded from hardware.",
}
KINDS = {"recorded": "Recorded boards", "simulated": "Simulated boards"}
# No line break is allowed between a number and its deviation, or between an interval and its unit.
UNBROKEN = re.compile(r"(?<=\d) ± (?=\d)|\[[-+\d.e]+, [-+\d.e]+\]( (%|mm²|N²|mm|N)(?![\w]))?")
NO_BREAK = "\u00a0"
NUMBER = re.compile(r"[-+−]?\d[\d.,]*(e[-+]?\d+)?( ± [\d.e+-]+)?( \(seeds\))?( (%|mm|N|mm²|N²|Hz|s|µT))?|–?")
LONG = 40  # characters; a column with a longer cell is wide
SVG_SIZE_PT = re.compile(r'<svg [^>]*?width="([\d.]+)pt" height="([\d.]+)pt"')
LETTERS_PT = re.compile(r"font(?:-size)?: ([\d.]+)px")  # font sizes in an SVG; in these files, 1 px means 1 pt
PX_PER_PT = 4 / 3
WIDE_PT = 500.0  # a wider figure gets its own row
LEGIBLE_PX = 8.0  # smallest legible letters; a figure scrolls before its letters become smaller
NARROW_PX = 340.0  # width of a phone's screen


class Section(Strict):
    """A section of the page: heading, introductory sentence, and the captions of its tables and figures, in order."""

    key: str
    title: str
    sentence: str
    tables: Captions = Field(default_factory=dict)
    figures: Captions = Field(default_factory=dict)
    folded: Captions = Field(default_factory=dict)  # long tables, which come last

    @property
    def captions(self) -> Captions:
        """The captions of everything that the section shows, by name."""
        return self.tables | self.figures | self.folded


@dataclass(frozen=True)
class Drawing:
    """A figure on the page: its file, its size, and the width below which its letters become illegible."""

    file: str
    width_px: int
    height_px: int
    least_px: int
    wide: bool
    sentence: str = ""  # what it shows, or what to look for

    @property
    def scrolls(self) -> bool:
        """Whether the figure scrolls on a phone, because it is legible only if it is wider than the screen."""
        return self.least_px > NARROW_PX


@dataclass(frozen=True)
class Table:
    """A table on the page; `looks` has the style of each column: `number` (aligned right), `text` or `text long`."""

    name: str
    caption: str
    columns: list[str]
    looks: list[str]
    rows: list[tuple[str, ...]]
    notes: list[str]


@dataclass(frozen=True)
class Entry:
    """A scene on the page of all scenes: its name, counts of captures, main scores and headline figure."""

    scene: str
    about: str
    summary: Table | None
    figure: Drawing | None


def page(numbers: Mapping[str, Any], tables: Mapping[str, pd.DataFrame], figures: Mapping[str, str]) -> str:
    """Render the page of a scene, which is the same for every repeat of a run; `figures`: SVG text by file name."""
    source, summary = numbers["provenance"]["source"], summary_table(numbers)
    drawings = {name: measure(f"figures/{name}", text) for name, text in figures.items()}
    drawings = describe(drawings, sentences(numbers))
    checklist = tables.get("checklist", pd.DataFrame())
    return template("page.html").render(
        scene=numbers["provenance"]["scene"],
        source=source,
        about=about(numbers),
        summary=None if summary is None else lay_out("summary", SUMMARY, summary),
        sections=[
            _fill(section, tables, drawings, source)
            | {"beside": beside_paper(section, checklist), "stages": stages_of(section, checklist)}
            for section in arrange(tables, drawings)
        ],
        saved=[*tables],
        opened=OPEN,
    )


def run_page(numbers: Mapping[str, Any], costs: Mapping[str, str]) -> str:
    """Render the page of one run (commit, machine, versions, times), which the scene's page embeds.

    numbers: numbers.json joined with provenance.json. costs: text of the other files in the folder, by file name.
    """
    source = numbers["provenance"]["source"]
    tables = cost_tables(numbers["runtime"], source)
    drawings = {name: measure(name, text) for name, text in costs.items() if name.endswith(".svg")}
    drawings = describe(drawings, sentences(numbers))
    provenance = pd.DataFrame(
        {
            "what": key,
            "value": ", ".join(f"{name} {version}" for name, version in value.items())
            if isinstance(value, Mapping)
            else value,
        }
        for key, value in numbers["provenance"].items()
    )
    return template("page.run.html").render(
        scene=numbers["provenance"]["scene"],
        source=source,
        provenance=lay_out("provenance", "Provenance", provenance),
        sections=[_fill(section, tables, drawings, source) for section in arrange(tables, drawings)],
    )


def index(results: Sequence[Mapping[str, Any]], headlines: Mapping[str, str]) -> str:
    """Render the page of all scenes, with recorded scenes first. `headlines`: headline figures by scene."""
    kinds = []
    for source, title in KINDS.items():
        entries = [_entry(numbers, headlines) for numbers in results if numbers["provenance"]["source"] == source]
        if entries:
            entries.sort(key=lambda entry: (entry.summary is None, entry.scene))  # scenes with a summary first
            kinds.append({"source": source, "title": title, "sentence": SOURCES[source], "entries": entries})
    return template("page.index.html").render(kinds=kinds)


def _entry(numbers: Mapping[str, Any], headlines: Mapping[str, str]) -> Entry:
    scene = str(numbers["provenance"]["scene"])
    summary = summary_table(numbers)
    table = None if summary is None else lay_out(f"summary-{scene}", SUMMARY, summary)
    figure = measure(f"{scene}/figures/{HEADLINE}", headlines[scene]) if scene in headlines else None
    return Entry(scene, counts_of(numbers), table, figure)


def template(name: str) -> Template:
    """Load a Jinja template from the folder of this module."""
    environment = Environment(loader=PackageLoader("pipeline.report", "."), autoescape=True, undefined=StrictUndefined)
    environment.tests["number_text"] = NUMBER.fullmatch
    environment.filters["unbroken"] = unbroken
    return environment.get_template(name)


def unbroken(text: str) -> str:
    """Use non-breaking spaces between a number and its deviation, and within an interval and its unit."""
    return UNBROKEN.sub(lambda match: match[0].replace(" ", NO_BREAK), text)


def read_sections() -> list[Section]:
    """Read the sections of the page, in order."""
    return [parse(Section, entry, f"page, section {entry['key']}") for entry in add_sections(read_yaml(PAGE_FILE))]


def arrange(tables: Iterable[str], figures: Iterable[str]) -> list[Section]:
    """List the sections with tables or figures to show; section `further` shows those that no other section names."""
    sections, names = read_sections(), {"tables": dict.fromkeys(tables), "figures": dict.fromkeys(figures)}
    named = {name for section in sections for name in section.captions}
    further = {kind: {name: _title(name) for name in of_kind if name not in named} for kind, of_kind in names.items()}
    filled = [section.model_copy(update=further) if section.key == FURTHER else section for section in sections]
    return [section for section in filled if section.captions.keys() & {*names["tables"], *names["figures"]}]


def _title(name: str) -> str:
    text = name.removesuffix(".svg").replace("_", " ")
    return text[:1].upper() + text[1:]


def about(numbers: Mapping[str, Any]) -> str:
    """Describe where the readings of a scene come from, and how many there are."""
    return f"{SOURCES[numbers['provenance']['source']]} {counts_of(numbers)}"


def counts_of(numbers: Mapping[str, Any]) -> str:
    """List the counts of the main captures."""
    counts = dict(next(iter(numbers["described"].values()))["counts"])
    captures_n = counts.pop("captures_n")
    listed = " and ".join(f"{n:,} {name.removesuffix('_n').replace('_', ' ')}" for name, n in counts.items() if n)
    return f"Main captures: {captures_n:,}, with {listed}."


def beside_paper(section: Section, checklist: pd.DataFrame) -> Table | None:
    """Tabulate the checklist rows of a section that contain a number of ours; rows with verdicts come first."""
    rows = [row for row in _rows_of(section, checklist) if row["ours"] not in NO_NUMBER and row["note"] != ONE_SKIN]
    if not rows:
        return None
    rows.sort(key=lambda row: row["verdict"] in NO_NUMBER)
    columns = ["result", "ours", "paper", "verdict", "note"]
    return lay_out(f"beside-{section.key}", "Comparison with the paper", pd.DataFrame(rows[:BESIDE_N])[columns])


def stages_of(section: Section, checklist: pd.DataFrame) -> list[tuple[str, str]]:
    """List the stages whose results a section shows, each with the file of its code."""
    stages = dict.fromkeys(row["stage"] for row in _rows_of(section, checklist))
    return [(stage, str(file_of(module_name(stage)).relative_to(ROOT))) for stage in stages if is_stage(stage)]


def _rows_of(section: Section, checklist: pd.DataFrame) -> list[dict[str, str]]:
    """Select the checklist rows whose tables or figures the section shows."""
    if section.key == "checklist" or checklist.empty:
        return []
    cells = checklist.astype(str)
    rows = (dict(zip(cells.columns, row, strict=True)) for row in cells.itertuples(index=False))
    return [row for row in rows if section.captions.keys() & set(row["shown in"].split(", "))]


def measure(file: str, svg: str) -> Drawing:
    """Read the size of a figure from its SVG text, and compute the smallest legible width, in CSS pixels."""
    size = SVG_SIZE_PT.search(svg)
    if size is None:
        raise SchemaError(f"{file}: the SVG has no size in points: {svg[:80]}. Was it written by drawing.svg?")
    width_pt, height_pt = map(float, size.groups())
    smallest_pt = min(map(float, LETTERS_PT.findall(svg)), default=np.inf)
    least_px = min(LEGIBLE_PX / smallest_pt, PX_PER_PT) * width_pt
    width_px, height_px = (round(PX_PER_PT * side_pt) for side_pt in (width_pt, height_pt))
    return Drawing(file, width_px, height_px, round(least_px), width_pt > WIDE_PT)


def describe(drawings: Mapping[str, Drawing], by_name: Mapping[str, str]) -> dict[str, Drawing]:
    """Add to each figure its sentence, if there is one for its name."""
    return {name: replace(drawing, sentence=by_name.get(name, "")) for name, drawing in drawings.items()}


def lay_out(name: str, caption: str, table: pd.DataFrame) -> Table:
    """Prepare a table for the page: how its columns look, its cells as text, and its notes."""
    cells = table.fillna("").astype(str)
    looks = [_look(cells[title]) for title in cells.columns]
    return Table(name, caption, [*map(str, cells.columns)], looks, [*cells.itertuples(index=False)], notes(table))


def _look(cells: "pd.Series[str]") -> str:
    if all(NUMBER.fullmatch(cell) for cell in cells) and any(cell not in ("", "–") for cell in cells):
        return "number"
    return "text long" if cells.str.len().max() > LONG else "text"


def _fill(
    section: Section, tables: Mapping[str, pd.DataFrame], figures: Mapping[str, Drawing], source: str
) -> dict[str, Any]:
    """Prepare a section for the template: heading, sentence, and those tables and figures that exist in this report."""
    captions = section.tables | section.folded
    return {
        "key": section.key,
        "title": section.title,
        "sentence": section.sentence,
        "tables": [lay_out(name, text, tables[name]) for name, text in captions.items() if name in tables],
        "figures": [(figures[name], f"{text} ({source})") for name, text in section.figures.items() if name in figures],
    }

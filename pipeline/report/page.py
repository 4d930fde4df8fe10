"""The report page of a scene, and the page of all scenes."""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import takewhile
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined, Template
from markupsafe import Markup, escape
from pydantic import Field

from pipeline.formatting import notes
from pipeline.report.answers import IN_BRACKETS, LEVELS, Answers, answers
from pipeline.report.figures import HEADLINE
from pipeline.report.sentences import sentences
from pipeline.report.tables import run_tables
from reskin.config import Strict, parse, read_yaml
from reskin.errors import SchemaError

Captions = dict[str, str]  # captions by the name of the table or figure
PAGE_FILE = Path(__file__).with_name("page.yaml")
PLACES_FILE = Path(__file__).with_name("page.places.yaml")
FURTHER = "further"  # key of the section of tables and figures that no other section names
# Tables that are unfolded when the page loads; all other tables are folded.
OPEN = {"table1", "table2", "claims", "final_model"}
EFFORTS = "Scores on new skins, by model and by the data that the model needs from the new skin"
SOURCES = {
    "simulated": "Every reading of this scene was simulated, so no number on this page was measured on hardware.",
    "recorded": "Every capture of this scene was recorded from hardware. Results of simulated readings are marked.",
}
RESULTS = ("table-2", "figure-")  # the ids of those tables and figures of the paper that show results start with these
KINDS = {"recorded": "Recorded boards", "simulated": "Simulated boards"}
UNIT = r" (%|mm²|N²|mm|N|Hz|µT)(?!\w)"
# Places where no line break is allowed: between a number and its deviation or unit, and in an interval with its unit.
UNBROKEN = re.compile(rf"(?<=\d) ± (?=\d)|(?<=\d){UNIT}|\([-+\d.e]+(; [-+\d.e]+)+\)|\[[-+\d.e]+, [-+\d.e]+\]({UNIT})?")
SENTENCE_END = re.compile(r"(?<=[.]) ")
NO_BREAK = "\u00a0"
NUMBER = re.compile(r"[-+−]?\d[\d.,]*(e[-+]?\d+)?( ± [\d.e+-]+)?( \(seeds\))?( (%|mm|N|mm²|N²|Hz|s|µT))?|–?")
LONG = 40  # a column with a cell of more characters than this is wide
NO_VALUE = ("–", "")  # cells that are hidden if the rows of a table are stacked
# Widths in rem, which estimate the width of a table. If a table is wider than its place on the screen, its rows are
# stacked, with the cells of each row below each other.
STEPS_REM = (18, 22, 26, 30, 36, 42, 48, 54, 60, 65, 70, 76, 90, 110, 140)
CHARACTER_REM, PADDING_REM = 0.52, 1.0  # width of a character, and of the padding of a cell
SHORT_LINE, LONG_LINE = 14, 20  # characters in a line of a wrapped cell, for short cells and for long cells
SVG_SIZE_PT = re.compile(r'<svg [^>]*?width="([\d.]+)pt" height="([\d.]+)pt"')
LETTERS_PT = re.compile(r"font(?:-size)?: ([\d.]+)px")  # font sizes in an SVG; in these files, 1 px means 1 pt
PX_PER_PT = 4 / 3
WIDE_PT = 500.0  # a wider figure gets its own row
LEGIBLE_PX = 8.0  # size of the smallest legible letters; a figure scrolls instead of shrinking further
NARROW_PX = 340.0  # width of a phone's screen


class Place(Strict):
    """A table or figure of the paper: its name, what it shows, and our tables and figures that show the same."""

    id: str
    name: str
    what: str
    shown: tuple[str, ...] = ()


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

    id: str
    file: str
    width_px: int
    height_px: int
    least_px: int
    wide: bool
    sentence: str = ""  # what the figure shows, or what to look for

    @property
    def scrolls(self) -> bool:
        """Whether the figure scrolls on a phone, because its letters are illegible at the width of the screen."""
        return self.least_px > NARROW_PX


@dataclass(frozen=True)
class Table:
    """A table on the page; `looks` has the style of each column: `number` (aligned right), `text` or `text long`.

    If the table's place on the screen is narrower than `width_rem`, the rows of the table are stacked.
    """

    id: str
    name: str
    caption: str
    columns: list[str]
    looks: list[str]
    rows: Sequence[tuple[str, ...]]
    notes: list[str]
    width_rem: int


@dataclass(frozen=True)
class Entry:
    """A scene on the page of all scenes: name, description, counts of captures, answers and headline figure.

    `places` lists the tables and figures of the paper whose results are also shown on the page of this scene.
    """

    scene: str
    about: str
    counts: str
    answers: Answers
    efforts: Table | None
    figure: Drawing | None
    places: list[dict[str, Any]]


def page(numbers: Mapping[str, Any], tables: Mapping[str, pd.DataFrame], figures: Mapping[str, str]) -> str:
    """Render the page of a scene, which is equal for all repeats of a run; `figures` contains SVG text by file name.

    Tables without rows are not shown.
    """
    tables = {name: table for name, table in tables.items() if len(table)}
    source, ids = numbers["provenance"]["source"], ids_of([*tables, *figures])
    drawings = {name: measure(f"figures/{name}", text, ids[name]) for name, text in figures.items()}
    drawings = describe(drawings, sentences(numbers))
    answered = answers(numbers)
    sections = arrange(tables, drawings)
    return template("page.html").render(
        scene=numbers["provenance"]["scene"],
        source=source,
        about=about(numbers),
        answers=answered,
        efforts=efforts_table("efforts", answered),
        levels=LEVELS,
        brackets=IN_BRACKETS,
        places=[place_on_page(place, ids) for place in read_places()],
        sections=[_fill(section, tables, drawings, source, ids) for section in sections],
        saved=[*tables],
        opened=OPEN,
    )


def read_places() -> list[Place]:
    """Read the tables and figures of the paper, in its order."""
    return [parse(Place, entry, f"places, entry {entry['id']}") for entry in read_yaml(PLACES_FILE)]


def ids_of(names: Iterable[str]) -> dict[str, str]:
    """Return the id of each table and figure on a page; the paper's name is the id of those that the paper also has."""
    papers: dict[str, str] = {}
    shown = list(names)
    for place in read_places():
        if name := next((name for name in place.shown if name in shown), None):
            papers[name] = place.id
    own = {name: f"{name.removesuffix('.svg')}-{'figure' if name.endswith('.svg') else 'table'}" for name in shown}
    return own | papers


def place_on_page(place: Place, ids: Mapping[str, str]) -> dict[str, Any]:
    """Return a table or figure of the paper, and whether the page shows it."""
    return {"id": place.id, "name": place.name, "what": place.what, "here": place.id in ids.values()}


def efforts_table(name: str, answered: Answers) -> Table | None:
    """Tabulate the scores behind the answers of a scene; None if no board was held out."""
    cells = [effort.cells for effort in answered.efforts]
    return lay_out(name, EFFORTS, pd.DataFrame(cells)) if cells else None


def run_page(numbers: Mapping[str, Any], costs: Mapping[str, str]) -> str:
    """Render the page of one run (commit, machine, versions, times), to which the scene's page links.

    numbers: numbers.json joined with provenance.json. costs: texts of the other files in the folder of the page, by
    file name.
    """
    source = numbers["provenance"]["source"]
    tables = run_tables(numbers, source)
    ids = ids_of([*tables, *costs])
    drawings = {name: measure(name, text, ids[name]) for name, text in costs.items() if name.endswith(".svg")}
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
        sections=[_fill(section, tables, drawings, source, ids) for section in arrange(tables, drawings)],
    )


def index(
    results: Sequence[Mapping[str, Any]],
    headlines: Mapping[str, str],
    described: Mapping[str, str] | None = None,
    shown: Mapping[str, Sequence[str]] | None = None,
) -> str:
    """Render the page of all scenes, with recorded scenes first.

    headlines: headline figures by scene. described: descriptions by scene. shown: names of tables and figures by scene.
    """
    kinds = []
    for source, title in KINDS.items():
        entries = [
            _entry(numbers, headlines, described or {}, shown or {})
            for numbers in results
            if numbers["provenance"]["source"] == source
        ]
        if entries:
            # Scenes that are tested on held-out boards come first.
            entries.sort(key=lambda entry: (entry.efforts is None, entry.scene))
            kinds.append({"source": source, "title": title, "sentence": SOURCES[source], "entries": entries})
    return template("page.index.html").render(kinds=kinds, levels=LEVELS, brackets=IN_BRACKETS)


def _entry(
    numbers: Mapping[str, Any],
    headlines: Mapping[str, str],
    described: Mapping[str, str],
    shown: Mapping[str, Sequence[str]],
) -> Entry:
    scene, answered = str(numbers["provenance"]["scene"]), answers(numbers)
    figure = None
    if scene in headlines:
        figure = measure(f"{scene}/figures/{HEADLINE}", headlines[scene], f"{scene}-figure")
    efforts = efforts_table(f"efforts-{scene}", answered)
    ids = ids_of(shown.get(scene, ()))
    places = [place_on_page(place, ids) for place in read_places() if place.id.startswith(RESULTS)]
    here = [place for place in places if place["here"]]
    return Entry(scene, described.get(scene, ""), counts_of(numbers), answered, efforts, figure, here)


def about_scene(text: str) -> str:
    """Return the description of a scene: the first sentence of the comment at the top of its YAML file.

    >>> about_scene("# Scene ini: two boards, pressed\\n# by a printer. One is new.\\nsource: recorded")
    'Two boards, pressed by a printer.'
    """
    lines = takewhile(lambda line: line.startswith("#"), text.splitlines())
    comment = " ".join(line.lstrip("# ") for line in lines)
    sentence = re.sub(r"^Scene \w+(, [^:]*)?:? ", "", SENTENCE_END.split(comment)[0])
    return sentence[:1].upper() + sentence[1:]


def template(name: str) -> Template:
    """Load a Jinja template from the folder of this module."""
    environment = Environment(loader=PackageLoader("pipeline.report", "."), autoescape=True, undefined=StrictUndefined)
    environment.tests["number_text"] = NUMBER.fullmatch
    environment.tests["no_value"] = lambda cell: cell in NO_VALUE
    environment.filters["unbroken"] = unbroken
    environment.filters["code"] = show_code
    environment.globals["steps_rem"] = STEPS_REM
    return environment.get_template(name)


def show_code(text: str) -> Markup:
    """Mark what is between backquotes as code."""
    return Markup(re.sub(r"`([^`]+)`", r"<code>\1</code>", str(escape(text))))


def unbroken(text: str) -> str:
    """Use non-breaking spaces between a number and its deviation or unit, and within an interval and its unit."""
    if isinstance(text, Markup):
        return text
    return UNBROKEN.sub(lambda match: match[0].replace(" ", NO_BREAK), text)


def read_sections() -> list[Section]:
    """Read the sections of the page, in order."""
    return [parse(Section, entry, f"page, section {entry['key']}") for entry in read_yaml(PAGE_FILE)]


def arrange(tables: Iterable[str], figures: Iterable[str]) -> list[Section]:
    """List the sections to show; section `further` has the tables and figures that no other section names."""
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


def measure(file: str, svg: str, id: str) -> Drawing:
    """Read the size of a figure from its SVG text, and compute the smallest legible width, in CSS pixels."""
    size = SVG_SIZE_PT.search(svg)
    if size is None:
        raise SchemaError(
            f"{file}: the SVG has no size in points; it starts with {svg[:80]}. Write figures with function `svg` of "
            "pipeline/plot.py."
        )
    width_pt, height_pt = map(float, size.groups())
    smallest_pt = min(map(float, LETTERS_PT.findall(svg)), default=np.inf)
    least_px = min(LEGIBLE_PX / smallest_pt, PX_PER_PT) * width_pt
    width_px, height_px = (round(PX_PER_PT * side_pt) for side_pt in (width_pt, height_pt))
    return Drawing(id, file, width_px, height_px, round(least_px), width_pt > WIDE_PT)


def describe(drawings: Mapping[str, Drawing], by_name: Mapping[str, str]) -> dict[str, Drawing]:
    """Add to each drawing the sentence that tells readers what they can see in it.

    `by_name` contains these sentences by name of the drawing. Drawings without a sentence are not changed.
    """
    return {name: replace(drawing, sentence=by_name.get(name, "")) for name, drawing in drawings.items()}


def lay_out(name: str, caption: str, table: pd.DataFrame, ids: Mapping[str, str] | None = None) -> Table:
    """Prepare a table for the page: how its columns look, its cells as text, its notes and its width.

    If column `source` has a single value, the value is moved to the caption.
    """
    cells = table.fillna("")
    if "source" in cells and cells["source"].nunique() == 1:
        caption = f"{caption} ({cells['source'].iloc[0]})"
        cells = cells.drop(columns="source")
    cells = cells.astype(str)
    looks = [_look(cells[title]) for title in cells.columns]
    rows = [*cells.itertuples(index=False, name=None)]
    columns = [*map(str, cells.columns)]
    width_rem = _width_rem(columns, rows)
    return Table((ids or {}).get(name, name), name, caption, columns, looks, rows, notes(table), width_rem)


def _width_rem(columns: Sequence[str], rows: Sequence[tuple[str, ...]]) -> int:
    """Estimate the smallest width, in rem, at which a table is easy to read without stacking its rows."""
    width_rem = 0.0
    for i, title in enumerate(columns):
        cells = [row[i] for row in rows]
        word = max(len(word) for text in (title, *map(unbroken, cells)) for word in text.split(" "))
        cell = max(map(len, cells), default=0)
        line = LONG_LINE if cell > LONG else SHORT_LINE
        nowrap = max((len(text) for text in cells if NUMBER.fullmatch(text)), default=0)
        width_rem += CHARACTER_REM * max(word, nowrap, min(cell, line)) + PADDING_REM
    return next((step for step in STEPS_REM if step >= width_rem), STEPS_REM[-1])


def _look(cells: "pd.Series[str]") -> str:
    """Return the style of a column. Numbers with deviations are aligned left, like those with intervals."""
    if all(NUMBER.fullmatch(cell) and "±" not in cell for cell in cells) and any(
        cell not in NO_VALUE for cell in cells
    ):
        return "number"
    return "text long" if cells.str.len().max() > LONG else "text"


def _fill(
    section: Section,
    tables: Mapping[str, pd.DataFrame],
    figures: Mapping[str, Drawing],
    source: str,
    ids: Mapping[str, str],
) -> dict[str, Any]:
    """Prepare a section for the template: heading, sentence, and the tables and figures that this report has."""
    captions = section.tables | section.folded
    return {
        "key": section.key,
        "title": section.title,
        "sentence": section.sentence,
        "tables": [lay_out(name, text, tables[name], ids) for name, text in captions.items() if name in tables],
        "figures": [
            (figures[name], _with_source(text, source)) for name, text in section.figures.items() if name in figures
        ],
    }


def _with_source(caption: str, source: str) -> str:
    """Append the source of the data to a caption, unless the caption itself names recorded and simulated data.

    >>> _with_source("Forces on the recorded hand, and on simulated skins", "recorded")
    'Forces on the recorded hand, and on simulated skins'
    """
    return caption if "recorded" in caption and "simulated" in caption else f"{caption} ({source})"

"""Fill the pages of a report: templates in Markdown that people wrote (folder `pages`), with numbers of a run.

A template is Jinja and Markdown. Besides the numbers of the scene (`numbers`, as in numbers.json) it can use the
tables and figures of the scene, the paper's numbers (`paper`), and the functions and filters of `Page`. A name that
does not exist is an error, so a page never shows an empty place.
"""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
from jinja2 import Environment, FileSystemLoader, StrictUndefined, TemplateError
from markdown_it import MarkdownIt
from markupsafe import Markup

from pipeline import paper
from pipeline.formatting import show
from pipeline.report.figures import unseen_rows
from pipeline.statistics import Stat
from reskin.errors import SchemaError

FOLDER = Path(__file__).with_name("pages")
TEMPLATES = {"simulated": "simulated.md", "recorded": "recorded.md"}  # the page of a scene, by its source
# A cell of a table that is a number, perhaps with a unit, a deviation, an interval or values of boards.
NUMBER = re.compile(r"[-+−≤<]?\s?\d[\d.,e+-]*( [%a-zA-Zµ²°]{1,3})?( ± [\d.e+-]+)?( (\(.*\)|\[.*\]))?|–?")
ID = re.compile(r'(\bid="|url\(#|href="#)')  # where an SVG defines or uses an id


class Page:
    """One page: renders a template, and remembers which tables and figures of the scene the template placed.

    - numbers: content of numbers.json.
    - tables: tables by name.
    - figures: SVG text by name, without the suffix.
    """

    def __init__(
        self,
        numbers: Mapping[str, Any],
        tables: Mapping[str, pd.DataFrame] | None = None,
        figures: Mapping[str, str] | None = None,
    ) -> None:
        self.numbers, self.tables, self.figures = numbers, dict(tables or {}), dict(figures or {})
        self.placed: set[str] = set()
        self.parts: list[str] = []  # HTML of tables and figures, which Markdown must not change
        self.environment = Environment(
            loader=FileSystemLoader(FOLDER), undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True,
            keep_trailing_newline=True,
        )  # fmt: skip
        self.environment.filters |= {
            "show": show,
            "fixed": fixed,
            "compact": compact,
            "rms": lambda stat: stat["mean"] ** 0.5,
        }
        self.environment.globals |= {
            "paper": paper, "numbers": numbers, "tables": self.tables, "figures": self.figures, "table": self.table,
            "folded": self.folded, "figure": self.figure, "pick": pick, "unseen": self.unseen,
            "further_tables": lambda: [name for name in self.tables if name not in self.placed],
            "further_figures": lambda: [name for name in self.figures if name not in self.placed],
        }  # fmt: skip
        self.html = Environment(loader=FileSystemLoader(FOLDER), autoescape=True, undefined=StrictUndefined)

    def fill(self, template: str, **context: Any) -> str:
        """Fill a template; raise `SchemaError`, with the line, if it uses a name that does not exist."""
        try:
            return self.environment.get_template(template).render(**context)
        except (TemplateError, KeyError, TypeError) as error:
            line = _line_of(error, template)
            raise SchemaError(
                f"pipeline/report/pages/{template}{line}: {type(error).__name__}: {error}. Correct the "
                "template; it can use what numbers.json of the scene has."
            ) from error

    def html_of(self, template: str, title: str, **context: Any) -> str:
        """Fill a template and return the whole page as HTML, with its style and its figures inside."""
        body = MarkdownIt("commonmark", {"html": True}).enable("table").render(self.fill(template, **context))
        body = body.replace("± ", "±\N{NO-BREAK SPACE}")
        body = re.sub(r"(?:<p>)?\x02(\d+)\x03(?:</p>)?", lambda match: self.parts[int(match[1])], body)
        style = (FOLDER / "style.css").read_text(encoding="utf-8")
        return (
            self.html.get_template("base.html").render(title=title, style=Markup(style), body=Markup(body)).strip()
            + "\n"
        )

    def table(self, name: str) -> str:
        """Place a table of the scene."""
        self.placed.add(name)
        number = NUMBER.fullmatch
        cells = self.tables[name].map(lambda cell: "–" if pd.isna(cell) else str(cell))
        return self._part(self._macro("table")(name, cells, number))

    def folded(self, name: str, title: str) -> str:
        """Place a table of the scene below a line that unfolds it; nothing if the scene has no such table."""
        if name not in self.tables:
            return ""
        rows_n = len(self.tables[name])
        part = self.parts[int(self.table(name).strip("\x02\x03\n"))]
        return self._part(f"<details><summary>{title} ({rows_n} row{'s' * (rows_n > 1)})</summary>{part}</details>")

    def figure(self, name: str, caption: str) -> str:
        """Place a figure of the scene inside the page; its ids get the name of the figure, so that they stay unique."""
        self.placed.add(name)
        svg = re.sub(r"^.*?(?=<svg)", "", self.figures[name], flags=re.DOTALL)
        return self._part(self._macro("figure")(name, Markup(ID.sub(rf"\1{name}-", svg)), Markup(caption)))

    def unseen(self, method: str, labels_n: int) -> Mapping[str, Any]:
        """Return the scores of a method on boards never seen in training, on the checkerboard, with all its presses."""
        return pick(unseen_rows(self.numbers, (method,)), labels_n=labels_n)

    def _macro(self, name: str) -> Any:
        return getattr(self.html.get_template("parts.html").module, name)

    def _part(self, html: str) -> str:
        self.parts.append(str(html))
        return f"\x02{len(self.parts) - 1}\x03"


def fixed(value: float, digits: int = 0) -> str:
    """Write a number with so many decimals.

    >>> fixed(78.7), fixed(0.4449, 2)
    ('79', '0.44')
    """
    return f"{value:z,.{digits}f}"


def compact(value: Mapping[str, Any], digits: int = 0) -> str:
    """Write a mean with so many decimals, and the interval over boards, the values of the boards, or a deviation.

    >>> compact({"mean": 43.3, "n": 2, "values": [45.1, 41.4]}), compact({"mean": 46.6, "n": 27, "sd": 20.2})
    ('43 (45; 41)', '47 ± 20')
    """
    stat = Stat.of(value)
    mean, *others = [fixed(number, digits) for number in (stat.mean, *stat.ends)]
    if others:
        return f"{mean} ({'; '.join(others)})" if stat.few else f"{mean} [{', '.join(others)}]"
    return mean if stat.sd is None else f"{mean} ± {fixed(stat.sd, digits)}"


def pick(rows: Sequence[Mapping[str, Any]], **keys: Any) -> Mapping[str, Any]:
    """Return the only row with these values; raise `SchemaError` if there is none, or more than one."""
    found = [row for row in rows if all(row.get(key) == value for key, value in keys.items())]
    if len(found) != 1:
        raise SchemaError(f"{len(found)} rows of numbers.json have {keys}; expected one. Correct the template.")
    return found[0]


def scene_page(numbers: Mapping[str, Any], tables: Mapping[str, pd.DataFrame], figures: Mapping[str, str]) -> str:
    """Render the page of a scene, which is equal for all repeats of a run; tables without rows are not shown."""
    scene, source = (numbers["provenance"][name] for name in ("scene", "source"))
    shown = {name: table for name, table in tables.items() if len(table)}
    named = {name.removesuffix(".svg"): svg for name, svg in figures.items()}
    counts = next(iter(numbers["described"].values()))["counts"]
    page = Page(numbers, shown, named)
    return page.html_of(TEMPLATES[source], f"ReSkin: scene {scene} ({source})", scene=scene, counts=counts)


def run_page(numbers: Mapping[str, Any], tables: Mapping[str, pd.DataFrame], figures: Mapping[str, str]) -> str:
    """Render the page of one run: commit, machine, versions, times; numbers: joined with provenance.json."""
    scene = numbers["provenance"]["scene"]
    named = {name.removesuffix(".svg"): svg for name, svg in figures.items()}
    return Page(numbers, tables, named).html_of("run.md", f"ReSkin: run of scene {scene}", scene=scene)


def index_page(results: Sequence[Mapping[str, Any]]) -> str:
    """Render the page that lists all scenes; results: numbers.json of each scene."""
    scenes = {source: [one for one in results if one["provenance"]["source"] == source] for source in TEMPLATES}
    return Page({}).html_of("index.md", "ReSkin: all scenes", scenes=scenes, unseen_rows=unseen_rows)


def _line_of(error: BaseException, template: str) -> str:
    """Return the line of the template in which an error arose, for messages; empty if unknown."""
    trace, line = error.__traceback__, ""
    while trace:
        if trace.tb_frame.f_code.co_filename.endswith(template):
            line = f", line {trace.tb_lineno}"
        trace = trace.tb_next
    return line or (f", line {error.lineno}" if hasattr(error, "lineno") else "")

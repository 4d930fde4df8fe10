"""The page of all scenes: their numbers -> one HTML file beside their folders. Simulated and recorded stand apart.

A scene whose results are of code that counted no collapsed networks is named, and no number of it shown. Refuses to
know paths but those of the pages it leads to.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pipeline.reporting.headline import FILE
from pipeline.reporting.page import SOURCES, about, template

KINDS = {"recorded": "Recorded boards", "simulated": "Simulated boards"}


@dataclass(frozen=True)
class Entry:
    """One scene: its name, what it says of itself, whether it has a headline figure, and whether it is out of date."""

    scene: str
    about: str
    has_figure: bool
    stale: bool


def index(results: Sequence[Mapping[str, Any]], drawn: Collection[str]) -> str:
    """Render the page of all scenes, recorded ones first: they are what counts. `drawn` have a headline figure."""
    kinds = []
    for source, title in KINDS.items():
        own = [numbers for numbers in results if numbers["provenance"]["source"] == source]
        entries = [
            _entry(numbers, drawn) for numbers in sorted(own, key=lambda numbers: str(numbers["provenance"]["scene"]))
        ]
        if entries:
            kinds.append({"source": source, "title": title, "sentence": SOURCES[source], "entries": entries})
    return template("index.html").render(kinds=kinds, figure=FILE)


def _entry(numbers: Mapping[str, Any], drawn: Collection[str]) -> Entry:
    scene, stale = str(numbers["provenance"]["scene"]), "trainings" not in numbers
    words = "" if stale else about(numbers).removeprefix(SOURCES[numbers["provenance"]["source"]]).strip()
    return Entry(scene, words, scene in drawn and not stale, stale)

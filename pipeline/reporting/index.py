"""The page of all scenes: their numbers -> one HTML file beside their folders. Simulated and recorded stand apart.

A scene whose results are of code that counted no collapsed networks is named, and no number of it shown. Refuses to
know paths but those of the pages it leads to.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pipeline.reporting.headline import FILE, answer
from pipeline.reporting.page import SOURCES, Drawing, about, measure, template

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
    return template("index.html").render(kinds=kinds)


def _entry(numbers: Mapping[str, Any], drawn: Mapping[str, str]) -> Entry:
    scene, stale = str(numbers["provenance"]["scene"]), "trainings" not in numbers
    if stale:
        return Entry(scene, "", "", None, stale)
    words = about(numbers).removeprefix(SOURCES[numbers["provenance"]["source"]]).strip()
    figure = measure(f"{scene}/figures/{FILE}", drawn[scene]) if scene in drawn else None
    return Entry(scene, answer(numbers), words, figure, stale)

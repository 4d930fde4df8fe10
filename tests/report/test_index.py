"""The page of all scenes: each in its place, simulated and recorded apart, nothing shown of what is out of date."""

import re

from pipeline.report.page import index
from tests.report.synthetic import all_experiments

SVG = '<svg width="600.0pt" height="200.0pt"><text style="font-size: 9px">a</text></svg>'


def numbers(scene: str, source: str) -> dict:
    found = all_experiments(source) | {"trainings": {}}
    return found | {"provenance": found["provenance"] | {"scene": scene}}


def test_recorded_scenes_come_first_and_no_scene_stands_under_the_other_word():
    text = index([numbers("here", "simulated"), numbers("there", "recorded")], {"here": SVG})
    recorded, simulated = text.split('<section id="simulated">')
    assert 'href="there/index.html"' in recorded
    assert 'href="here/index.html"' in simulated
    assert "there/" not in simulated
    assert "here/" not in recorded.replace("there/", "")
    assert "there/figures" not in text  # no file, no image


def test_each_scene_says_how_it_does_on_boards_never_seen_or_that_it_held_out_none():
    # "a" comes before "here", and held out no board.
    alone = {name: value for name, value in numbers("a", "simulated").items() if name != "table2"}
    both = index([alone, numbers("here", "simulated")], {})
    assert both.index("Scene here") < both.index("Scene a")
    one_board = {name: value for name, value in numbers("there", "recorded").items() if name != "table2"}
    text = index([numbers("here", "simulated"), one_board], {})
    recorded, simulated = text.split('<section id="simulated">')
    assert "never seen: multi-sensor" in simulated
    assert "No board was held out" in recorded


def test_a_scene_of_earlier_code_is_named_without_a_figure():
    old = numbers("old", "simulated")
    old.pop("trainings")
    text = index([old], {"old": SVG})
    assert "Out of date" in text
    assert "<figure" not in text
    assert "answer" not in text.split("</style>")[1]


def test_the_page_needs_nothing_but_the_pages_beside_it():
    text = index([numbers("here", "simulated")], {"here": SVG})
    addresses = re.findall(r'(?:src|href|data)="([^"]+)"', text)
    assert addresses
    assert all(address.startswith("here/") for address in addresses)
    assert "<script" not in text
    assert "url(" not in text

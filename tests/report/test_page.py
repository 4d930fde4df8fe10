"""Tests of the report page of a scene, and of the index page of all scenes."""

import html
import json
import os
import re
import shutil
import subprocess
from collections import Counter
from html.parser import HTMLParser
from itertools import pairwise
from pathlib import Path

import pandas as pd
import pytest

from pipeline.catalogue import ANALYSES
from pipeline.report.numbers import split
from pipeline.report.page import (
    EFFORTS,
    LEGIBLE_PX,
    STEPS_REM,
    about,
    about_scene,
    arrange,
    index,
    lay_out,
    measure,
    page,
    read_places,
    read_sections,
    run_page,
    unbroken,
)
from pipeline.report.tables import make_tables
from reskin.errors import SchemaError
from tests.report.synthetic import all_experiments, cost

ROOT = Path(__file__).resolve().parents[2]
SVG = (
    '<svg xmlns="http://www.w3.org/2000/svg" width="{}pt" height="200pt"><defs><path id="same"/></defs>'
    '<text style="font-size: 10px">é</text></svg>'
)
VOID = {"meta", "img", "br"}


class Reader(HTMLParser):
    """A parser that turns an HTML page into elements with attributes and ancestors.

    It fails if tags are not nested correctly.
    """

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.elements: list[tuple[str, dict, tuple[str, ...]]] = []
        self.words: list[str] = []
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs), tuple(self.open)))
        if tag not in VOID:
            self.open.append(f"{tag}.{dict(attrs).get('class', '')}")

    def handle_endtag(self, tag):
        assert self.open.pop().split(".")[0] == tag

    def handle_data(self, data):
        self.words.append(data.strip())

    def all(self, tag: str) -> list[tuple[dict, tuple[str, ...]]]:
        return [(attributes, above) for name, attributes, above in self.elements if name == tag]


def render(numbers: dict | None = None, **more: pd.DataFrame) -> str:
    numbers = all_experiments() if numbers is None else numbers
    # These experiments are omitted, because the synthetic numbers lack values that their tables need.
    plain = {name: value for name, value in numbers.items() if name not in ANALYSES}
    drift = pd.DataFrame({"contacts": ["0"], "accuracy, %": ["90"]})
    tables = make_tables(plain) | {"drift": drift} | more
    figures = {"drift.svg": SVG.format(300), "sweep_pokes.svg": SVG.format(600), "unheard_of.svg": SVG.format(300)}
    return page(split(numbers)[0], tables, figures)


def render_run(numbers: dict) -> str:
    return run_page(numbers, {"accuracy_and_cost.svg": SVG.format(300)})


@pytest.fixture(scope="module")
def read() -> Reader:
    return Reader(render(surprise=pd.DataFrame({"<b>": ["a & b", None], "n": ["1", "2"]})))


def test_page_loads_only_files_of_the_report_and_has_no_script(read):
    assert [one for one in ("script", "link", "svg") if read.all(one)] == []
    names = ("src", "href", "data")
    fetched = [attributes[name] for _, attributes, _ in read.elements for name in names if name in attributes]
    assert all(
        address.startswith(("figures/", "runtime/", "tables/", "provenance.json", "../", "#")) for address in fetched
    )
    assert "url(" not in render()
    assert "@import" not in render()


def test_links_lead_to_ids_that_exist_once(read):
    ids = Counter(attributes["id"] for _, attributes, _ in read.elements if "id" in attributes)
    assert max(ids.values()) == 1
    links = {attributes["href"] for attributes, _ in read.all("a")}
    assert {link[1:] for link in links if link.startswith("#")} <= set(ids)
    assert [link for link in links if link.startswith("../../") and not (ROOT / link[6:]).exists()] == [
        "../../pipeline/scenes/x.yaml"  # This file does not exist, because the scene is synthetic.
    ]
    labels = {attributes["aria-labelledby"] for _, attributes, _ in read.elements if "aria-labelledby" in attributes}
    assert labels <= set(ids)


def test_tables_have_captions_and_header_cells(read):
    tables = read.all("table")
    assert len(tables) > 8
    assert all(above[-1].startswith("div.box") for _, above in tables)
    assert len(read.all("caption")) == len(tables)
    assert all(attributes.get("scope") in ("col", "row") for attributes, _ in read.all("th"))


def test_rows_stacked_on_narrow_screens_keep_their_labels_and_roles(read):
    """On narrow screens, the cells of a row are below each other.

    Each cell then has a label, and roles keep the table's structure.
    """
    widths = {above[-1].rpartition(" ")[2] for _, above in read.all("table")}
    stacked = set(re.findall(r"\n[.](w\d+) tbody tr {", render()))
    assert widths <= stacked == {f"w{rem}" for rem in STEPS_REM}
    cells = read.all("td")
    assert len(cells) > 100
    assert all(attributes["data-label"].strip() and attributes["role"] == "cell" for attributes, _ in cells)
    roles = {"table": "table", "tbody": "rowgroup", "thead": "rowgroup", "tr": "row"}
    assert all(attributes["role"] == role for tag, role in roles.items() for attributes, _ in read.all(tag))


def test_tables_with_more_columns_are_stacked_at_larger_widths_of_the_screen():
    row = {f"column {i}": "12.3 [10.1, 14.5]" for i in range(9)}
    widths = [lay_out("t", "T", pd.DataFrame([dict([*row.items()][:n])])).width_rem for n in range(1, 10)]
    assert widths == sorted(widths)
    assert 20 < widths[2] < widths[8] < 90


def test_each_table_and_figure_of_the_paper_is_linked_from_the_top():
    places = read_places()
    shown = {name: SVG.format(300) for place in places for name in place.shown if name.endswith(".svg")}
    tables = {name: pd.DataFrame({"a": ["1"]}) for place in places for name in place.shown if name not in shown}
    text = page(split(all_experiments())[0], tables, shown)
    read, bar = Reader(text), text[text.index('<nav class="places"') :].partition("</nav>")[0]
    assert text.index(bar) < text.index("<main>")
    links = dict(re.findall(r'<a href="#([^"]+)"><b>([^<]+)</b>', bar))
    assert {f"table-{i}" for i in (1, 2)} | {f"figure-{i}{letter}" for i in (4, 5, 6) for letter in "ab"} <= set(links)
    ids = {attributes["id"]: tag for tag, attributes, _ in read.elements if "id" in attributes}
    assert all(ids[place.id] == ("details" if place.shown[0] in tables else "figure") for place in places)
    assert all(link.startswith("#") for link in re.findall('href="([^"]+)"', bar))
    # If a scene lacks one of these tables or figures, its page says so, and has no link to it.
    assert 'href="#figure-4a"' not in render()
    assert "not in this scene" in render()


def test_first_section_answers_questions_on_place_and_force(read):
    main = render().partition("<main>")[2]
    first = main.partition("</section>")[0]
    assert 'id="answer"' in first
    assert [word for word in ("Place", "Force") if f'<span class="quantity">{word}</span>' in first] == [
        "Place",
        "Force",
    ]


def test_no_level_of_headings_is_skipped(read):
    levels = [int(tag[1]) for tag, _, _ in read.elements if re.fullmatch(r"h[1-6]", tag)]
    assert levels[0] == 1
    assert levels.count(1) == 1
    assert all(after <= before + 1 for before, after in pairwise(levels))


def test_figures_have_texts_for_screen_readers(read):
    objects, images = read.all("object"), read.all("img")
    assert len(objects) == len(images) == 3
    assert all(attributes["aria-label"].strip() and above[-1] == "div.card" for attributes, above in objects)
    assert all(attributes["alt"].strip() and above[-1] == "object." for attributes, above in images)
    assert [attributes["data"] for attributes, _ in objects] == [attributes["src"] for attributes, _ in images]
    assert [attributes.get("class") for attributes, _ in read.all("figure")].count("wide") == 1


def test_section_shows_figures_then_tables():
    for part in render().split("<section id=")[1:]:
        places = [part.index(mark) for mark in ("<figure", "<details") if mark in part]
        assert places == sorted(places)


def test_width_below_which_a_figure_is_not_legible_is_computed():
    letters = '<svg width="300.0pt" height="150.0pt"><g style="font-size: 10px"/><g style="font: 6px Arial"/></svg>'
    drawing = measure("figures/a.svg", letters, "a")
    assert (drawing.width_px, drawing.height_px) == (400, 200)
    assert drawing.least_px == LEGIBLE_PX / 6 * 300  # The smallest text is 6 pt high, in a figure that is 300 pt wide.
    assert drawing.scrolls  # On a phone, the figure can be scrolled.
    assert not measure("figures/a.svg", letters.replace("6px", "9px"), "a").scrolls


def test_figure_that_states_no_size_is_refused():
    with pytest.raises(SchemaError, match=r"figures/a\.svg: the SVG has no size"):
        measure("figures/a.svg", '<svg viewBox="0 0 1 1"/>', "a")


@pytest.mark.parametrize(
    ("text", "kept"),
    [
        ("79.8 ± 8 [71.4, 88.3]", "79.8_±_8 [71.4,_88.3]"),
        ("+1 [-0.358, 2.43] points", "+1 [-0.358,_2.43] points"),
        ("0.5 [1e-05, 2e+03] mm²; x", "0.5 [1e-05,_2e+03]_mm²; x"),
        ("a ± b, [low, high]", "a ± b, [low, high]"),
        ("rms error 0.6 N, 78 % of 3 Names", "rms error 0.6_N, 78_% of 3 Names"),
    ],
)
def test_no_line_is_broken_within_a_number_and_its_unit(text, kept):
    assert unbroken(text) == kept.replace("_", "\u00a0")


def test_summary_of_results_is_in_the_first_section():
    text = render(all_experiments())
    first = text.split("<section")[1]
    assert text.count(EFFORTS) == first.count(EFFORTS) == 1


def test_section_about_the_scene_lists_counts():
    numbers = all_experiments()
    counts = next(iter(numbers["described"].values()))["counts"]
    counts.clear()
    counts.update(captures_n=1, readings_n=2000, indentations_n=0)
    assert about(numbers).endswith("Main captures: 1, with 2,000 readings.")


@pytest.mark.parametrize("source", ["simulated", "recorded"])
def test_badge_says_whether_data_are_simulated_or_recorded(source):
    text = render(all_experiments(source))
    assert f'<strong class="badge {source}">{source.upper()}</strong>' in text
    assert {"simulated": "RECORDED", "recorded": "SIMULATED"}[source] not in text


def test_page_begins_with_the_scene(read):
    place = next(i for i, word in enumerate(read.words) if "Main captures: 2, with 1,000 readings." in word)
    assert place < read.words.index(read_sections()[0].title)


def test_page_shows_and_escapes_tables_that_belong_to_no_section(read):
    assert "Surprise" in read.words
    assert "<b>" in read.words  # The tag is shown as text, and not interpreted.
    assert "a & b" in read.words
    assert "Unheard of (simulated)" in read.words


def test_table_without_rows_is_not_shown():
    assert 'id="surprise-table"' in render(surprise=pd.DataFrame({"a": ["1"]}))
    assert "surprise" not in render(surprise=pd.DataFrame({"a": []}))


def test_missing_experiment_has_no_section_on_the_page():
    keys = [section.key for section in arrange(["table2", "captures"], [])]
    assert keys == ["headline", "captures"]
    assert [section.key for section in arrange(["shear", "paired", "drift"], ["accuracy_and_cost.svg"])] == [
        "shear", "drift", "skins", "costs",
    ]  # fmt: skip


def test_page_about_the_run_has_provenance_and_run_times():
    numbers = all_experiments()
    text = Reader(render_run(numbers)).words
    provenance = numbers["provenance"] | {"versions": "numpy 1, torch 2"}
    assert set(provenance) <= set(text)
    assert {str(value) for value in provenance.values()} <= set(text)
    assert any("Cost of each stage" in word for word in text)
    assert [figure["data"] for figure, _ in Reader(render_run(numbers)).all("object")] == ["accuracy_and_cost.svg"]


def test_page_of_results_does_not_depend_on_the_run(read):
    assert "runtime/index.html" in [link["href"] for link, _ in read.all("a")]
    other = all_experiments()
    other["provenance"] |= {"git": "other", "trained": "other", "device": "other", "versions": {}, "seconds": 9.0}
    other["runtime"]["stages"] = {"report": cost(9.0), "drift": cost()}
    assert render(other) == render()
    assert render_run(other) != render_run(all_experiments())


def test_equal_results_give_an_equal_page():
    assert render() == render()


def test_numbers_without_deviations_are_right_aligned():
    table = pd.DataFrame({"a": ["x"], "b": ["1.5 ± 0.2"], "c": ["–"], "d": ["3 of 4"], "e": ["-0.1 mm²"]})
    assert lay_out("t", "T", table).looks == ["text", "text", "text", "text", "number"]


def test_text_between_backquotes_is_code_in_cells_and_notes():
    table = pd.DataFrame({"field": ["limits"], "value": ["Load it with `reskin.load_universal()` < 1 s"]})
    table.attrs["meaning"] = "Key `seeds` counts networks."
    shown = render(surprise=table)
    assert "with <code>reskin.load_universal()</code> &lt; 1 s" in shown
    assert "Key <code>seeds</code> counts networks." in shown


def test_notes_of_tables_are_shown(read):
    assert any("within 1 mm" in text for text in read.words)


def test_each_table_and_figure_is_in_one_section():
    sections = read_sections()
    named = Counter(name for section in sections for name in section.captions)
    assert max(named.values()) == 1
    assert len({section.key for section in sections}) == len(sections)


def luminance(colour: str) -> float:
    """Return the relative luminance of a colour (WCAG 2.2)."""
    parts = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    linear = [part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts]
    return sum(weight * part for weight, part in zip((0.2126, 0.7152, 0.0722), linear, strict=True))


def test_contrast_of_colours_meets_the_guidelines_of_wcag():
    text = render()
    light, dark, printed = (dict(zip(*[iter(part)] * 2, strict=True)) for part in colours(text))
    for theme in (light, light | dark, light | printed, light | dark | printed):
        inks = ("ink", "soft", "link", "yes", "partly", "no")
        pairs = [(ink, ground) for ink in inks for ground in ("paper",)] + [("ink", "band"), ("soft", "band")]
        for ink, ground in pairs:
            assert contrast(theme[ink], theme[ground]) >= 4.5  # This is the minimum of WCAG 2.2, level AA.
        for source in ("simulated", "recorded"):
            assert contrast("#ffffff", theme[source]) >= 4.5


def contrast(one: str, other: str) -> float:
    bright, dim = sorted((luminance(one), luminance(other)), reverse=True)
    return (bright + 0.05) / (dim + 0.05)


def colours(text: str) -> list[list[str]]:
    blocks = re.findall(r":root \{(.*?)\}", text, re.DOTALL)
    return [[word for pair in re.findall(r"--(\w+): (#\w{6})", block) for word in pair] for block in blocks]


HEADLINE_SVG = '<svg width="600.0pt" height="200.0pt"><text style="font-size: 9px">a</text></svg>'


def scene_numbers(scene: str, source: str) -> dict:
    found = all_experiments(source) | {"trainings": {}}
    return found | {"provenance": found["provenance"] | {"scene": scene}}


def test_recorded_scenes_come_first_in_the_index():
    text = index([scene_numbers("here", "simulated"), scene_numbers("there", "recorded")], {"here": HEADLINE_SVG})
    recorded, simulated = text.split('<section id="simulated">')
    assert 'href="there/index.html"' in recorded
    assert 'href="here/index.html"' in simulated
    assert "there/" not in simulated
    assert "here/" not in recorded.replace("there/", "")
    assert "there/figures" not in text  # Scene `there` has no figures.


def test_scenes_without_held_out_boards_come_last_in_the_index():
    # In alphabetical order, scene `a` would come before scene `here`. Scene `a` comes last, because it has no held-out
    # boards.
    alone = {name: value for name, value in scene_numbers("a", "simulated").items() if name != "table2"}
    both = index([alone, scene_numbers("here", "simulated")], {})
    assert both.index("Scene here") < both.index("Scene a")
    one_board = {name: value for name, value in scene_numbers("there", "recorded").items() if name != "table2"}
    text = index([scene_numbers("here", "simulated"), one_board], {})
    recorded, simulated = text.split('<section id="simulated">')
    assert f"{EFFORTS}</span>" in simulated
    assert "no board was held out" in recorded


def test_index_describes_each_scene_and_answers_on_place_and_force():
    text = index([scene_numbers("here", "simulated")], {}, {"here": "Two boards, pressed by `a rig`."})
    entry = text[text.index("Scene here") :].partition("</li>")[0]
    assert "Two boards, pressed by <code>a rig</code>." in entry
    assert "<small>simulated</small>" in entry
    place, force = re.findall(r'<p class="line">(.*?)</p>', entry)
    assert "Place" in place
    assert "within 1\u00a0mm" in place
    assert "Force" in force


def test_index_links_to_tables_and_figures_of_the_paper():
    shown = {"here": ["table1", "table2", "sweep_pokes.svg", "labels.svg"], "there": ["labels"]}
    text = index([scene_numbers("here", "simulated"), scene_numbers("there", "simulated")], {}, {}, shown)
    assert re.findall(r'href="(\w+/index.html#[^"]+)"', text) == [
        "here/index.html#table-2",
        "here/index.html#figure-6a",
    ]


@pytest.mark.parametrize("file", sorted((ROOT / "pipeline/scenes").glob("*.yaml")), ids=lambda file: file.stem)
def test_description_of_each_scene_begins_with_a_short_sentence(file):
    about = about_scene(file.read_text(encoding="utf-8"))
    assert about[0].isupper()
    assert not about.startswith("Scene")
    assert about.endswith(".")
    assert 20 < len(about) < 250


def test_index_loads_only_files_of_the_report_and_has_no_script():
    text = index([scene_numbers("here", "simulated")], {"here": HEADLINE_SVG})
    addresses = re.findall(r'(?:src|href|data)="([^"]+)"', text)
    assert addresses
    assert all(address.startswith("here/") for address in addresses)
    assert "<script" not in text
    assert "url(" not in text


NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
BROWSER = os.environ.get("RESKIN_BROWSER") or next(filter(None, map(shutil.which, NAMES)), None)
# Two frames of different widths show the page. The script writes the width of each page, and the elements that are too
# wide.
IN_FRAMES = """<!DOCTYPE html><body><script>
const page = {page}, found = [];
for (const px of [400, 1400]) {{
  const frame = document.createElement("iframe");
  frame.width = px; frame.height = 900; frame.srcdoc = page;
  frame.onload = () => {{
    const {{document: inside}} = frame.contentWindow, root = inside.documentElement;
    inside.querySelectorAll("details").forEach((one) => one.open = true);
    const boxes = [...inside.querySelectorAll(".box")].filter((box) => box.scrollWidth > box.clientWidth + 1);
    found.push([px, root.scrollWidth - root.clientWidth, boxes.length]);
    document.title = JSON.stringify(found);
  }};
  document.body.append(frame);
}}
</script></body>"""


@pytest.mark.skipif(BROWSER is None, reason=f"RESKIN_BROWSER is not set, and PATH has none of {NAMES}")
@pytest.mark.parametrize("one", ["scene", "all scenes"])
def test_nothing_is_wider_than_the_page_on_phones_and_desktops(one, tmp_path):
    wide = pd.DataFrame(
        {f"column {i} of a wide table": ["78.7 [72.1, 84.2]", "a sentence of several words"] for i in range(14)}
    )
    scenes = index([scene_numbers("here", "simulated"), scene_numbers("there", "recorded")], {})
    text = render(wide=wide) if one == "scene" else scenes
    file = tmp_path / "frames.html"
    file.write_text(IN_FRAMES.format(page=json.dumps(text).replace("</", r"<\/")), encoding="utf-8")
    flags = (
        "--headless=new",
        "--no-sandbox",
        "--disable-gpu",
        "--disable-dev-shm-usage",
        "--virtual-time-budget=20000",
    )
    command = [BROWSER, *flags, f"--user-data-dir={tmp_path / 'profile'}", "--dump-dom", file.as_uri()]
    shown = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True).stdout
    found = json.loads(html.unescape(re.search("<title>(.*?)</title>", shown)[1]))
    assert sorted(found) == [[400, 0, 0], [1400, 0, 0]]  # No page and no table can be scrolled sideways.

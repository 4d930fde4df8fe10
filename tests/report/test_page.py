"""Tests of the report pages: every committed scene renders, pages are whole, missing names are errors."""

import re
import shutil
from html.parser import HTMLParser

import pytest

from pipeline.report import page
from pipeline.report.page import Page, index_page, scene_page
from pipeline.report.tables import make_tables
from reskin import io
from reskin.code import ROOT
from reskin.errors import SchemaError

SVG = """<?xml version="1.0"?>
<svg viewBox="0 0 1 1"><defs><path id="p"/></defs><use href="#p" clip-path="url(#p)"/></svg>"""
SCENES = sorted(file.parent.name for file in (ROOT / "reports").glob("*/numbers.json"))


class Reader(HTMLParser):
    """Collects ids, links within the page, addresses of loaded files, and open tags."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.ids: list[str] = []
        self.links: list[str] = []
        self.loaded: list[str] = []
        self.tags: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        found = dict(attrs)
        self.tags.append(tag)
        self.ids += [found["id"]] if "id" in found else []
        self.links += [found["href"][1:]] if found.get("href", "").startswith("#") else []
        self.loaded += [found["src"]] if "src" in found else []


def figures_of(template: str) -> dict[str, str]:
    """Return a drawing for every figure that a template names."""
    text = "".join(file.read_text() for file in page.FOLDER.glob(template))
    return {f"{name}.svg": SVG for name in re.findall(r'(?:figure\(|\()"(\w+)"', text)}


def rendered(scene: str) -> str:
    numbers = io.read_json(ROOT / "reports" / scene / "numbers.json")
    return scene_page(numbers, make_tables(numbers), figures_of("*.md"))


@pytest.mark.parametrize("scene", SCENES)
def test_page_of_each_committed_scene_is_whole(scene):
    html = rendered(scene)
    read = Reader(html)
    assert len(read.ids) == len(set(read.ids))
    assert set(read.links) <= set(read.ids)
    assert not read.loaded
    assert not {"script", "link"} & {*read.tags}
    assert not re.search("\x02|{{", html)
    numbers = io.read_json(ROOT / "reports" / scene / "numbers.json")
    assert numbers["provenance"]["source"].upper() in html


def test_page_shows_the_numbers_of_the_scene():
    numbers = io.read_json(ROOT / "reports/quick/numbers.json")
    numbers["table2"]["adapted"]["accuracy_pct"] = {"mean": 71.64, "n": 6, "ci95": [61.4, 79.3]}
    html = scene_page(numbers, {}, figures_of("*.md"))
    assert "72 [61, 79] %" in html


def test_name_that_does_not_exist_is_an_error_that_names_the_file(tmp_path, monkeypatch):
    (tmp_path / "broken.md").write_text("one\n\n{{ numbers.table3.accuracy }}\n")
    monkeypatch.setattr(page, "FOLDER", tmp_path)
    with pytest.raises(SchemaError, match=r"broken\.md, line 3: .*table3"):
        Page({"table2": 1}).fill("broken.md")


def test_index_lists_every_scene_once_for_each_result():
    results = [io.read_json(ROOT / "reports" / scene / "numbers.json") for scene in SCENES]
    html = index_page([one for one in results if "described" in one])
    assert all(f'href="{scene}/index.html"' in html for scene in SCENES if scene != "tuning")


@pytest.mark.skipif(shutil.which("chromium") is None, reason="needs chromium")
@pytest.mark.parametrize("width_px", [1400, 400])
def test_nothing_is_wider_than_the_window(tmp_path, width_px):
    import subprocess

    (tmp_path / "page.html").write_text(rendered("quick"))
    frame = (
        f'<iframe src="page.html" style="border:0;width:{width_px}px;height:900px" onload="document.title='
        'this.contentDocument.documentElement.scrollWidth-this.contentDocument.documentElement.clientWidth"></iframe>'
    )
    (tmp_path / "frame.html").write_text(frame)
    flags = [
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--disable-background-networking",
        "--virtual-time-budget=3000",
    ]
    command = ["chromium", *flags, "--allow-file-access-from-files", f"--user-data-dir={tmp_path}/user", "--dump-dom"]
    done = subprocess.run([*command, f"file://{tmp_path}/frame.html"], capture_output=True, text=True, check=True)
    assert "<title>0</title>" in done.stdout

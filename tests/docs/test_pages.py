"""Tests of the docs: settings in examples are valid, links and named files exist."""

import re
from pathlib import Path

import pytest
from ruamel.yaml import YAML

from pipeline.scenes import check_scene
from pipeline.settings import Settings, read_shared_files

ROOT = Path(__file__).resolve().parents[2]


def test_scene_and_recipe_of_the_docs_are_valid():
    page, recipe = (
        (ROOT / f"docs/add-a-{name}.md").read_text(encoding="utf-8").split("```yaml\n")[1].split("```")[0]
        for name in ("scene", "recipe")
    )
    settings = YAML(typ="safe").load(page) | YAML(typ="safe").load(recipe)
    check_scene(Settings("tiny", "docs", settings, read_shared_files(ROOT)))


@pytest.mark.parametrize(
    "page", [*sorted((ROOT / "docs").glob("*.md")), ROOT / "README.md"], ids=lambda page: page.name
)
def test_files_named_in_docs_exist(page):
    files = re.findall(r"`((?:reskin|pipeline)/[\w./-]+)`", page.read_text(encoding="utf-8"))
    examples = re.compile(r".*/(test_)?(repeat|tiny)[./].*")  # Files of examples, which users create.
    assert sorted({name for name in files if not (ROOT / name).exists() and not examples.match(name)}) == []


def test_links_in_the_docs_are_valid():
    broken = []
    for page in [ROOT / "README.md", *(ROOT / "docs").glob("*.md"), ROOT / "data/README.md"]:
        for link in re.findall(r"\]\(([^)#\s]+)[^)]*\)", page.read_text(encoding="utf-8")):
            if "://" not in link and not (page.parent / link).exists():
                broken.append(f"{page.name}: {link}")
    assert broken == []

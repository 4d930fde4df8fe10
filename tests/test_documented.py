"""Tests that the docs name all parameters, columns and numbers, and only files that exist."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

from pipeline.scenes import check_scene
from pipeline.settings import Settings, read_shared_files

ROOT = Path(__file__).resolve().parents[1]
# Sections whose keys are names of entries (such as recipes or boards), not parameters.
NAMED = {"situations", "recipes", "adaptations", "labellings", "boards", "protocols", "variants", "rules"}


def keys(settings: Any, names_depth: int = 0) -> Iterator[str]:
    """Yield the keys of nested settings. Keys of the first `names_depth` levels are names and are omitted."""
    for key, value in settings.items() if isinstance(settings, dict) else ():
        if not names_depth:
            yield key
        levels_n = 1 if key in NAMED else 0
        yield from keys(value, max(levels_n, names_depth - 1))


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
    files = re.findall(r"`((?:reskin|pipeline|tests)/[\w./-]+)`", page.read_text(encoding="utf-8"))
    examples = re.compile(r".*/(test_)?(repeat|tiny)[./].*")  # Files of examples, which users create.
    assert sorted({name for name in files if not (ROOT / name).exists() and not examples.match(name)}) == []

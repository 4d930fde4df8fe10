"""Tests that the docs name all parameters, columns and numbers, and only files that exist."""

import re
from collections.abc import Iterator
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

from pipeline.catalogue import EXPERIMENTS
from pipeline.manage.new import scene_text
from pipeline.scenes import check_scene
from pipeline.scores import KEYS
from pipeline.settings import Settings, read_shared_files
from reskin import io
from reskin.config import read_yaml
from reskin.data.rows import TARGETS
from reskin.metrics import METRICS
from reskin.schema import UNITS, arrow_schema
from reskin.simulation.defaults import NOMINAL

ROOT = Path(__file__).resolve().parents[1]
SETTINGS = [ROOT / "params.yaml", NOMINAL, *sorted((ROOT / "pipeline/scenes").glob("*.yaml"))]
# Sections whose keys are names of entries (such as recipes or boards), not parameters.
NAMED = {"situations", "recipes", "adaptations", "labellings", "boards", "protocols", "variants", "rules"}

# Names of rows, boards, captures and stages, which are not documented individually.
NAME = re.compile(r".* .*|[0-9]+|[bf][0-9](_s[0-9].*)?|board[0-9].*|(ingest|simulate).*|knn-.*|shape|released")


def code_words(page: str) -> set[str]:
    text = re.sub(r"```.*?```", "", (ROOT / page).read_text(encoding="utf-8"), flags=re.DOTALL)
    return set(re.findall(r"`([^`]+)`", text))


def keys(settings: Any, names_depth: int = 0) -> Iterator[str]:
    """Yield the keys of nested settings. Keys of the first `names_depth` levels are names and are omitted."""
    for key, value in settings.items() if isinstance(settings, dict) else ():
        if not names_depth:
            yield key
        levels_n = 1 if key in NAMED else 0
        yield from keys(value, max(levels_n, names_depth - 1))


@pytest.mark.parametrize("file", SETTINGS, ids=lambda file: file.stem)
def test_parameters_of_all_files_of_settings_are_documented(file):
    assert sorted(set(keys(read_yaml(file))) - code_words("docs/parameters.md")) == []


def test_parameters_of_new_scenes_are_documented():
    scene = YAML(typ="safe").load(scene_text("mine", ["b1", "b2"], 60, 2, "reskin"))
    check_scene(Settings("mine", "mine.yaml", scene, read_shared_files(ROOT)))
    assert sorted(set(keys(scene)) - code_words("docs/parameters.md")) == []


def test_columns_of_readings_are_documented_with_units():
    lines = (ROOT / "data/README.md").read_text(encoding="utf-8").splitlines()
    rows = [line for line in lines[lines.index("## `indentations/<scene>/<capture>.parquet`") :] if line[:2] == "| "]
    for name in arrow_schema(5).names:
        line = next(line for line in rows if f"`{name}`" in line)
        assert UNITS.get(name, "") == line.split("|")[3].strip()


def test_columns_of_predictions_and_scores_are_documented():
    columns = {f"{side}_{name}" for side in ("true", "predicted") for name in TARGETS}
    assert sorted(columns.union(KEYS, METRICS) - code_words("data/README.md")) == []


def number_names(settings: Any) -> Iterator[str]:
    for value in settings.values() if isinstance(settings, dict) else settings if isinstance(settings, list) else ():
        yield from number_names(value)
    yield from settings if isinstance(settings, dict) else ()


def test_keys_of_numbers_json_are_documented():
    known = code_words("docs/numbers.md")
    patterns = [word for word in known if "*" in word]
    chosen = {
        *EXPERIMENTS,
        *read_yaml(ROOT / "dvc.yaml")["stages"],
        *read_yaml(ROOT / "params.yaml")["recipes"],
    }
    chosen |= {name for file in SETTINGS[1:] for name in read_yaml(file).get("simulate", {}).get("protocols", ())}
    found = {key for file in (ROOT / "reports").glob("*/numbers.json") for key in number_names(io.read_json(file))}
    unknown = {key for key in found - known - chosen if not NAME.fullmatch(key)}
    assert sorted(key for key in unknown if not any(fnmatch(key, pattern) for pattern in patterns)) == []


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

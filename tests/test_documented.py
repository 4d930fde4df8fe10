"""Docs name all parameters, columns and numbers, and only files that exist."""

import re
from collections.abc import Iterator
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

from pipeline.scenes import EXPERIMENTS, check_scene
from pipeline.settings import Settings, read_shared_files
from pipeline.statistics import KEYS, UNCERTAINTY
from reskin import io
from reskin.config import read_yaml
from reskin.data.rows import TARGETS
from reskin.metrics import METRICS
from reskin.schema import UNITS, arrow_schema
from reskin.simulation.defaults import NOMINAL

ROOT = Path(__file__).resolve().parents[1]
SETTINGS = [ROOT / "params.yaml", NOMINAL, *sorted((ROOT / "pipeline/scenes").glob("*.yaml"))]
NAMED = {"recipes", "adaptations", "labellings", "boards", "protocols", "variants", "rules"}  # below: names of rows

# Names of rows, boards, captures, stages: no key with a meaning of its own.
NAME = re.compile(r".* .*|[0-9]+|[bf][0-9](_s[0-9].*)?|board[0-9].*|(ingest|simulate).*|knn-.*|shape|released")


def words_of(page: str) -> set[str]:
    text = re.sub(r"```.*?```", "", (ROOT / page).read_text(encoding="utf-8"), flags=re.DOTALL)
    return set(re.findall(r"`([^`]+)`", text))


def keys(words: Any, depth: int = 0) -> Iterator[str]:
    """Give the keys of nested settings; those that somebody chose as the name of a row are passed over."""
    for key, value in words.items() if isinstance(words, dict) else ():
        if not depth:
            yield key
        sets = 2 if key == "methods" else 1 if key in NAMED else 0
        yield from keys(value, max(sets, depth - 1))


@pytest.mark.parametrize("file", SETTINGS, ids=lambda file: file.stem)
def test_parameters_are_documented(file):
    assert sorted(set(keys(read_yaml(file))) - words_of("docs/parameters.md")) == []


def test_every_column_of_readings_is_documented_with_its_unit():
    lines = (ROOT / "data/README.md").read_text(encoding="utf-8").splitlines()
    rows = [line for line in lines[lines.index("## `indentations/<scene>/<capture>.parquet`") :] if line[:2] == "| "]
    for name in arrow_schema(5).names:
        line = next(line for line in rows if f"`{name}`" in line)
        assert UNITS.get(name, "") == line.split("|")[3].strip()


def test_every_column_of_predictions_and_scores_is_documented():
    told = {f"{side}_{name}" for side in ("true", "predicted") for name in TARGETS}
    assert sorted(told.union(KEYS, METRICS, UNCERTAINTY) - words_of("data/README.md")) == []


def numbers(words: Any) -> Iterator[str]:
    for value in words.values() if isinstance(words, dict) else words if isinstance(words, list) else ():
        yield from numbers(value)
    yield from words if isinstance(words, dict) else ()


def test_every_number_is_documented():
    known = words_of("docs/numbers.md")
    patterns = [word for word in known if "*" in word]
    chosen = {
        *EXPERIMENTS,
        *(one.key for one in EXPERIMENTS.values()),
        *read_yaml(ROOT / "dvc.yaml")["stages"],
        *read_yaml(ROOT / "params.yaml")["recipes"],
    }
    chosen |= {name for file in SETTINGS[1:] for name in read_yaml(file).get("simulate", {}).get("protocols", ())}
    found = {key for file in (ROOT / "reports").glob("*/numbers.json") for key in numbers(io.read_json(file))}
    unknown = {key for key in found - known - chosen if not NAME.fullmatch(key)}
    assert sorted(key for key in unknown if not any(fnmatch(key, pattern) for pattern in patterns)) == []


def test_the_scene_that_docs_show_is_legal_with_the_recipe_that_they_show():
    page, recipe = (
        (ROOT / f"docs/add-a-{name}.md").read_text(encoding="utf-8").split("```yaml\n")[1].split("```")[0]
        for name in ("scene", "recipe")
    )
    words = YAML(typ="safe").load(page) | YAML(typ="safe").load(recipe)
    check_scene(Settings("tiny", "docs", words, read_shared_files(ROOT)))


@pytest.mark.parametrize(
    "page", [*sorted((ROOT / "docs").glob("*.md")), ROOT / "README.md"], ids=lambda page: page.name
)
def test_files_that_docs_name_exist(page):
    named = re.findall(r"`((?:reskin|pipeline|tests)/[\w./-]+)`", page.read_text(encoding="utf-8"))
    examples = re.compile(r".*/(test_)?(repeat|tiny)[./].*")  # that a page tells how to add
    assert sorted({name for name in named if not (ROOT / name).exists() and not examples.match(name)}) == []

"""Tests of README.md and docs: links, anchors and paths exist, commands parse, and marked examples run."""

import contextlib
import importlib.util
import io
import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import matplotlib.pyplot as plt
import numpy as np
import pytest
import typer
from dvc.cli.parser import get_main_parser
from ruamel.yaml import YAML

import pipeline.cli
import reskin
import reskin.cli
from pipeline.scenes import check_scene
from pipeline.scores import KEYS
from pipeline.settings import Settings, read_shared_files
from reskin.board.other_firmware import read_wire
from reskin.data.rows import TARGETS
from reskin.metrics import METRICS
from reskin.recordings.column_map import read_map
from reskin.schema import UNITS, arrow_schema
from tests.stages.checkout import ROOT
from tests.universal.skins import draw

PAGES = [ROOT / "README.md", ROOT / "CHANGELOG.md", ROOT / "data/README.md", *sorted((ROOT / "docs").glob("*.md"))]
FOLDERS = "reskin|pipeline|tests|tools|deploy|examples|release"
EXAMPLE = re.compile(r".*\b(mine|ini-recorded|repeat|test_repeat|tiny|tutorial)\b.*")  # files that users create
SEPARATOR = re.compile(r"[();<>|&]+")
INCOMPLETE = {
    "BadParameter",
    "MissingParameter",
    "BadOptionUsage",
    "NoArgsIsHelpError",
}  # allowed in sentences, but not in blocks

apps = [typer.main.get_command(app) for app in (reskin.cli.app, pipeline.cli.app)]
COMMANDS = {name: command for app in apps for name, command in app.commands.items()}
every_page = pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))


def blocks(page: Path, info: str) -> list[str]:
    """Return the blocks of code whose opening fence matches `info`."""
    found = re.findall(r"^ *```(\S+(?: \S+)?)\n(.*?)^ *```", page.read_text("utf-8"), re.DOTALL | re.MULTILINE)
    return [code for name, code in found if re.fullmatch(info, name)]


def prose(page: Path) -> str:
    return re.sub(r"^ *```.*?^ *```", "", page.read_text("utf-8"), flags=re.DOTALL | re.MULTILINE)


def anchors(page: Path) -> set[str]:
    """Return the anchors that GitHub gives to the headings of a page."""
    headings = re.findall(r"^#+ (.*)$", prose(page), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", [*PAGES, ROOT / "docs/notebook.ipynb"], ids=lambda page: page.name)
def test_links_and_anchors_exist(page):
    broken = []
    for link in re.findall(r"\]\(([^)\s]+)\)", prose(page)):
        name, _, anchor = link.partition("#")
        target = page.parent / name if name else page
        if "://" not in link and (not target.exists() or (anchor and anchor not in anchors(target))):
            broken.append(link)
    assert broken == []


@every_page
def test_paths_exist(page):
    paths = re.findall(rf"(?<![\w/.])(?:{FOLDERS})/[\w./-]*\w", page.read_text("utf-8"))
    if page.name == "CHANGELOG.md":
        return  # it also names what was removed
    assert sorted({path for path in paths if not (ROOT / path).exists() and not EXAMPLE.fullmatch(path)}) == []


def test_pages_that_the_code_names_exist():
    files = [file for folder in FOLDERS.split("|") for file in (ROOT / folder).rglob("*.*")]
    texts = [file.read_text("utf-8") for file in files if file.suffix in {".py", ".yaml", ".sh", ".js", ".md"}]
    named = {page for text in texts for page in re.findall(r"docs/[\w/-]+\.\w+", text)}
    assert named
    assert sorted(page for page in named if not (ROOT / page).exists()) == []


def in_blocks(page: Path) -> Iterator[list[str]]:
    """Yield the words of each command in the shell blocks of a page."""
    for line in "\n".join(blocks(page, "sh|bash")).replace("\\\n", " ").splitlines():
        words = shlex.shlex(line, posix=True, punctuation_chars=True)
        words.whitespace_split = True
        yield from split(list(words))


def split(words: list[str]) -> Iterator[list[str]]:
    """Split words at `;`, `&&` and the like; omit what may stand before a command."""
    ends = [i for i, word in enumerate(words) if SEPARATOR.fullmatch(word)]
    for begin, end in zip([0, *(i + 1 for i in ends)], [*ends, len(words)], strict=True):
        part = words[begin:end]
        while part and (part[0] in {"do", "then"} or re.fullmatch(r"\w+=.*", part[0])):
            part = part[1:]
        if part:
            yield part


def in_sentences(page: Path) -> Iterator[list[str]]:
    for code in re.findall(r"`([^`]+)`", prose(page)):
        if not re.search(r"\.\.\.|, ", code):
            with contextlib.suppress(ValueError):  # not a command: unbalanced quotes
                yield from split(shlex.split(code))


def fault_of(words: list[str], *, complete: bool) -> str | None:
    """Return why a command cannot work, or None."""
    program, *arguments = words
    try:
        if program == "reskin" and arguments and not arguments[0].startswith("-"):
            parse(reskin.cli.with_default_simulation(arguments))
        elif program == "dvc" and complete:
            with contextlib.redirect_stderr(io.StringIO()):
                get_main_parser().parse_args(arguments)
        elif program == "make" and arguments:
            targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text("utf-8"), re.MULTILINE)
            assert {*arguments} <= {*targets, ".venv/.installed"}, "no such target"
        elif program.startswith("python") and arguments[:1] == ["-m"]:
            if re.match(FOLDERS, arguments[1]):
                assert importlib.util.find_spec(arguments[1]), "no such module"
    except (Exception, SystemExit) as error:
        if complete or type(error).__name__ not in INCOMPLETE:
            return f"{' '.join(words)}: {type(error).__name__} {error}"
    return None


def parse(arguments: list[str]) -> None:
    """Parse the arguments of `reskin` without running the command."""
    known = COMMANDS
    while known and arguments:
        name, *arguments = arguments
        assert name in known, f"no command {name}"
        command, known = known[name], getattr(known[name], "commands", {})
    if not known:
        command.make_context(name, arguments)


@every_page
def test_commands_parse(page, monkeypatch):
    monkeypatch.setattr("sys.argv", ["dvc"])  # DVC's parser also reads it
    if page.name == "CHANGELOG.md":
        return
    faults = [fault_of(words, complete=True) for words in in_blocks(page)]
    faults += [fault_of(words, complete=False) for words in in_sentences(page)]
    assert [fault for fault in faults if fault] == []


def test_wrong_commands_are_found(monkeypatch):
    monkeypatch.setattr("sys.argv", ["dvc"])
    wrong = [
        "reskin live --no-such-option",
        "reskin nothing",
        "dvc repro --nothing",
        "make nothing",
        "python -m tests.x",
    ]
    assert all(fault_of(shlex.split(command), complete=True) for command in wrong)
    assert fault_of(["reskin", "remove", "lab"], complete=True)


@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page, "python run")], ids=lambda page: page.name)
def test_marked_examples_run(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    plt.switch_backend("Agg")
    skin = draw(12)[0]
    variables = {
        "noload_uT": skin.rest_uT + np.zeros((50, 1)), "presses_uT": skin.b_uT[:40], "b_uT": skin.b_uT[60:],
        "place_mm": skin.place_mm[40:60], "force_N": skin.force_N[40:60], "labelled_uT": skin.b_uT[40:60],
    }  # fmt: skip
    try:
        for block in blocks(page, "python run"):
            exec(compile(block.replace("steps_n=800", "steps_n=4"), page.name, "exec"), variables)
    finally:
        plt.close("all")


def test_example_of_a_robot_records_labels(monkeypatch):
    moved, recorded = [], []
    robot = SimpleNamespace(
        places_in_random_order=lambda: [(4.0, 8.0), (0.0, 2.0)], lift_and_go_to=lambda *place: moved.append(place),
        press=lambda: moved.append("press"), force_N=lambda: 0.5,
    )  # fmt: skip
    monkeypatch.setattr(reskin, "record", lambda labels, **options: recorded.extend([*labels, options]))
    (example,) = blocks(ROOT / "docs/add-your-data.md", "python robot")
    exec(example, {"robot": robot})
    assert moved == [(4.0, 8.0), "press", (0.0, 2.0), "press"]
    assert (recorded[1].x_mm, recorded[1].Fz_N, recorded[0].contact) == (4.0, 0.5, False)


def test_scene_and_recipe_of_the_docs_are_valid():
    page = ROOT / "docs/extend.md"
    scene, recipe = (YAML(typ="safe").load(blocks(page, f"yaml {name}")[0]) for name in ("scene", "recipe"))
    check_scene(Settings("tiny", "docs", scene | recipe, read_shared_files(ROOT)))


def test_column_map_and_wire_format_of_the_docs_are_valid(tmp_path):
    readers = {"add-your-data": ("columns", read_map), "live": ("wire", lambda file: read_wire(str(file)))}
    for page, (name, read) in readers.items():
        file = tmp_path / f"{name}.yaml"
        file.write_text(blocks(ROOT / f"docs/{page}.md", f"yaml {name}")[0], encoding="utf-8")
        assert read(file)


def test_columns_of_data_are_documented_with_units():
    text = prose(ROOT / "data/README.md")
    lines = text.splitlines()
    rows = [line for line in lines[lines.index("## `indentations/<scene>/<capture>.parquet`") :] if line[:2] == "| "]
    for name in arrow_schema(5).names:
        assert UNITS.get(name, "") == next(line for line in rows if f"`{name}`" in line).split("|")[3].strip()
    columns = {f"{side}_{name}" for side in ("true", "predicted") for name in TARGETS}
    assert sorted(columns.union(KEYS, METRICS) - set(re.findall(r"`([^`]+)`", text))) == []

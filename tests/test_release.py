"""Tests of the release: files in the wheel, version, licences, required packages."""

import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import grimp
import pytest

from pipeline.cli import app as checkout
from release.licences import TOLERATED, closure, incompatible, is_compatible, wanted
from reskin.cli import CHECKOUT_COMMANDS, add_checkout_commands
from reskin.config import read_yaml
from reskin.errors import ParamsError

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
CORE = (  # modules that work outside a checkout
    "reskin.cli", "reskin", "reskin.api", "reskin.recordings.recorder", "reskin.recordings.decode", "reskin.board.find",
    "reskin.predicting", "reskin.live.emulator", "reskin.live.server",
)  # fmt: skip
OPTIONAL = (
    "dvc",
    "grimp",
    "jinja2",
    "markdown-it-py",
    "magpylib",
    "matplotlib",
    "mlflow",
    "mpmath",
    "onnx",
    "pandas",
    "sklearn",
    "torch",
)
# Program that imports the modules of CORE as if optional packages were not installed.
WITHOUT_OPTIONAL = """
import importlib, sys

class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {missing}:
            raise ModuleNotFoundError(name, name=name)

sys.meta_path.insert(0, Missing())
for name in {core}:
    importlib.import_module(name)
from reskin.universal.model import load_universal
print(load_universal().zero([0.0] * 15).predict([[0.0] * 15]).shape)
"""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    """Return a folder with the files that setuptools puts into the wheel."""
    folder = tmp_path_factory.mktemp("wheel")
    arguments = ["-q", "egg_info", "-e", str(folder), "build_py", "-d", str(folder / "lib")]
    subprocess.run(
        [sys.executable, "-W", "ignore", "-c", "import setuptools; setuptools.setup()", *arguments],
        cwd=ROOT,
        check=True,
        capture_output=True,
    )
    return folder / "lib"


def test_wheel_contains_only_the_library(wheel):
    names = {str(file.relative_to(wheel)) for file in wheel.rglob("*") if file.is_file()}
    files = [file.relative_to(ROOT) for file in (ROOT / "reskin").rglob("*.*")]
    assert names == {str(file) for file in files if not any(part.startswith((".", "__pyc")) for part in file.parts)}
    assert {
        "reskin/py.typed",
        "reskin/simulation/nominal.yaml",
        "reskin/live/page/live.js",
        "reskin/universal/universal.safetensors",
    } <= names


def test_third_party_scripts_have_a_licence_file(wheel):
    foreign = [file for file in wheel.rglob("*.js") if len(max(file.read_text().splitlines(), key=len)) > 500]
    assert [file.name for file in foreign if not list(file.parent.glob(f"{file.name}.LICENSE*"))] == []


def test_library_imports_only_required_packages():
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_OPTIONAL.format(core=CORE, missing=OPTIONAL)],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert done.stdout == "(1, 3)\n", done.stderr


def test_imported_packages_are_declared():
    graph = grimp.build_graph("pipeline", "reskin", include_external_packages=True, cache_dir=None)
    names = {module.partition(".")[0] for module in graph.modules}
    imported = names - sys.stdlib_module_names - {"pipeline", "reskin"}
    known = {"sklearn": "scikit-learn", "serial": "pyserial", "ruamel": "ruamel.yaml", "markdown_it": "markdown-it-py"}
    lines = [line for extra in (None, "train", "pipeline", "onnx", "dask") for line in wanted(extra)]
    required = {re.split(r"[\[<>=]", line)[0] for line in lines}
    assert {known.get(name, name) for name in imported} <= required


def test_version_is_the_same_everywhere():
    citation = read_yaml(ROOT / "CITATION.cff")
    top = re.search(r"^## (\S+) \((\S+)\)", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert (citation["version"], citation["date-released"]) == top.groups()
    assert (citation["version"], citation["license"]) == (PROJECT["version"], PROJECT["license"])


def test_licences_of_all_required_packages_are_compatible():
    assert set(incompatible(closure(wanted("dev")))) == set(TOLERATED)  # also fails if an exception is no longer needed
    assert closure(wanted()).keys() & TOLERATED.keys() == set()


@pytest.mark.parametrize(
    ("licence", "compatible"),
    [
        ("MIT", True), ("Apache-2.0 WITH LLVM-exception AND BSD-2-Clause", True), ("GPL-3.0-only OR MIT", True),
        ("GPL-3.0-only", False), ("MIT AND AGPL-3.0", False), ("GNU Lesser General Public License", False),
        ("Proprietary", False), ("", False), ("my own words", False), ("MIT AND my own words", False),
        ("(MIT OR GPL-3.0-only) AND my own words", False), ("BSD-3-Clause AND (MIT OR GPL-3.0-only)", True),
        ("MIT License; my own words", False), ("BSD License (3-clause)", True),
    ],
)  # fmt: skip
def test_licence_is_compatible_if_one_of_its_alternatives_is(licence, compatible):
    assert is_compatible(licence) is compatible


def test_checkout_is_not_run_with_the_library_of_another_one(tmp_path):
    for name in ("pipeline", "reskin"):
        shutil.copytree(ROOT / name, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "dvc.yaml", tmp_path)
    program = f"import sys; sys.path[0] = {str(ROOT)!r}; from reskin.cli import main; main()"
    for arguments, status in ((("new", "x", "--boards", "a,b", "--presses", "9"), 2), (("--version",), 0)):
        command = [sys.executable, "-c", program, *arguments]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode == status
        assert ("cannot be run with the library of" in done.stderr) == (status == 2)
        assert "Traceback" not in done.stderr


def test_list_of_checkout_commands_is_complete():
    names = {one.name or one.callback.__name__.replace("_", "-") for one in checkout.registered_commands}
    assert {"scenes", "model", *names} == {*CHECKOUT_COMMANDS}


@pytest.mark.parametrize("name", CHECKOUT_COMMANDS)
def test_checkout_commands_raise_outside_a_checkout(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["reskin", name, "any.csv"])
    with pytest.raises(ParamsError, match=f"reskin {name} must be run in a checkout of the project"):
        add_checkout_commands()

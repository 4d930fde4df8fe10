"""Tests of the release: files in the wheel, version, licences, required packages."""

import re
import subprocess
import sys
import tomllib
from importlib.metadata import PathDistribution
from pathlib import Path

import grimp
import pytest
from packaging.specifiers import SpecifierSet

from pipeline.cli import app as checkout
from release import constraints
from release.constraints import render
from release.licences import TOLERATED, closure, incompatible, is_compatible, wanted
from reskin import io
from reskin.cli import CHECKOUT_COMMANDS, add_checkout_commands
from reskin.config import read_yaml
from reskin.errors import ParamsError, explaining, require

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


def test_error_for_a_missing_package_names_the_extra_that_installs_it():
    with pytest.raises(
        ParamsError, match=r"model.safetensors: the Python package `nowhere` is not installed.*\[pipeline\]"
    ):
        require("nowhere", "model.safetensors")
    with pytest.raises(ParamsError, match=r"package `torch` is not installed.*'\.\[train\]'"), explaining("reskin"):
        raise ModuleNotFoundError("", name="torch.nn")
    for package, extra in (("distributed.client", "dask"), ("dask", "dask"), ("psycopg2", "team"), ("onnx", "onnx")):
        name = package.partition(".")[0]
        message = rf"package `{name}` is not installed.*'\.\[{extra}\]'"
        assert extra in PROJECT["optional-dependencies"]
        with pytest.raises(ParamsError, match=message), explaining("train_multi"):
            raise ModuleNotFoundError("", name=package)
    with pytest.raises(ModuleNotFoundError), explaining("reskin"):
        raise ModuleNotFoundError("", name="pipeline.gone")


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


def test_supported_versions_of_python_are_the_same_everywhere():
    classified = re.findall(r"Python :: (3\.\d+)", " ".join(PROJECT["classifiers"]))
    (made,) = re.findall(r"for version in (.*); do", (ROOT / "tools/test_pythons.sh").read_text(encoding="utf-8"))
    workflow = read_yaml(ROOT / ".github/workflows/test.yml")
    assert made.split() == workflow["jobs"]["test"]["strategy"]["matrix"]["python"] == classified
    supported = SpecifierSet(PROJECT["requires-python"])
    assert [f"3.{minor}" for minor in range(9, 20) if f"3.{minor}" in supported] == classified
    (container,) = re.findall(
        r"^FROM python:(3\.\d+)", (ROOT / "deploy/Containerfile").read_text("utf-8"), re.MULTILINE
    )
    assert container in classified


def test_licences_of_all_required_packages_are_compatible():
    assert set(incompatible(closure(wanted("dev")))) == set(TOLERATED)  # also fails if an exception is no longer needed
    assert closure(wanted()).keys() & TOLERATED.keys() == set()


def test_licences_of_gpu_packages_that_torch_needs_are_ignored(tmp_path):
    def package(name: str) -> PathDistribution:
        folder = tmp_path / f"{name}-1.dist-info"
        io.write_text(folder / "METADATA", f"Name: {name}\nLicense: Proprietary\n")
        return PathDistribution(folder)

    packages = {name: package(name) for name in ("nvidia-cublas", "cuda-toolkit", "other")}
    assert incompatible(packages) == {"other": "Proprietary"}


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


def test_constraints_are_replaced_atomically(tmp_path, monkeypatch):
    file, old = tmp_path / "constraints.txt", tmp_path / "old"
    file.write_text("torch==1.0\n")
    old.hardlink_to(file)
    monkeypatch.setattr(sys, "argv", ["constraints", str(file)])
    monkeypatch.setattr(constraints, "resolve", lambda python, wanted: {"torch": "2.0"})
    constraints.main()
    assert file.read_text().endswith("torch==2.0\n")
    assert old.read_text() == "torch==1.0\n"


def test_constraints_omit_reskin_and_gpu_packages():
    lines = render({"torch": "2.0", "Attrs": "1.0", "nvidia-nccl": "3", "reskin": "0.1"}).splitlines()
    assert lines[1:] == ["Attrs==1.0", "torch==2.0"]


def test_list_of_checkout_commands_is_complete():
    names = {one.name or one.callback.__name__.replace("_", "-") for one in checkout.registered_commands}
    assert {"scenes", "model", *names} == {*CHECKOUT_COMMANDS}


@pytest.mark.parametrize("name", CHECKOUT_COMMANDS)
def test_checkout_commands_raise_outside_a_checkout(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["reskin", name, "any.csv"])
    with pytest.raises(ParamsError, match=f"reskin {name} must be run in a checkout of the project"):
        add_checkout_commands()

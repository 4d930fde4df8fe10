"""DVC does not follow imports: these tests do, so that no edited module leaves a stage up to date."""

from pathlib import Path

import grimp
import pytest
from ruamel.yaml import YAML

ROOT = Path(__file__).resolve().parents[1]
STAGES = YAML(typ="safe").load((ROOT / "dvc.yaml").read_text())["stages"]


@pytest.fixture(scope="module")
def graph() -> grimp.ImportGraph:
    return grimp.build_graph("pipeline", cache_dir=None)


def module_of(stage: str) -> str:
    return (
        f"pipeline.experiments.{stage}.run"
        if (ROOT / "pipeline/experiments" / stage).is_dir()
        else f"pipeline.stages.{stage}"
    )


def file_of(module: str) -> Path:
    path = ROOT / module.replace(".", "/")
    return path / "__init__.py" if path.is_dir() and (path / "__init__.py").exists() else path.with_suffix(".py")


@pytest.mark.parametrize("name", sorted(STAGES))
def test_a_stage_names_all_the_code_that_it_imports(name, graph):
    needed = {file_of(module) for module in graph.find_upstream_modules(module_of(name))}
    needed.add(file_of(module_of(name)))
    listed = [ROOT / one for one in STAGES[name]["do"]["deps"] if one.startswith("pipeline/")]
    # Packages' own __init__ files hold docstrings only, but for the table of readers.
    missing = {
        file for file in needed if not any(file == one or one in file.parents for one in listed)
        and not (file.name == "__init__.py" and len(file.read_text().splitlines()) <= 3)
    }  # fmt: skip
    assert {str(file.relative_to(ROOT)) for file in missing} == set()


@pytest.mark.parametrize("name", sorted(STAGES))
def test_a_stage_names_no_code_that_it_does_not_import(name, graph):
    needed = {file_of(module) for module in graph.find_upstream_modules(module_of(name))}
    needed.add(file_of(module_of(name)))
    listed = [one for one in STAGES[name]["do"]["deps"] if one.startswith("pipeline/")]
    idle = [one for one in listed if not any(f == ROOT / one or ROOT / one in f.parents for f in needed)]
    assert idle == []


@pytest.mark.parametrize("name", sorted(STAGES))
def test_every_path_that_a_command_takes_is_declared(name):
    stage = STAGES[name]["do"]
    outs = [one if isinstance(one, str) else next(iter(one)) for key in ("outs", "plots") for one in stage.get(key, [])]
    params = [next(iter(one)) for one in stage.get("params", [])]
    declared = [*stage["deps"], *outs, *params]
    words = stage["cmd"].split()
    # Which keys of its settings a stage declares, test_settings tells; run.sh finds Python, and decides no result.
    of_settings = {words[i + 1] for i, word in enumerate(words) if word in ("--settings", "--params", "--plan")}
    words = [word for word in words if "/" in word and word not in of_settings | {"pipeline/run.sh"}]
    unknown = [w for w in words if not any(d == w or d.startswith(f"{w}/") for d in declared)]
    assert unknown == []


def test_the_flow_stays_below_forty_stages():
    assert len(STAGES) < 40

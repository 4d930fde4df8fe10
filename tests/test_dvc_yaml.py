"""DVC does not follow imports: these tests do, so that no edited module leaves a stage up to date."""

from pathlib import Path

import grimp
import pytest
from ruamel.yaml import YAML

from pipeline.questions import EXPERIMENTS

ROOT = Path(__file__).resolve().parents[1]
STAGES = YAML(typ="safe").load((ROOT / "dvc.yaml").read_text())["stages"]


@pytest.fixture(scope="module")
def graph() -> grimp.ImportGraph:
    return grimp.build_graph("pipeline", cache_dir=None)


def file_of(module: str) -> Path:
    path = ROOT / module.replace(".", "/")
    return path / "__init__.py" if path.is_dir() and (path / "__init__.py").exists() else path.with_suffix(".py")


def code_of(stage: str, graph: grimp.ImportGraph) -> tuple[set[Path], list[Path]]:
    """The files that a stage imports, and the paths of code that dvc.yaml names for it."""
    module = f"pipeline.stages.{stage}"
    if (ROOT / "pipeline/experiments" / stage).is_dir():
        module = f"pipeline.experiments.{stage}.run"
    listed = [ROOT / path for path in STAGES[stage]["do"]["deps"] if path.startswith("pipeline/")]
    return {file_of(name) for name in {module, *graph.find_upstream_modules(module)}}, listed


@pytest.mark.parametrize("name", sorted(STAGES))
def test_a_stage_names_the_code_that_it_imports_and_no_other(name, graph):
    needed, listed = code_of(name, graph)
    # Packages' own __init__ files hold docstrings only, but for the table of readers.
    missing = {
        str(file.relative_to(ROOT)) for file in needed if not any(path in (file, *file.parents) for path in listed)
        and not (file.name == "__init__.py" and len(file.read_text().splitlines()) <= 3)
    }  # fmt: skip
    assert missing == set()
    assert [path for path in listed if not any(path in (file, *file.parents) for file in needed)] == []


@pytest.mark.parametrize("name", sorted(STAGES))
def test_every_path_that_a_command_takes_is_declared(name):
    stage = STAGES[name]["do"]
    outs = [one if isinstance(one, str) else next(iter(one)) for key in ("outs", "plots") for one in stage.get(key, [])]
    params = [next(iter(one)) for one in stage.get("params", [])]
    declared = [*stage["deps"], *outs, *params]
    words = stage["cmd"].split()
    # Which keys of its settings a stage declares, test_settings tells; run.sh finds Python, and decides no result.
    words = [word for word in words if "/" in word and word != "pipeline/run.sh"]
    unknown = [w for w in words if not any(d == w or d.startswith(f"{w}/") for d in declared)]
    assert unknown == []


def test_the_flow_stays_below_thirty_stages_beside_experiments():
    assert len(STAGES.keys() - set(EXPERIMENTS)) < 30

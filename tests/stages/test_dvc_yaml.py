"""Tests of dvc.yaml: stages depend on digests of their code and declare the paths in their commands."""

import shutil
import subprocess
from pathlib import Path

import pytest
from dvc.repo import Repo
from ruamel.yaml import YAML

from pipeline.catalogue import ANALYSES
from pipeline.stages.code import all_stages, digests_of
from reskin import code
from reskin.code import file_of, files_of

ROOT = Path(__file__).resolve().parents[2]
FLOW = YAML(typ="safe").load((ROOT / "dvc.yaml").read_text())["stages"]
STAGES = {name: stage.get("do", stage) for name, stage in FLOW.items()}
OTHERS = sorted(STAGES.keys() - {"code"})


@pytest.fixture(autouse=True)
def _no_digests(monkeypatch):
    """Omit digests: most of these tests need only the names of modules, and reading all modules takes seconds."""
    monkeypatch.setattr("pipeline.stages.code.digest", lambda name, data=True: "")


def test_every_stage_depends_on_its_code_digests():
    assert {*all_stages(), "code"} == STAGES.keys()
    assert {name: [dep for dep in STAGES[name]["deps"] if "code/" in dep] for name in OTHERS} == {
        name: [f"data/code/{name}"] for name in OTHERS
    }


def test_stage_code_depends_on_all_modules_that_stages_import():
    named = {ROOT / path for path in STAGES["code"]["deps"]}
    needed = {file_of(name) for stage in all_stages() for name in digests_of(stage)}
    deps = {next((path for path in (file, *file.parents) if path in named), file) for file in needed}
    assert deps == named


def test_digests_contain_the_modules_of_a_stage():
    assert "reskin.models.train" in digests_of("train_multi")
    assert "reskin.models.train" not in digests_of("simulate")
    assert {f"pipeline.experiments.{name}" for name in ANALYSES} <= digests_of("report").keys()


def test_report_depends_on_every_data_file_of_the_report_and_of_the_experiments():
    data = {file for name in ("report", "experiments") for file in (ROOT / "pipeline" / name).rglob("*.*")}
    read = {file for name in digests_of("report") for file in files_of(name)}
    pages = ROOT / "pipeline/report/pages"
    assert {file for file in data if file.suffix in code.DATA and file.parent != pages} <= read
    assert "pipeline/report/pages" in STAGES["report"]["deps"]


@pytest.mark.parametrize("name", sorted(STAGES))
def test_paths_in_commands_are_declared_as_dependencies_outputs_or_params(name):
    stage = STAGES[name]
    outs = [one if isinstance(one, str) else next(iter(one)) for key in ("outs", "plots") for one in stage.get(key, [])]
    params = [next(iter(one)) for one in stage.get("params", [])]
    declared = [*stage["deps"], *outs, *params]
    commands = stage["cmd"] if isinstance(stage["cmd"], list) else [stage["cmd"]]
    paths = [word for command in commands for word in command.split() if "/" in word]
    unknown = [p for p in paths if not any(d == p or d.startswith(f"{p}/") or p.startswith(f"{d}/") for d in declared)]
    assert unknown == []


def test_recordings_that_git_ignores_are_tracked_by_dvc(tmp_path):
    subprocess.run(["git", "init", "-q", str(tmp_path)], check=True)
    shutil.copy(ROOT / ".gitignore", tmp_path)
    (tmp_path / ".dvc").mkdir()
    shutil.copy(ROOT / ".dvc/config", tmp_path / ".dvc")
    capture = tmp_path / "data/raw/lab/one"
    capture.mkdir(parents=True)
    (capture / "readings.csv").write_text("x\n")
    (tmp_path / "data/raw/lab/one.dvc").write_text("outs:\n- path: one\n  md5: d41d8cd98f00b204e9800998ecf8427e.dir\n")
    with Repo(str(tmp_path)) as repo:
        # DVC tracks the recording, so `dvc push` uploads it.
        assert [stage.path_in_repo for stage in repo.index.stages] == ["data/raw/lab/one.dvc"]
    status = subprocess.check_output(["git", "status", "--porcelain", "-uall", "data"], cwd=tmp_path, text=True)
    assert status == "?? data/raw/lab/one.dvc\n"

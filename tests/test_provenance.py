import subprocess
from pathlib import Path

import pytest

from pipeline import provenance
from pipeline.provenance import (
    clear_cost,
    code_version_of,
    home,
    is_experiment,
    processor_name,
    read_costs,
    record_cost,
    record_trainings,
    total_cost_s,
)
from reskin import code
from reskin.numerics import VARIABLES

XEON = "processor\t: 0\nmodel name\t: Intel(R) Xeon(R) Gold 6442Y\nflags\t\t: fpu sse2 avx2 avx512f amx_tile\n\n"


def test_code_version_of_modules_is_their_last_functional_change(tmp_path, monkeypatch):
    monkeypatch.setattr(provenance, "ROOT", tmp_path)
    monkeypatch.setattr(code, "ROOT", tmp_path)
    (tmp_path / "pipeline").mkdir()
    modules = ["pipeline.one", "pipeline.two"]

    def write(**texts: str) -> None:
        for name, text in texts.items():
            (tmp_path / "pipeline" / name.replace("_", ".")).write_text(text)

    def commit(**texts: str) -> str:
        write(**texts)
        author = ("-c", "user.name=a", "-c", "user.email=a@b")
        for arguments in (["add", "."], [*author, "commit", "-qm", "x"]):
            subprocess.run(["git", *arguments], cwd=tmp_path, check=True)
        found = subprocess.run(["git", "rev-parse", "HEAD"], cwd=tmp_path, capture_output=True, text=True, check=True)
        return found.stdout[:12]

    write(one_py="A = 1\n", two_py="B = 1\n")
    assert code_version_of(modules) == "unknown"  # The folder is not a git repository.
    subprocess.run(["git", "init", "-q"], cwd=tmp_path, check=True)
    first = commit(one_yaml="a: 1\n")
    assert code_version_of(modules) == first
    commit(one_py="A = 1  # of what\n", two_py='"""Two."""\n\nB = 1\n', other_py="C = 1\n")
    assert code_version_of(modules) == first
    second = commit(one_yaml="a: 2\n")
    assert code_version_of(modules) == second
    third = commit(two_py="B = 2\n")
    commit(other_py="C = 2\n")
    assert code_version_of(modules) == third
    assert code_version_of(["pipeline.one"]) == second
    write(one_py='"""One."""\n\nA = 1\n')
    assert code_version_of(modules) == third
    write(one_py="A = 2\n")
    assert code_version_of(modules) == f"{third}+dirty"
    assert code_version_of(["pipeline.two"]) == third


def test_processor_name_has_instruction_sets_and_limits():
    assert processor_name(XEON, {}, otherwise="") == "Intel Xeon Gold 6442Y (AVX2, AVX-512, AMX)"
    environment = {"OPENBLAS_CORETYPE": "Zen", "ATEN_CPU_CAPABILITY": "", "HOME": "/home/me"}
    assert processor_name(XEON, environment, otherwise="").endswith("(AVX2, AVX-512, AMX; OPENBLAS_CORETYPE=Zen)")


@pytest.mark.parametrize("name", VARIABLES)
def test_variables_that_change_the_results_are_listed_with_the_processor(name):
    assert f"{name}=x" in processor_name(XEON, {name: "x"}, otherwise="")


def test_cost_of_a_stage_includes_training_runs_that_were_reused(tmp_path):
    clear_cost(tmp_path, "train")
    record_trainings(tmp_path, "train", {"a": (8.0, False), "b": (9.0, False)}, waited_s=10.0)
    record_cost(tmp_path, "train", 12.0)
    first = read_costs(tmp_path)["train"]
    assert first["seconds"] == 12.0
    assert first["reused_n"] == 0
    assert total_cost_s([first]) == 8.0 + 9.0 + 2.0  # Apart from the training, the stage took 2 s.

    clear_cost(tmp_path, "train")
    record_trainings(tmp_path, "train", {"a": (8.0, True), "b": (9.0, True)}, waited_s=0.5)
    record_cost(tmp_path, "train", 2.5)
    again = read_costs(tmp_path)["train"]
    assert (again["seconds"], again["reused_n"]) == (2.5, 2)
    assert total_cost_s([again]) == 8.0 + 9.0 + 2.5


def test_training_run_used_by_two_stages_is_counted_once(tmp_path):
    for stage in ("one", "other"):
        clear_cost(tmp_path, stage)
        record_trainings(tmp_path, stage, {"a": (8.0, stage == "other")}, waited_s=1.0)
        record_cost(tmp_path, stage, 3.0)
    # The second stage only reuses the training run, so it adds its 3 s.
    assert total_cost_s(read_costs(tmp_path).values()) == 8.0 + 2.0 + 3.0


def test_costs_of_a_killed_run_are_dropped(tmp_path):
    clear_cost(tmp_path, "train")
    record_trainings(tmp_path, "train", {"old": (8.0, False)}, waited_s=1.0)
    clear_cost(tmp_path, "train")  # The stage was killed, and starts again.
    record_cost(tmp_path, "train", 2.0)
    assert read_costs(tmp_path)["train"]["trainings_s"] == {}


def test_dvc_experiments_use_the_caches_of_the_checkout(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert (home(), is_experiment()) == (Path(), False)
    copy = tmp_path / ".dvc/tmp/exps/standard/tmpx1"
    copy.mkdir(parents=True)
    monkeypatch.chdir(copy)
    assert (home(), is_experiment()) == (tmp_path, True)

import subprocess
from pathlib import Path

import pytest

from pipeline import provenance
from pipeline.provenance import (
    code_version_of,
    home,
    is_experiment,
    processor_name,
    read_costs,
    record_cost,
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


def test_cost_is_that_of_the_last_run_of_a_stage(tmp_path):
    for seconds in (12.0, 2.5):
        record_cost(tmp_path, "train", seconds)
    cost = read_costs(tmp_path)["train"]
    assert cost["seconds"] == 2.5
    assert cost["cpu_s"] > 0 < cost["peak_process_memory_MB"]


def test_dvc_experiments_use_the_caches_of_the_checkout(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert (home(), is_experiment()) == (Path(), False)
    copy = tmp_path / ".dvc/tmp/exps/standard/tmpx1"
    copy.mkdir(parents=True)
    monkeypatch.chdir(copy)
    assert (home(), is_experiment()) == (tmp_path, True)

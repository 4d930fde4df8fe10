import re
import subprocess

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline import provenance
from pipeline.provenance import (
    INSTRUCTIONS,
    clear_cost,
    code_version,
    code_version_of,
    machine,
    processor_name,
    read_costs,
    record_cost,
    record_trainings,
    total_cost_s,
)
from reskin import code
from reskin.numerics import VARIABLES, pinned

XEON = "processor\t: 0\nmodel name\t: Intel(R) Xeon(R) Gold 6442Y\nflags\t\t: fpu sse2 avx2 avx512f amx_tile\n\n"
OLD = "processor\t: 1\nmodel name\t: Another one\nflags\t\t: fpu sse2\n"


def test_code_version_is_a_commit_or_unknown():
    assert re.fullmatch(r"[0-9a-f]{12}(\+dirty)?|unknown", code_version())


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


def test_machine_states_the_processor_its_cores_and_the_version_of_python():
    assert re.search(r"cpu .*, \d+ cores, Python 3\.", machine())


def test_processor_name_has_instruction_sets_and_limits():
    assert processor_name(XEON, {}, otherwise="") == "Intel Xeon Gold 6442Y (AVX2, AVX-512, AMX)"
    environment = {"OPENBLAS_CORETYPE": "Zen", "ATEN_CPU_CAPABILITY": "", "HOME": "/home/me"}
    assert processor_name(XEON, environment, otherwise="").endswith("(AVX2, AVX-512, AMX; OPENBLAS_CORETYPE=Zen)")


def test_first_of_two_processors_is_named():
    assert processor_name(XEON + OLD, {}, otherwise="") == processor_name(XEON, {}, otherwise="")
    assert processor_name(OLD + XEON, {}, otherwise="") == "Another one"


@pytest.mark.parametrize("cpuinfo", ["", "\n\n", "no colon here", "model name:\nflags:"])
def test_name_of_an_unknown_processor_is_the_one_that_python_reports(cpuinfo):
    assert processor_name(cpuinfo, {}, otherwise="arm") == "arm"
    assert processor_name(cpuinfo, {}, otherwise="") == "unknown processor"


@pytest.mark.parametrize("name", VARIABLES)
def test_variables_that_change_the_results_are_listed_with_the_processor(name):
    assert f"{name}=x" in processor_name(XEON, {name: "x"}, otherwise="")


def test_variables_that_the_project_has_set_are_not_listed():
    flags = frozenset({"avx2", "avx512vl", "avx512_vbmi2"})
    assert processor_name(XEON, pinned(flags, {}), otherwise="") == processor_name(XEON, {}, otherwise="")


@pytest.mark.parametrize(("flag", "name"), INSTRUCTIONS.items())
def test_instruction_sets_are_listed_if_available(flag, name):
    assert name in processor_name(f"Features : {flag}", {}, otherwise="arm")
    assert processor_name("Features : fp", {}, otherwise="arm") == "arm"


def test_machine_is_described_although_cpuinfo_is_missing(tmp_path, monkeypatch):
    monkeypatch.setattr(provenance, "CPUINFO", tmp_path / "none")
    assert re.search(r"cpu .*, \d+ cores, Python 3\.", machine())


def test_costs_are_in_seconds_and_megabytes(tmp_path):
    record_cost(tmp_path, "split", 1.234)
    record_cost(tmp_path, "split", 2.345)
    costs = read_costs(tmp_path)
    assert list(costs) == ["split"]
    # The value 2.345 may be rounded up or down.
    assert costs["split"]["seconds"] == 2.35 or costs["split"]["seconds"] == 2.34
    assert 0.1 < costs["split"]["cpu_s"] < 100_000  # The CPU time of this process includes imports.
    assert 10 < costs["split"]["peak_process_memory_MB"] < 100_000  # The peak memory of this Python process in MB.


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


@given(st.floats(0, 9), st.floats(0, 9), st.lists(st.tuples(st.floats(0, 9), st.booleans()), max_size=4))
def test_cost_of_a_stage_is_at_least_the_time_of_its_last_run(tmp_path_factory, waited_s, other_s, trained):
    folder = tmp_path_factory.mktemp("costs")
    record_trainings(folder, "train", {str(i): one for i, one in enumerate(trained)}, waited_s)
    record_cost(folder, "train", waited_s + other_s)
    cost = read_costs(folder)["train"]
    assert total_cost_s([cost]) >= cost["seconds"] - 0.02  # Both values are rounded to 0.01 s.


def test_training_run_that_a_stage_uses_twice_is_counted_once(tmp_path):
    clear_cost(tmp_path, "sweep")
    record_trainings(tmp_path, "sweep", {"a": (8.0, False)}, waited_s=4.0)
    record_trainings(tmp_path, "sweep", {"a": (8.0, True), "c": (1.0, True)}, waited_s=1.0)
    record_cost(tmp_path, "sweep", 6.0)
    cost = read_costs(tmp_path)["sweep"]
    assert cost["trainings_s"] == {"a": 8.0, "c": 1.0}
    assert cost["reused_n"] == 1
    assert total_cost_s([cost]) == 10.0


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

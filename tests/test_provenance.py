import re

from pipeline.provenance import code_version, device, note_cost, read_costs


def test_a_result_names_the_commit_of_its_code_or_says_that_it_cannot():
    assert re.fullmatch(r"[0-9a-f]{12}(\+dirty)?|unknown", code_version())


def test_the_machine_is_told_in_words():
    assert re.search(r"cpu .*, \d+ cores, Python 3\.", device())


def test_costs_are_kept_a_stage_in_seconds_and_megabytes(tmp_path):
    note_cost(tmp_path, "split", 1.234)
    note_cost(tmp_path, "split", 2.345)
    costs = read_costs(tmp_path)
    assert list(costs) == ["split"]
    assert costs["split"]["seconds"] == 2.35 or costs["split"]["seconds"] == 2.34  # halves round to even
    assert 10 < costs["split"]["peak_process_memory_MB"] < 100_000  # a Python process; not KiB, not bytes

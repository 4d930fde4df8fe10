"""The table of faults that is committed has a row for every fault; what a row says is what was found."""

from tests.faults import files, kills, together, tracking  # noqa: F401 (each enters its faults)
from tests.faults.__main__ import OUT
from tests.faults.place import sentence_of
from tests.faults.row import CASES, Row, line


def test_the_committed_table_has_a_row_for_every_fault():
    rows = [row.split(" | ")[0].removeprefix("| ") for row in OUT.read_text().splitlines() if row.startswith("| ")]
    assert rows == ["fault", *CASES]


def test_what_went_wrong_is_red_and_says_why():
    row = Row("error: no room", None, "nothing", "ran adapt", ["a hang"], "Known: DVC waits.")
    cells = "| “error: no room” | hang | nothing | ran adapt | 3 | red: a hang. Known: DVC waits. |"
    assert line("f", "h", row, 3.2).endswith(cells)


def test_the_sentence_of_a_stage_goes_before_that_of_dvc():
    said = ["x: stage 2 of 3", "error: split: a must b; got c.", "ERROR: failed to reproduce 'split@a'"]
    assert sentence_of(said) == said[1]
    assert sentence_of(said[2:]) == said[2]
    lock = "'./dvc.lock' is invalid (possible merge conflicts)."
    assert sentence_of([lock, "", "Mapping values are not allowed"]) == lock


def test_only_the_machines_own_folders_are_left_out():
    row = Row("error: /tmp/x1/case/data must be; delete .dvc/tmp/rwlock", 2, "nothing", "ran adapt")
    assert "“error: …/data must be; delete .dvc/tmp/rwlock”" in line("f", "h", row, 1.0)

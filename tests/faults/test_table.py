"""Tests that docs/faults.md has a row for every fault, and that a row shows the error message and the outcome."""

import tempfile

from tests.faults import files, kills, together  # noqa: F401 (importing a module adds its faults)
from tests.faults.__main__ import OUT
from tests.faults.harness import CASES, Row, line, message_of


def test_table_in_docs_has_a_row_for_every_fault():
    rows = [row.split(" | ")[0].removeprefix("| ") for row in OUT.read_text().splitlines() if row.startswith("| ")]
    assert rows == ["fault", *CASES]


def test_row_with_a_failed_check_has_the_verdict_red():
    row = Row("error: no room", None, "nothing", "ran adapt", ["a hang"], "Known: DVC waits.")
    cells = "| “error: no room” | hang | nothing | ran adapt | 3 | red: a hang. Known: DVC waits. |"
    assert line("f", "h", row, 3.2).endswith(cells)


def test_message_of_prefers_the_message_of_the_stage_to_that_of_dvc():
    lines = ["x: stage 2 of 3", "error: split: a must b; got c.", "ERROR: failed to reproduce 'split@a'"]
    assert message_of(lines) == lines[1]
    assert message_of(lines[2:]) == lines[2]
    lock = "'./dvc.lock' is invalid (possible merge conflicts)."
    assert message_of([lock, "", "Mapping values are not allowed"]) == lock


def test_paths_of_this_machine_are_shortened_in_the_table():
    message = f"error: {tempfile.gettempdir()}/x1/case/data must be; delete .dvc/tmp/rwlock"
    row = Row(message, 2, "nothing", "ran adapt")
    assert "“error: …/data must be; delete .dvc/tmp/rwlock”" in line("f", "h", row, 1.0)

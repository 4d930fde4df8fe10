"""Readers of recordings that other programs wrote. Which door is for what:

- a table with named columns (CSV, Parquet, ...) that has the names and units of layout `table`: `table`
- any other table or log with labels: option --columns of `reskin add`, a YAML file of its columns; `column_map`
- bytes or lines of text as a board sends them: option --wire, a YAML file of them; `reskin.board.other_firmware`
- a log without labels in the columns of an SD card: `sd_card`
- files of a public data set: `lab` (a map of columns in Python), `ini`, `eflesh` and `leaphand`

A reader converts the files of a recording to `Readings`, and counts the rows that it drops.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Protocol

from reskin.recordings.fault_policy import FaultPolicy
from reskin.recordings.header import Header
from reskin.recordings.readers import eflesh, ini, lab, leaphand, table
from reskin.schema import Readings


class Reader(Protocol):
    """The interface of a reader: the functions that each module of this package defines."""

    def collect(self, recording: Path) -> dict[str, Path]:
        """Find the files of a recording.

        Returns a mapping from the name that each file gets in the capture folder to the path of the file.
        """

    def count_chips(self, files: Mapping[str, Path]) -> int:
        """Count the chips from the columns of the collected files."""

    def read(self, folder: Path, header: Header, policy: FaultPolicy) -> tuple[Readings, dict[str, int]]:
        """Return the readings of a capture folder, and an account (counts by name) of its rows.

        In the account, `rows_read_n` is the sum of `rows_n`, `noload_rows_n` and all `dropped_*_rows_n`.
        """


READERS: Mapping[str, Reader] = {
    "table": table, "lab": lab, "ini": ini, "eflesh": eflesh, "leaphand": leaphand,
}  # fmt: skip

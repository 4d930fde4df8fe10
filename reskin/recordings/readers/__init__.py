"""Readers of recordings in layouts other than `native`, one module per layout.

A reader converts the files of a recording to `Readings`, and counts the rows that it drops.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Protocol

from reskin.recordings.fault_policy import FaultPolicy
from reskin.recordings.header import Header
from reskin.recordings.readers import eflash7, eflesh, ini, lab, leaphand, table
from reskin.schema import Readings


class Reader(Protocol):
    """The functions that each reader module defines."""

    def collect(self, recording: Path) -> dict[str, Path]:
        """Find the files of a recording; return a mapping from each file's name in the capture folder to its path."""

    def count_chips(self, files: Mapping[str, Path]) -> int:
        """Count the chips from the columns of the collected files."""

    def read(self, folder: Path, header: Header, policy: FaultPolicy) -> tuple[Readings, dict[str, int]]:
        """Return the readings of a capture folder, and the account of its rows.

        In the account, `rows_n` + `noload_rows_n` + all `dropped_*_rows_n` = `rows_read_n`.
        """


READERS: Mapping[str, Reader] = {
    "table": table, "lab": lab, "ini": ini, "eflesh": eflesh, "eflash7": eflash7, "leaphand": leaphand,
}  # fmt: skip

"""Readers of recordings in layouts other than `native`, one module per layout.

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

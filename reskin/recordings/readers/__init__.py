"""Readers of other layouts, one module each. They convert files to `Readings` and an account of dropped rows."""

from collections.abc import Mapping
from pathlib import Path
from typing import Protocol

from reskin.recordings.fault_policy import FaultPolicy
from reskin.recordings.header import Header
from reskin.recordings.readers import eflash7, eflesh, ini, lab, table
from reskin.schema import Readings


class Reader(Protocol):
    """The functions that each reader module defines."""

    def collect(self, recording: Path) -> dict[str, Path]:
        """Find a recording's files; return their paths, by the file name to use in the capture folder."""

    def count_chips(self, files: Mapping[str, Path]) -> int:
        """Count the chips from the columns of the collected files."""

    def read(self, folder: Path, header: Header, policy: FaultPolicy) -> tuple[Readings, dict[str, int]]:
        """Read a capture folder; `rows_n` + `noload_rows_n` + all `dropped_*_rows_n` = `rows_read_n`."""


READERS: Mapping[str, Reader] = {
    "table": table, "lab": lab, "ini": ini, "eflesh": eflesh, "eflash7": eflash7,
}  # fmt: skip

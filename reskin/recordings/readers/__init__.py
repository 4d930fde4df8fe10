"""Readers of recordings in other layouts, one module each: files in, `Readings` and an account of dropped rows out."""

from collections.abc import Mapping
from pathlib import Path
from typing import Protocol

from reskin.recordings.fault_policy import FaultPolicy
from reskin.recordings.header import Header
from reskin.recordings.readers import eflash7, eflesh, ini, lab, table
from reskin.schema import Readings


class Reader(Protocol):
    """The functions that each module of a layout has."""

    def collect(self, recording: Path) -> dict[str, Path]:
        """Find a recording's files: name in the capture folder -> source."""

    def count_chips(self, files: Mapping[str, Path]) -> int:
        """Count the chips that collected files have columns for."""

    def read(self, folder: Path, header: Header, policy: FaultPolicy) -> tuple[Readings, dict[str, int]]:
        """Read a capture folder; `rows_n` + `noload_rows_n` + all `dropped_*_rows_n` = `rows_read_n`."""


READERS: Mapping[str, Reader] = {
    "table": table, "lab": lab, "ini": ini, "eflesh": eflesh, "eflash7": eflash7,
}  # fmt: skip

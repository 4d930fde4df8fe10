"""Captures on disk, readers of other layouts, the probe log, labels, clocks, and ingestion into readings."""

from typing import Literal

# Layouts that have a reader in `readers`. Defined here, because `reskin --help` lists them and must not import readers.
ReaderLayout = Literal["table", "lab", "ini", "eflesh", "eflash7", "leaphand"]

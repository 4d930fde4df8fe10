"""Recordings: captures on disk, readers of other layouts, probe logs, labels, clocks, and conversion to readings."""

from typing import Literal

# Layouts that have a reader in `readers`. They are listed here, because `reskin --help` shows them without importing
# the readers.
ReaderLayout = Literal["table", "lab", "ini", "eflesh", "eflash7", "leaphand"]

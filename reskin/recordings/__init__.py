"""Recordings of boards: how they are made, stored as captures, labelled, and converted to tables of readings.

A recording is the data of one run of a board. Its layout is the format of its files. A capture is a folder with the
files of one recording and a header (see `header`). In layout `native`, it contains the bytes that a board sent, and a
probe log with the places and forces. Other layouts are those of other programs; the modules in `readers` read them.
"""

from typing import Literal

# Layouts that have a reader in `readers`. They are listed here, because `reskin --help` shows them without importing
# the readers.
ReaderLayout = Literal["table", "lab", "ini", "eflesh", "leaphand"]

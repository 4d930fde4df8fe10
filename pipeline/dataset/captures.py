"""Opening a capture, whatever its layout. In: a folder with `header.json`. Out: readings in blocks, and an account.

Refuses to know where captures are kept, and what is done with readings.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

from pipeline.capture.header import HEADER_FILE, Header, check_same_capture, parse
from pipeline.capture.readers import READERS
from pipeline.core import io
from pipeline.core.errors import CaptureError
from pipeline.core.schema import Readings
from pipeline.dataset.native import read_native

# What lies between dwells is no loss.
LOST_FRAMES = (
    "dropped_failed_read_frames_n",
    "dropped_no_time_frames_n",
    "dropped_not_finite_frames_n",
    "dropped_stuck_chip_frames_n",
)


class Opened(NamedTuple):
    """A capture being read; `account` is complete when `blocks` is exhausted."""

    header: Header
    blocks: Iterable[Readings]
    account: Mapping[str, int]


def open_capture(folder: Path) -> Opened:
    """Check a capture's header and files, and begin to read it."""
    header = read_header(folder)
    check_same_capture(header, folder.name)
    for name, digest in header.files.items():
        if not (folder / name).is_file():
            raise CaptureError(folder / name, "the file", "there, as the header says", "nothing", "Add it again.")
        if io.sha256(folder / name) != digest:
            raise CaptureError(
                folder / name,
                "the file",
                "unchanged since it was added",
                "another hash",
                "Remove it and add it again.",
            )
    if header.layout == "native":
        return Opened(header, *read_native(folder, header))
    if header.layout not in READERS:
        remedy = "An SD card's log has no labels to learn from; try: reskin predict."
        raise CaptureError(folder, "layout", f"native or one of {sorted(READERS)}", header.layout, remedy)
    readings, account = READERS[header.layout].read(folder, header)
    return Opened(header, [readings], account)


def read_header(folder: Path) -> Header:
    """Read and check a capture's header."""
    file = folder / HEADER_FILE
    if not file.is_file():
        raise CaptureError(file, "a capture", f"a folder with {HEADER_FILE}", "none", "Is it another --layout?")
    return parse(file.read_text(encoding="utf-8", errors="replace"), str(file))


def check_losses(account: Mapping[str, int], limit: float, where: str) -> None:
    """Raise if a capture lost more than the fraction `limit` of its bytes, frames, rows or indentations."""
    for whole, lost in (
        ("bytes_n", [key for key in account if key.startswith("skipped_") and key.endswith("_bytes_n")]),
        ("frames_n", [key for key in account if key in LOST_FRAMES]),
        ("rows_read_n", [key for key in account if key.startswith("dropped_") and key.endswith("_rows_n")]),
        (
            "logged_indentations_n",
            [key for key in account if key.startswith("dropped_") and key.endswith("_indentations_n")],
        ),
    ):
        lost_n = sum(account[key] for key in lost)
        if lost_n > limit * account.get(whole, 0):
            reasons = ", ".join(f"{account[key]} {key.removesuffix('_n')}" for key in lost if account[key])
            raise CaptureError(
                    where, f"lost {whole.removesuffix('_n')}", f"at most {limit:.0%} of {account[whole]}", reasons,
                    "Mend the recording, or raise lost_fraction_max in params.yaml.",
                )  # fmt: skip

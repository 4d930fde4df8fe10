"""Tests of recordings that a power cut interrupted: whatever is whole on the disk comes in, and the rest is counted."""

import os
import re
from pathlib import Path

import numpy as np
import pytest

from reskin import io
from reskin.errors import CaptureError, ReskinError
from reskin.recordings import recorder
from reskin.recordings.header import ARRIVALS_FILE, HEADER_FILE, PROBE_FILE, STREAM_FILE, write_capture, write_header
from reskin.recordings.ingest import check_losses, open_capture
from reskin.recordings.preparing import CaptureNames, native
from reskin.schema import Readings
from reskin.seeds import rng_for
from tests.recordings.headers import DEFAULT_POLICY, PARAMS
from tests.recordings.test_native import LOG, MARKS, header_of, write

COPIES_N = int(os.environ.get("RESKIN_CUTS_N", "40"))
FILES = (STREAM_FILE, ARRIVALS_FILE, PROBE_FILE)
NAMES = CaptureNames("board1", "skin1", None)


def write_part(folder: Path) -> Path:
    """Write a recording as it is on the disk while it is being recorded: its header lists no files yet."""
    folder.mkdir()
    write(folder, "binary")
    write_header(folder, header_of("binary").model_copy(update={"capture": "run1"}))
    return folder


def add(part: Path, target: Path) -> tuple[list[Readings], str]:
    """Bring a recording in as `reskin add` does; return its readings, and what is said to be lost."""
    header, files = native(part, NAMES, None, ())
    folder = target / header.capture
    write_capture(folder, header, files)
    _, blocks, account = open_capture(folder, DEFAULT_POLICY)
    readings = list(blocks)
    check_losses(account, PARAMS["lost_fraction_max"], "run1")
    return readings, header.options.get("lost", "")


def rows_of(blocks: list[Readings]) -> dict[tuple[int, int], bytes]:
    return {
        (int(block.indentation[i]), int(block.reading_i[i])): b"".join(
            getattr(block, name)[i].tobytes() for name in ("b_uT", "noload_uT", "t_s", "x_mm", "Fz_N")
        )
        for block in blocks
        for i in range(len(block))
    }


def whole_dwells(part: Path) -> int:
    """Return how many dwells of the log are whole and inside the stream, by a loop over the lines of the files."""
    last_s, stream_n = -np.inf, len((part / STREAM_FILE).read_bytes().rstrip(b"\0"))
    for line in (part / ARRIVALS_FILE).read_bytes().split(b"\n")[1:-1]:
        if re.fullmatch(rb"\d+,[\d.]+", line) and int(line.split(b",")[0]) <= stream_n:
            last_s = float(line.split(b",")[1])
    offset_s = MARKS[0][1] - MARKS[0][0]
    lines = [line for line in (part / PROBE_FILE).read_bytes().split(b"\n")[1:-1] if b"\0" not in line]
    return sum(float(line.split(b",")[4]) <= last_s + offset_s for line in lines)


def cut(file: Path, kept_n: int, *, zeros: bool) -> None:
    content = file.read_bytes()
    file.write_bytes(content[:kept_n] + bytes(len(content) - kept_n if zeros else 0))


@pytest.fixture(scope="module")
def whole_rows(tmp_path_factory) -> dict[tuple[int, int], bytes]:
    """Return the rows of an interrupted recording whose files are all whole."""
    folder = tmp_path_factory.mktemp("whole")
    blocks, said = add(write_part(folder / "run1.part"), folder)
    assert re.findall(r"(\d+) of", said) == ["0", "0", "0"]
    return rows_of(blocks)


@pytest.mark.parametrize("copy", range(COPIES_N))
def test_all_whole_rows_of_a_cut_recording_come_in(tmp_path, whole_rows, copy):
    rng = rng_for(0, "cuts", copy)
    part = write_part(tmp_path / "run1.part")
    for name in rng.permutation(FILES)[: rng.integers(1, 4)]:
        file = part / str(name)
        cut(file, int(rng.integers(0, file.stat().st_size + 1)), zeros=bool(rng.integers(2)))
    dwells_n = whole_dwells(part)
    pressed = {int(LOG.indentation[i]) for i in range(dwells_n) if LOG.contact[i]}
    expected = {key: row for key, row in whole_rows.items() if key[0] in pressed}
    if not expected:
        with pytest.raises(CaptureError):
            add(part, tmp_path / "cut")
        return
    blocks, said = add(part, tmp_path / "cut")
    assert rows_of(blocks) == expected
    lost_n = [int(number) for number in re.findall(r"(\d+) of", said)]
    assert len(lost_n) == 3
    # If a file ends after a whole row, nothing in it shows that more was written.
    assert any(lost_n) or all((part / name).read_bytes().endswith(b"\n") for name in FILES)


@pytest.mark.parametrize("name", [ARRIVALS_FILE, HEADER_FILE, STREAM_FILE])
def test_recording_of_which_a_file_is_missing_is_refused(tmp_path, name):
    part = write_part(tmp_path / "run1.part")
    (part / name).unlink()
    with pytest.raises(ReskinError, match=name):
        native(part, NAMES, None, ())


def test_header_and_renames_are_on_the_disk_before_the_recorder_goes_on(tmp_path, monkeypatch):
    steps: list[str] = []
    monkeypatch.setattr(io, "sync", lambda *paths: steps.extend(sorted(path.name for path in paths)))
    part, header = recorder.begin_capture(
        tmp_path / "run1", recorder.CaptureInfo(), wire="binary", chips_n=5, by="a test"
    )
    assert steps[1:] == ["run1.part", tmp_path.name]  # the header under its temporary name, then both folders
    steps.clear()
    with recorder.CaptureWriter(part, "binary", 5) as writer:
        recorder.end_capture(tmp_path / "run1", header, writer.rate())
    assert steps == [ARRIVALS_FILE, HEADER_FILE, "run1.part", STREAM_FILE, tmp_path.name]

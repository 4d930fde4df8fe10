"""Tests of captures in our own format, whose bytes are decoded.

The tests check that indentations are recovered, and that every byte and every frame is either used in a reading or
counted as lost.
"""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from reskin import io
from reskin.board.faults import STUCK_FRAMES_MIN_N, FAILED_B_uT, FAILED_TEMPERATURE_degC
from reskin.board.wire import Frames, Wire, encode
from reskin.errors import CaptureError
from reskin.recordings import clocks, ingest, probe
from reskin.recordings.clocks import Arrivals
from reskin.recordings.header import ARRIVALS_FILE, PROBE_FILE, STREAM_FILE, Clock, Header
from reskin.recordings.ingest import read_native
from reskin.recordings.probe import LABELS, ProbeLog
from reskin.schema import Readings
from reskin.seeds import rng_for
from tests.recordings.headers import DEFAULT_POLICY, make_header

RATE_HZ = 100.0
OFFSET_S = 40.0  # This is the time of the probe minus the time of the stream.
INDENTATIONS_N = 60
# Each indentation has this number of frames without load, while the tip moves down or up, and in contact.
NOLOAD_N, MOVE_N, CONTACT_N = 4, 3, 5
CHIPS_N = 5


def simulate_presses() -> tuple[Frames, ProbeLog]:
    """Return the frames of random presses at `RATE_HZ`, rounded to 0.01 uT, and the probe log."""
    rng = rng_for(0, "press")
    move_n = rng.integers(MOVE_N, 3 * MOVE_N, (INDENTATIONS_N, 2))
    parts, rows, begin = [], [], 10
    parts.append(np.zeros((begin, 15)))
    for number in range(INDENTATIONS_N):
        down_n, up_n = move_n[number]
        share = np.concatenate(
            [
                np.zeros(NOLOAD_N),
                np.linspace(0, 1, down_n + 2)[1:-1],
                np.ones(CONTACT_N),
                np.linspace(1, 0, up_n + 2)[1:-1],
            ]
        )
        parts.append(share[:, None] * rng.normal(0, 200, 15))
        pressed = begin + NOLOAD_N + down_n
        # Frame i ends at (i + 1) / RATE_HZ. Dwells begin half a frame before their first frame, and end half a frame
        # after their last one.
        rows.append((number, False, begin + 0.5, begin + NOLOAD_N + 0.5))
        rows.append((number, True, pressed + 0.5, pressed + CONTACT_N + 0.5))
        begin += len(share)
    parts.append(np.zeros((10, 15)))
    clean_uT = np.concatenate(parts)
    b_uT = np.round(500 + clean_uT + rng.normal(0, 4, clean_uT.shape), 2).astype(np.float32)
    temperature_degC = np.round(rng.normal(25, 0.1, (len(b_uT), CHIPS_N)), 2).astype(np.float32)
    frame_s = (1 + np.arange(len(b_uT))) / RATE_HZ
    frames = Frames(b_uT, temperature_degC, frame_s, np.zeros(len(b_uT), np.int64))
    number, contact, start, end = (np.array(column) for column in zip(*rows, strict=True))
    labels = {name: np.where(contact, i + number, np.nan).astype(np.float32) for i, name in enumerate(LABELS)}
    number = number.astype(np.int32)
    start_s, end_s = start / RATE_HZ + OFFSET_S, end / RATE_HZ + OFFSET_S
    return frames, ProbeLog(number, number // 20, contact.astype(bool), start_s, end_s, **labels)


FRAMES, LOG = simulate_presses()
MARKS = ((0.5, OFFSET_S + 0.5), (8.0, OFFSET_S + 8.0))


def header_of(wire: Wire, kind: str = "arrivals", marks: tuple[tuple[float, float], ...] = MARKS) -> Header:
    clock = Clock(kind=kind, rate_hz=RATE_HZ if kind == "rate" else None, marks=marks)  # type: ignore[arg-type]
    return make_header(layout="native", wire=wire, clock=clock, chips_n=CHIPS_N)


def write(folder: Path, wire: Wire, frames: Frames = FRAMES, **files: bytes) -> Path:
    """Write the files of a capture.

    Bytes arrive in chunks of 1 to 7 frames, at the time at which the last frame of the chunk ends.
    """
    whole = encode(frames, wire)
    rows = np.arange(len(frames))
    ends = np.cumsum([len(encode(frames.where(rows == row_i), wire)) for row_i in rows])
    chunk_i = np.cumsum(rng_for(0, "chunks").integers(1, 8, len(frames)))
    chunk_i = np.append(chunk_i[chunk_i < len(frames)], len(frames)) - 1
    table = Arrivals(np.append(0, ends[chunk_i]).astype(np.int64), np.append(0.0, (chunk_i + 1) / RATE_HZ))
    contents = {
        STREAM_FILE: whole,
        ARRIVALS_FILE: clocks.render(table).encode(),
        PROBE_FILE: probe.render(LOG).encode(),
    }
    for name, content in contents.items():
        (folder / name).write_bytes(files.get(name.split(".")[0], content))
    return folder


def read(folder: Path, header: Header) -> tuple[dict[str, np.ndarray], dict[str, int]]:
    blocks, account = read_native(folder, header, DEFAULT_POLICY)
    parts = list(blocks)
    names = [field.name for field in dataclasses.fields(Readings)[4:]]
    return {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}, account


def expected_readings() -> dict[str, np.ndarray]:
    """Return the expected readings. They are computed by a loop over dwells, from the frames before encoding."""
    columns: dict[str, list[Any]] = {
        name: [] for name in ("indentation", "reading_i", "x_mm", "b_uT", "noload_uT", "t_s")
    }
    noload_uT = np.zeros(15)
    for dwell_i in range(len(LOG)):
        probe_s = FRAMES.device_s + OFFSET_S
        inside = np.flatnonzero((probe_s >= LOG.t_start_s[dwell_i]) & (probe_s <= LOG.t_end_s[dwell_i]))
        if not LOG.contact[dwell_i]:
            noload_uT = FRAMES.b_uT[inside].mean(axis=0, dtype=np.float64)
            continue
        assert len(inside) == CONTACT_N
        for reading_i, frame_i in enumerate(inside):
            row = (LOG.indentation[dwell_i], reading_i, LOG.x_mm[dwell_i], FRAMES.b_uT[frame_i], noload_uT)
            for name, value in zip(columns, (*row, FRAMES.device_s[frame_i]), strict=True):
                columns[name].append(value)
    return {name: np.array(column) for name, column in columns.items()}


@pytest.mark.parametrize("wire", ["binary", "binary-clock", "text-xyzt", "text-txyz"])
@pytest.mark.parametrize("kind", ["arrivals", "rate"])
@pytest.mark.parametrize("marks", [MARKS, ()], ids=["marks", "contacts"])
def test_indentations_are_recovered(
    tmp_path: Path, wire: Wire, kind: str, marks: tuple[tuple[float, float], ...]
) -> None:
    found, account = read(write(tmp_path, wire), header_of(wire, kind, marks))
    for name, column in expected_readings().items():
        # Tolerances: means of no-load readings are rounded to single precision. The time of a text frame is estimated
        # from its position in the bytes; as lines have different lengths, it is wrong by up to half a frame.
        atol = {"t_s": 0.5 / RATE_HZ, "noload_uT": 1e-3}.get(name, 0)
        np.testing.assert_allclose(found[name], column, rtol=0, atol=atol, err_msg=name)
    assert account["indentations_n"] == account["logged_indentations_n"] == INDENTATIONS_N
    assert account["frames_n"] == len(FRAMES)


def test_every_byte_of_a_damaged_stream_is_counted(tmp_path: Path) -> None:
    b_uT, temperature_degC = FRAMES.b_uT.copy(), FRAMES.temperature_degC.copy()
    b_uT[20:23, 3:6], temperature_degC[20:23, 1] = FAILED_B_uT, FAILED_TEMPERATURE_degC
    b_uT[40] = np.nan
    whole = encode(dataclasses.replace(FRAMES, b_uT=b_uT, temperature_degC=temperature_degC), "binary")
    broken = whole[: 82 * 100 + 30] + whole[82 * 101 :]  # 52 bytes of one frame are missing.
    _, account = read(write(tmp_path, "binary", stream=broken), header_of("binary", "rate"))
    assert account["bytes_n"] == len(broken)
    skipped = [key for key in account if key.startswith("skipped_") and key.endswith("_bytes_n")]
    assert account["bytes_n"] == account["frame_bytes_n"] + sum(account[key] for key in skipped)
    dropped = [key for key in account if key.startswith("dropped_") and key.endswith("_frames_n")]
    used = account["frames_noload_n"] + account["frames_contact_n"]
    assert account["frames_n"] == used + sum(account[key] for key in dropped)
    assert account["dropped_failed_read_frames_n"] == 3
    assert account["not_finite_frames_n"] == 1
    assert account["skipped_resync_bytes_n"] > 0


def with_chip_1(rows: slice, values_uT: np.ndarray) -> Frames:
    b_uT = FRAMES.b_uT.copy()
    b_uT[rows, 3:6] = values_uT
    return dataclasses.replace(FRAMES, b_uT=b_uT)


@pytest.mark.parametrize("marks", [MARKS, ()], ids=["marks", "contacts"])
def test_frames_with_a_stuck_chip_are_dropped(tmp_path: Path, marks: tuple[tuple[float, float], ...]) -> None:
    begin = len(FRAMES) // 3
    frozen = with_chip_1(slice(begin, None), FRAMES.b_uT[begin, 3:6])
    _, account = read(write(tmp_path, "binary", frozen), header_of("binary", marks=marks))
    assert account["dropped_stuck_chip_frames_n"] == len(FRAMES) - begin - STUCK_FRAMES_MIN_N + 1
    dropped = [key for key in account if key.startswith("dropped_") and key.endswith("_frames_n")]
    used = account["frames_noload_n"] + account["frames_contact_n"]
    assert account["frames_n"] == used + sum(account[key] for key in dropped)


def test_error_names_a_chip_that_has_power_on_settings(tmp_path: Path) -> None:
    b_uT = FRAMES.b_uT.copy()
    steps_uT = np.tile([0.15, 0.15, 0.242], CHIPS_N).astype(np.float32)
    b_uT = np.round(b_uT / steps_uT) * steps_uT
    reset_uT = np.array([0.98, 0.98, 1.58], np.float32)
    b_uT[600:, 3:6] = np.round(b_uT[600:, 3:6] / reset_uT) * reset_uT
    folder = write(tmp_path, "binary", dataclasses.replace(FRAMES, b_uT=b_uT))
    with pytest.raises(CaptureError, match="stream.bin from frame .*: the LSB of chip 1 must be the same as before"):
        read(folder, header_of("binary"))


@pytest.mark.parametrize("factor", [1e-2, 1e-3, 1e-6])
def test_stream_in_another_unit_is_refused(tmp_path: Path, factor: float) -> None:
    other = dataclasses.replace(FRAMES, b_uT=FRAMES.b_uT * np.float32(factor))
    with pytest.raises(CaptureError, match="stream.bin: field must be .* convert the fields to uT"):
        read(write(tmp_path, "binary", other), header_of("binary"))


@pytest.mark.parametrize(("sent", "declared"), [("text-xyzt", "text-txyz"), ("text-txyz", "text-xyzt")])
# With a scale of 0.05, fields in uT are numbers as small as temperatures in degC.
@pytest.mark.parametrize("scale", [1.0, 0.05])
def test_stream_whose_columns_have_another_order_is_refused(
    tmp_path: Path, sent: Wire, declared: Wire, scale: float
) -> None:
    frames = dataclasses.replace(FRAMES, b_uT=FRAMES.b_uT * np.float32(scale))
    with pytest.raises(
        CaptureError, match=rf"stream.bin: temperatures of {declared} .* If the board sends wire format {sent}"
    ):
        read(write(tmp_path, sent, frames), header_of(declared))


def test_probe_log_in_another_unit_is_refused(tmp_path: Path) -> None:
    folder = write(tmp_path, "binary", probe=probe.render(dataclasses.replace(LOG, x_mm=LOG.x_mm * 1000)).encode())
    with pytest.raises(
        CaptureError,
        match="probe.csv: places must be all equal, or spread over a range of 1 to 200 mm; got a range of 5.9e",
    ):
        read(folder, header_of("binary"))


def test_readings_do_not_depend_on_the_size_of_blocks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    header = header_of("binary")
    whole, whole_account = read(write(tmp_path, "binary"), header)
    monkeypatch.setattr(ingest, "BLOCK_BYTES_N", 1000)
    parts, parts_account = read(tmp_path, header)
    assert parts_account == whole_account
    for name, column in whole.items():
        np.testing.assert_array_equal(parts[name], column, err_msg=name)


def test_frames_without_arrival_time_are_dropped(tmp_path: Path) -> None:
    b_uT, temperature_degC = FRAMES.b_uT.copy(), FRAMES.temperature_degC.copy()
    # One of the frames without an arrival time has a failed read.
    b_uT[-1, 3:6], temperature_degC[-1, 1] = FAILED_B_uT, FAILED_TEMPERATURE_degC
    frames = dataclasses.replace(FRAMES, b_uT=b_uT, temperature_degC=temperature_degC)
    folder = write(tmp_path, "binary", frames)
    rows = (folder / ARRIVALS_FILE).read_text().splitlines(keepends=True)
    (folder / ARRIVALS_FILE).write_text("".join(rows[:-1]))
    timed_n = int(rows[-2].split(",")[0]) // 82
    _, account = read(folder, header_of("binary"))
    assert account["dropped_no_time_frames_n"] == len(FRAMES) - timed_n
    assert account["fault_failed_read_dropped_n"] == 1
    assert "fault_failed_read_first_ms" not in account


def test_readings_written_to_parquet_are_read_unchanged(tmp_path: Path) -> None:
    blocks, account = read_native(write(tmp_path, "binary"), header_of("binary"), DEFAULT_POLICY)
    io.write_readings(tmp_path / "c.parquet", blocks, account)
    assert len(io.read_readings(tmp_path / "c.parquet")) == INDENTATIONS_N * CONTACT_N
    assert io.read_ingest_counts(tmp_path / "c.parquet")["indentations_n"] == INDENTATIONS_N


@pytest.mark.parametrize(
    ("files", "kind", "message"),
    [
        ({"stream": b""}, "rate", "stream.bin: no frame found in 0 bytes"),
        ({"stream": b"\x00"}, "rate", "stream.bin: no frame found in 1 bytes"),
        ({"stream": rng_for(0, "noise").bytes(3000)}, "rate", "no frame found in 3000 bytes, .* Check the baud"),
        (
            {"stream": encode(FRAMES, "binary")[:-100]},
            "arrivals",
            r"stream.bin: the file has \d+ bytes, but .* Copy the whole folder",
        ),
        ({"stream": b"", "arrivals": b""}, "arrivals", "arrivals.csv: "),
        ({"probe": b"\xff\xfe"}, "rate", "probe.csv"),
        ({}, "recording", "clock.kind must be 'arrivals' or 'rate'"),
    ],
)
def test_capture_with_damaged_files_is_refused(
    tmp_path: Path, files: dict[str, bytes], kind: str, message: str
) -> None:
    write(tmp_path, "binary", **files)
    for marks in (MARKS, ()):
        with pytest.raises(CaptureError, match=message):
            read(tmp_path, header_of("binary", kind, marks))


@pytest.mark.parametrize("name", [STREAM_FILE, ARRIVALS_FILE, PROBE_FILE])
def test_missing_file_is_reported(tmp_path: Path, name: str) -> None:
    (write(tmp_path, "binary") / name).unlink()
    with pytest.raises(CaptureError, match=f"{name}: file not found"):
        read(tmp_path, header_of("binary"))


@pytest.mark.parametrize("uptime_s", [0.0, 71.5 * 60, 30 * 3600.0])
def test_uptime_of_the_board_causes_no_faults(tmp_path: Path, uptime_s: float) -> None:
    """The board's clock starts again from 0 after 71.6 minutes, and its resolution becomes coarse after hours."""
    wrap_s = 2**32 / 1e6 if uptime_s < 5000 else np.inf
    frames = dataclasses.replace(FRAMES, device_s=np.mod(FRAMES.device_s + uptime_s, wrap_s))
    _, account = read(write(tmp_path, "binary-clock", frames), header_of("binary-clock"))
    assert account["indentations_n"] == INDENTATIONS_N
    assert not [key for key in account if key.startswith("fault_")]

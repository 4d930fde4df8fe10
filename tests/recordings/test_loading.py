"""Tests that `reskin.load_recording` returns the same readings as the reader of each kind of recording."""

import sys

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest

import reskin
from reskin import io
from reskin.board.wire import Frames, encode, record_type
from reskin.errors import CaptureError, ParamsError, ReskinError
from reskin.recordings import clocks, probe
from reskin.recordings.clocks import Arrivals
from reskin.recordings.decode import decode_file
from reskin.recordings.fault_policy import STANDARD_POLICY
from reskin.recordings.header import ARRIVALS_FILE, PROBE_FILE, STREAM_FILE, Clock, write_capture
from reskin.recordings.ingest import open_capture
from reskin.recordings.readers import sd_card
from reskin.recordings.tables import render_csv
from reskin.schema import LABELS, UNITS
from reskin.seeds import rng_for
from tests.recordings.headers import DEFAULT_POLICY, make_header
from tests.test_io import readings

RATE_HZ, FRAMES_N, CHIPS_N = 100.0, 120, 2
CHANNELS = ["bx0_uT", "by0_uT", "bz0_uT", "bx1_uT", "by1_uT", "bz1_uT"]
# These are the x coordinates of three contacts. Each contact lasts 0.2 s and begins after 0.2 s without contact.
PLACES_MM = (2.0, 6.0, 10.0)


def frames_of_board() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the times, fields (with two decimals) and temperatures of frames with three contacts."""
    t_s = (1 + np.arange(FRAMES_N)) / RATE_HZ
    in_contact = (t_s % 0.4 > 0.2)[:, None]
    b_uT = 900 + 300 * in_contact + 3 * rng_for(0, "frames").standard_normal((FRAMES_N, 3 * CHIPS_N))
    return t_s, np.round(b_uT, 2).astype(np.float32), np.full((FRAMES_N, CHIPS_N), 25, np.float32)


def labels() -> str:
    """Return the labels of the contacts, with times on the clock of the stream."""
    rows = [",".join(probe.TYPES)]
    for i, x_mm in enumerate(PLACES_MM):
        start_s = 0.4 * i
        rows.append(f"{i},0,noload,{start_s + 0.02},{start_s + 0.18},,,,,,")
        rows.append(f"{i},0,contact,{start_s + 0.22},{start_s + 0.38},{x_mm},3,0.5,,,{1 + i}")
    return "\n".join(rows) + "\n"


def write_stream(folder, files=None):
    """Write the frames to the folder of a capture, as `reskin record` does.

    Further files, such as labels, are added.
    """
    t_s, b_uT, temperature_degC = frames_of_board()
    stream = encode(Frames(b_uT, temperature_degC, t_s, np.zeros(FRAMES_N, np.int64)), "binary")
    ends = record_type("binary", CHIPS_N).itemsize * np.arange(FRAMES_N + 1)
    arrivals = clocks.render(Arrivals(ends, np.append(0.0, t_s)))
    clock = Clock(kind="arrivals", rate_hz=None, marks=((0.0, 0.0), (1.2, 1.2)))
    header = make_header(capture=folder.name, layout="native", wire="binary", chips_n=CHIPS_N, clock=clock)
    write_capture(folder, header, {STREAM_FILE: stream, ARRIVALS_FILE: arrivals.encode(), **(files or {})})
    return folder


def check_units(frame):
    assert list(frame.attrs["units"]) == list(frame.columns)
    numeric = {name: unit for name, unit in frame.attrs["units"].items() if name not in LABELS}
    assert {unit for name, unit in numeric.items() if name.endswith(f"_{unit}")} == set(numeric.values()) - {"1"}
    assert all(unit == "1" for name, unit in numeric.items() if not name.endswith(f"_{unit}"))


def test_load_recording_returns_equal_frames_for_all_kinds_of_logs(tmp_path):
    t_s, b_uT, temperature_degC = frames_of_board()
    folder = write_stream(tmp_path / "run1", {PROBE_FILE: labels().encode()})
    (tmp_path / "log.csv").write_text(sd_card.render(t_s, b_uT, temperature_degC))
    decode_file(folder / STREAM_FILE, tmp_path / "decoded.parquet", "binary", CHIPS_N)

    card = reskin.load_recording(tmp_path / "log.csv")
    decoded = reskin.load_recording(str(tmp_path / "decoded.parquet"), rate_hz=RATE_HZ)
    stream = reskin.load_recording(folder, frames=True)
    unlabelled = reskin.load_recording(write_stream(tmp_path / "run2"))

    names = ["t_s", *CHANNELS, "temperature0_degC", "temperature1_degC"]
    assert list(card) == list(decoded) == names
    assert list(stream) == list(unlabelled) == [*LABELS, *names]
    for frame in (card, decoded, stream, unlabelled):
        check_units(frame)
        np.testing.assert_array_equal(frame[CHANNELS], b_uT)
        np.testing.assert_allclose(frame["t_s"], t_s)
        assert frame.attrs["counts"]["rows_n"] == FRAMES_N
    assert set(stream["board"]) == {"board1"}


def test_load_recording_returns_the_rows_that_stage_ingest_writes(tmp_path):
    folder = write_stream(tmp_path / "run1", {PROBE_FILE: labels().encode()})
    _, blocks, counts = open_capture(folder, DEFAULT_POLICY)
    io.write_readings(tmp_path / "run1.parquet", blocks, counts)
    expected = io.read_readings(tmp_path / "run1.parquet")

    frame, ingested = reskin.load_recording(folder), reskin.load_recording(tmp_path / "run1.parquet")

    check_units(frame)
    assert frame.equals(ingested)
    assert frame.attrs["units"] == ingested.attrs["units"]
    assert frame.attrs["counts"] == ingested.attrs["counts"]
    per_row = {name for name in UNITS if name not in ("b_uT", "noload_uT", "temperature_degC")}
    assert per_row < set(frame)
    for name in per_row:
        np.testing.assert_array_equal(frame[name], getattr(expected, name))
    np.testing.assert_array_equal(frame[CHANNELS], expected.b_uT)
    np.testing.assert_array_equal(frame.filter(like="noload_"), expected.noload_uT)
    np.testing.assert_array_equal(frame.filter(like="db"), expected.b_uT - expected.noload_uT)
    # Contacts add 300 uT. The tolerance of 10 uT is about three standard deviations of the noise.
    assert frame["dbx0_uT"].between(290, 310).all()
    assert sorted(frame["x_mm"].unique()) == list(PLACES_MM)


def test_load_recording_has_the_same_fault_policy_as_stage_ingest():
    assert STANDARD_POLICY == DEFAULT_POLICY


def test_table_file_is_read_like_a_capture_of_its_layout(tmp_path):
    t_s, b_uT, _ = frames_of_board()
    contact = t_s % 0.4 > 0.2
    columns = {"phase": np.where(contact, "contact", "noload"), "t_s": t_s, "Fz_N": np.where(contact, 1.5, np.nan)}
    columns |= {"x_mm": np.where(contact, np.repeat(PLACES_MM, FRAMES_N // 3), np.nan), "y_mm": 3.0 * contact}
    columns |= {f"B{axis}{chip}": b_uT[:, 3 * chip + i] for chip in range(CHIPS_N) for i, axis in enumerate("xyz")}
    io.write_table(tmp_path / "my table.parquet", pa.table(columns))
    (tmp_path / "my table.csv").write_text(render_csv(pa.table(columns)))

    frame = reskin.load_recording(tmp_path / "my table.csv")

    check_units(frame)
    # Tolerance: the CSV has only as many digits as single precision needs, so the means of no-load fields differ by
    # rounding.
    pd.testing.assert_frame_equal(frame, reskin.load_recording(tmp_path / "my table.parquet"), rtol=1e-6, atol=1e-4)
    (tmp_path / "my table.csv").write_text(render_csv(pa.table(columns)).replace(",", ";"))
    pd.testing.assert_frame_equal(frame, reskin.load_recording(tmp_path / "my table.csv"))
    np.testing.assert_array_equal(frame[CHANNELS], b_uT[contact])
    assert (set(frame["capture"]), set(frame["board"])) == ({"my_table"}, {"unnamed"})
    counts = frame.attrs["counts"]
    assert counts["rows_n"] + counts["noload_rows_n"] == counts["rows_read_n"] == FRAMES_N
    with pytest.raises(ParamsError, match="only captures that `reskin record` wrote have frames"):
        reskin.load_recording(tmp_path / "my table.csv", frames=True)


def test_load_recording_raises_an_error_that_names_the_unreadable_file(tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "notes.csv").write_text("a,b\n1,2\n")
    io.write_table(tmp_path / "other.parquet", pa.table({"x": [1.0]}))
    io.write_readings(tmp_path / "cut.parquet", [readings()], {})
    (tmp_path / "cut.parquet").write_bytes((tmp_path / "cut.parquet").read_bytes()[:-20])
    for name, message in (
        ("gone", "file not found"), ("empty", "there is no header.json"), ("notes.csv", "line 1 has no column t_s"),
        ("other.parquet", "not those that `reskin decode` writes"), ("cut.parquet", "cannot be read as a table"),
    ):  # fmt: skip
        with pytest.raises(ReskinError, match=rf"{name}.*{message}"):
            reskin.load_recording(tmp_path / name)
    stream = write_stream(tmp_path / "late", {PROBE_FILE: labels().replace(",0,contact", ",0,noload").encode()})
    with pytest.raises(CaptureError, match="late.*set frames=True"):
        reskin.load_recording(stream)
    assert len(reskin.load_recording(stream, frames=True)) == FRAMES_N
    with pytest.raises(CaptureError, match="stream.bin.*with `reskin decode`"):
        reskin.load_recording(stream / STREAM_FILE)


def test_load_recording_tells_which_layout_a_recording_needs(shared_data):
    with pytest.raises(ReskinError, match="This is layout lab. Convert it to a capture with `reskin add`"):
        reskin.load_recording(shared_data / "lab/board1_depth1.csv")


def test_error_names_the_extra_to_install_if_pandas_is_missing(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(
        ParamsError, match=r"load_recording: the Python package `pandas` is not installed.*'\.\[learn\]'"
    ):
        reskin.load_recording(tmp_path)


@pytest.mark.parametrize("uptime_s", [4294.5, 30 * 3600.0])
def test_decoded_dump_of_a_board_that_has_run_for_hours_is_loaded(tmp_path, uptime_s):
    t_s, b_uT, temperature_degC = frames_of_board()
    device_s = (t_s + uptime_s) % 4294.967296 if uptime_s < 5000 else t_s + uptime_s
    data = encode(Frames(b_uT, temperature_degC, device_s, np.zeros(FRAMES_N, np.int64)), "binary-clock")
    (tmp_path / "dump.bin").write_bytes(data)
    decode_file(tmp_path / "dump.bin", tmp_path / "decoded.parquet", "binary-clock", CHIPS_N)
    frame = reskin.load_recording(tmp_path / "decoded.parquet")
    resolution_s = float(np.spacing(np.float32(uptime_s)))
    np.testing.assert_allclose(frame["t_s"] - frame["t_s"][0], t_s - t_s[0], rtol=0, atol=2 * resolution_s)
    coarse = uptime_s > 5000
    assert frame.attrs["counts"].get("coarse_clock_frames_n", 0) == coarse * FRAMES_N
    assert frame.attrs["counts"].get("clock_resolution_us", 0) == coarse * round(1e6 * resolution_s)


def test_rows_of_a_table_whose_time_goes_backwards_are_counted(tmp_path):
    t_s, b_uT, _ = frames_of_board()
    contact = t_s % 0.4 > 0.2
    t_s[60:] -= 0.3
    lines = ["phase,x_mm,y_mm,Bx0,By0,Bz0,Bx1,By1,Bz1,Fz_N,t_s"]
    for i in range(FRAMES_N):
        fields = ",".join(f"{value:.2f}" for value in b_uT[i])
        lines.append(f"{'contact' if contact[i] else 'noload'},2,3,{fields},{2.0 * contact[i]},{t_s[i]:.2f}")
    (tmp_path / "table.csv").write_text("\n".join(lines) + "\n")
    counts = reskin.load_recording(tmp_path / "table.csv").attrs["counts"]
    assert counts["fault_clock_jump_flagged_n"] == 1


def test_raw_counts_of_a_chip_are_named_as_such(tmp_path):
    lines = ["phase,x_mm,y_mm,Bx0,By0,Bz0,Fz_N"]
    rng = rng_for(0, "raw counts")
    for phase, force in (("noload", 0), ("contact", 1)):
        counts = 32768 + rng.integers(-30, 30, (200, 3)) + 300 * force
        lines += [f"{phase},1,2,{x},{y},{z},{force}" for x, y, z in counts]
    (tmp_path / "counts.csv").write_text("\n".join(lines) + "\n")
    with pytest.raises(CaptureError, match="raw counts"):
        reskin.load_recording(tmp_path / "counts.csv")

"""Load recordings: logs as arrays, and recordings of any kind as a pandas DataFrame with units."""

from pathlib import Path

import numpy as np

from reskin import io
from reskin.board.stream import decode_all
from reskin.errors import CaptureError, ParamsError
from reskin.recordings.decode import read_frames
from reskin.recordings.header import LOG_FILE, RATE_MAX_HZ, STREAM_FILE
from reskin.recordings.ingest import read_header, timer
from reskin.recordings.readers import sd_card

PARQUET_MAGIC = b"PAR1"


def read_any_log(log: Path, rate_hz: float) -> sd_card.Log:
    """Read the frames of a capture's folder, of a table that `reskin decode` wrote, or of an SD card's log."""
    if log.is_dir():
        return _read_capture(log)
    if not 0 < rate_hz <= RATE_MAX_HZ:
        raise ParamsError(f"--rate-hz: {rate_hz:g} is not above 0 and at most {RATE_MAX_HZ:g}.")
    if log.is_file():
        with log.open("rb") as stream:
            is_parquet = stream.read(len(PARQUET_MAGIC)) == PARQUET_MAGIC
        if is_parquet:
            return sd_card.keep_whole(*read_frames(io.read_table(log), rate_hz, str(log)), str(log))
    return sd_card.read_log(log)


def _read_capture(folder: Path) -> sd_card.Log:
    """Read the frames of a capture; drop frames after the last recorded arrival time, because they have no time."""
    header = read_header(folder)
    if header.layout == "sd-card":
        return sd_card.read_log(folder / LOG_FILE)
    if header.wire is None:
        raise CaptureError(
            f"{folder}: cannot predict from a capture of layout {header.layout}. Use a capture that `reskin record` "
            "wrote, or the log of an SD card."
        )
    stream = folder / STREAM_FILE
    frames, decoded = decode_all(io.read_bytes(stream), header.wire, header.chips_n, str(stream))
    t_s = timer(folder, header)(frames, 0)
    timed = np.isfinite(t_s)
    kept = frames.where(timed)
    *log, counts = sd_card.keep_whole(t_s[timed], kept.b_uT, kept.temperature_degC, str(stream))
    return *log, decoded | {"dropped_no_time_frames_n": int((~timed).sum())} | counts  # type: ignore[return-value]

"""Tests that every door (bytes, log, table, live board) treats the same fault in the same way, and counts it.

A fault of one chip in some readings is dropped and counted; a board that never answers or never changes is refused with
a sentence that says so before any advice on units.
"""

import gzip
from pathlib import Path

import numpy as np
import pytest

import reskin
from reskin.board.faults import STUCK_FRAMES_MIN_N, FaultDetector
from reskin.board.stream import FrameStream, decode_all
from reskin.board.wire import Frames, encode
from reskin.errors import CaptureError
from reskin.live.health import Health
from reskin.logs import quiet_start
from reskin.recordings.fault_policy import STANDARD_POLICY, FaultLog
from reskin.recordings.readers import sd_card
from reskin.recordings.readers.table import check_columns
from reskin.recordings.tables import TableFile
from reskin.recordings.units import check_fields
from reskin.seeds import rng_for

ROWS_N, CHIPS_N, RATE_HZ = 1600, 5, 100.0
LSB_uT = np.tile([0.15, 0.15, 0.242], CHIPS_N)
BASE_uT = np.array([100, 50, -800, 300, -20, -700, -250, 40, -900, 60, -300, -650, -80, 220, -750.0])
CHANGE_uT = np.array([20, -30, 150, 80, 10, 60, -60, 5, 70, 12, -90, 55, -15, 60, 50.0])
FAULTS = {
    "zeros": [0, 0, 0], "no answer, -1 step": [-0.15, -0.15, -0.242], "extreme code": [-266240.0] * 3,
    "impossible for the step": [100.0, 50.0, -171768.8], "ReSkin firmware": [8028.16, 5194.00, 12943.36],
}  # fmt: skip


def readings(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return readings of a board that is pressed for two seconds, and the rows that are to be spoilt."""
    rng = rng_for(0, "doors", name)
    pressed = (np.arange(ROWS_N) // 200) % 2 == 1
    b_uT = BASE_uT + pressed[:, None] * CHANGE_uT + rng.normal(0, np.tile([2, 2, 3], CHIPS_N), (ROWS_N, 15))
    spoilt = rng.random(ROWS_N) < 0.05
    spoilt[:2] = False
    return np.rint(b_uT / LSB_uT) * LSB_uT, spoilt


def frames_of(b_uT: np.ndarray) -> Frames:
    unknown = np.full(len(b_uT), np.nan)
    failed = (b_uT.reshape(len(b_uT), CHIPS_N, 3) == FAULTS["ReSkin firmware"]).all(axis=2)
    degC = np.where(failed, -880.49, 25.0).astype(np.float32)
    return Frames(b_uT.astype(np.float32), degC, unknown, np.zeros(len(b_uT), np.int64))


def by_bytes(b_uT: np.ndarray, folder: Path, torn: bool = False) -> dict[str, int]:
    """Return what the ingestion of a byte stream counts."""
    data = encode(frames_of(b_uT), "binary")
    frames, account = decode_all(data[:5000] + data[5020 * torn or 5000 :], "binary", CHIPS_N, "a.bin")
    detector, log = FaultDetector(CHIPS_N, frame_bytes_n=82), FaultLog(STANDARD_POLICY, "a.bin", "ms")
    kept_n = 0
    for part in frames.divide(400):
        t_s = part.end_byte / 82 / RATE_HZ
        kept_n += int(log.apply(detector.feed(part, t_s), t_s).keep.sum())
    return account | log.account() | {"dropped_n": len(frames) - kept_n}


def by_log(b_uT: np.ndarray, folder: Path, torn: bool = False) -> dict[str, int]:
    """Return what `reskin predict` and `load_recording` count in a log."""
    rows = np.column_stack([np.arange(len(b_uT)) / RATE_HZ, b_uT])
    names = ",".join(sd_card.column_names(CHIPS_N, temperatures=False))
    np.savetxt(folder / "log.csv", rows, delimiter=",", fmt="%.4f", header=names, comments="")
    if torn:
        lines = (folder / "log.csv").read_text().split("\n")
        (folder / "log.csv").write_text("\n".join([*lines[:60], lines[60][:40], *lines[61:]]))
    *_, account = sd_card.read_log(folder / "log.csv")
    return account | {"dropped_n": account["rows_read_n"] - account["rows_n"]}


def by_table(b_uT: np.ndarray, folder: Path, torn: bool = False) -> dict[str, int]:
    """Return what `reskin add` and `load_recording` count in a table of presses."""
    file, pressed = folder / "table.csv", (np.arange(len(b_uT)) // 200) % 2 == 1
    names = ["phase", "x_mm", "y_mm", *(f"B{axis}{chip}" for chip in range(CHIPS_N) for axis in "xyz"), "Fz_N"]
    lines = [",".join(names)]
    for i, row in enumerate(b_uT):
        place = f"{i // 400 * 2},{i // 800 * 3}"
        fields = ",".join(f"{value:.4f}" for value in row)
        lines.append(f"{'contact' if pressed[i] else 'noload'},{place},{fields},{2.0 * pressed[i]}")
    lines[60] = lines[60][:40] if torn else lines[60]
    file.write_text("\n".join(lines) + "\n")
    counts: dict[str, int] = reskin.load_recording(file).attrs["counts"]
    dropped_n = counts["dropped_failed_read_rows_n"] + counts["dropped_stuck_chip_rows_n"]
    return counts | {"dropped_n": dropped_n}


def by_live(b_uT: np.ndarray, folder: Path, torn: bool = False) -> dict[str, int]:
    """Return the alarms of a live board, and how many frames got no estimate."""
    health, stream, used_n, sent_n = Health(CHIPS_N), FrameStream("binary", CHIPS_N), 0, 0
    data = encode(frames_of(b_uT), "binary")
    data = data[:5000] + data[5020 * torn or 5000 :]
    for first in range(0, len(data), 820):
        frames = stream.feed(data[first : first + 820])
        used_n, sent_n = used_n + int(health.feed(frames, first / 82 / RATE_HZ).sum()), sent_n + len(frames)
    return (
        stream.account()
        | {alarm.name: alarm.count_n for alarm in health.alarms.values()}
        | {"dropped_n": sent_n - used_n}
    )


DOORS = {"bytes": by_bytes, "log": by_log, "table": by_table, "live": by_live}
REFUSED = "refused: "
# What the user sees of each fault at each door: the name of a count, or a word of the error. `spoilt` is the number of
# readings with the fault.
SEEN = {
    "zeros": (
        "fault_zeros_dropped_n",
        "fault_zeros_dropped_n",
        "fault_zeros_dropped_n",
        "chip 2: zeros in place of a reading",
    ),
    "no answer, -1 step": ("fault_failed_read_dropped_n",) * 3 + ("chip 2: failed I2C reads",),
    "extreme code": ("fault_failed_read_dropped_n",) * 3 + ("chip 2: failed I2C reads",),
    "impossible for the step": ("fault_failed_read_dropped_n",) * 3 + ("chip 2: failed I2C reads",),
    "ReSkin firmware": ("fault_failed_read_dropped_n",) * 3 + ("chip 2: failed I2C reads",),
    "stuck": ("fault_stuck_dropped_n",) * 3 + ("chip 2: stuck",),
    "saturated": ("fault_saturated_flagged_n",) * 3 + ("chip 2: field at the end of the range",),
    "frozen": (
        "fault_repeated_flagged_n",
        REFUSED + "repeats one value",
        REFUSED + "repeats one value",
        "frames repeat",
    ),
    "all zero": (
        "fault_zeros_dropped_n",
        REFUSED + "I2C read",
        REFUSED + "I2C read",
        "chip 2: zeros in place of a reading",
    ),
    "never answers": (
        "fault_failed_read_dropped_n",
        REFUSED + "I2C read",
        REFUSED + "I2C read",
        "chip 2: failed I2C reads",
    ),
    "torn": ("skipped_resync_bytes_n", "dropped_torn_lines_n", REFUSED + "columns", "skipped_resync_bytes_n"),
}


def spoil(fault: str) -> tuple[np.ndarray, int]:
    """Return readings with a fault, and how often the user should see it."""
    b_uT, spoilt = readings(fault)
    match fault:
        case "stuck":
            b_uT[600:800, 6:9] = b_uT[600, 6:9]
            return b_uT, 200 - STUCK_FRAMES_MIN_N + 1
        case "saturated":
            spoilt = (np.arange(ROWS_N) // 200) == 3
            b_uT[spoilt, 6] = 0.15 * 2**15
        case "frozen" | "all zero" | "never answers":
            value = {
                "frozen": BASE_uT,
                "all zero": np.zeros(15),
                "never answers": np.tile([-0.15, -0.15, -0.242], CHIPS_N),
            }
            return np.tile(value[fault], (ROWS_N, 1)), ROWS_N
        case "torn":
            return b_uT, 1
        case _:
            spoilt[: 400 * fault.startswith("impossible")] = False  # in a stream, 400 frames tell the step
            b_uT[spoilt, 6:9] = FAULTS[fault]
    return b_uT, int(spoilt.sum())


@pytest.mark.parametrize("fault", SEEN)
@pytest.mark.parametrize("door_i", range(4), ids=DOORS)
def test_each_fault_is_counted_or_refused_at_each_door(door_i, fault, tmp_path):
    read, seen = list(DOORS.values())[door_i], SEEN[fault][door_i]
    b_uT, faulty_n = spoil(fault)
    if seen.startswith(REFUSED):
        with pytest.raises(CaptureError, match=seen.removeprefix(REFUSED)):
            read(b_uT, tmp_path, torn=fault == "torn")
        return
    counts = read(b_uT, tmp_path, torn=fault == "torn")
    if fault == "torn" and seen.endswith("bytes_n"):
        assert counts["skipped_resync_bytes_n"] == 2 * 82 - 20  # a torn frame and the next one are lost
        assert counts["frames_n"] == ROWS_N - 2
    elif fault == "stuck" and seen.startswith("chip"):
        assert counts[seen] == faulty_n
        assert counts["dropped_n"] >= faulty_n - 40  # live boards are checked for stuck chips once per 40 frames
    elif fault == "frozen":
        assert counts[seen] >= 0.9 * faulty_n
    else:
        assert counts[seen] == faulty_n
        assert counts["dropped_n"] == (0 if seen.endswith("flagged_n") or fault == "torn" else faulty_n)


@pytest.mark.parametrize("door", DOORS)
def test_no_fault_is_found_at_any_door_in_sound_readings(door, tmp_path):
    counts = DOORS[door](readings("sound")[0], tmp_path)
    assert counts["dropped_n"] == 0
    assert not [name for name in counts if name.startswith(("fault_", "chip "))]


def test_cut_digits_and_torn_lines_of_logs_are_dropped_and_counted(tmp_path):
    b_uT, spoilt = readings("cut")
    cut = b_uT.copy()
    cut[spoilt, 8] = np.trunc(cut[spoilt, 8] / 10)
    assert by_log(cut, tmp_path)["dropped_n"] == pytest.approx(
        spoilt.sum(), abs=2
    )  # beside the start of a press, all differ
    by_log(b_uT, tmp_path)
    lines = (tmp_path / "log.csv").read_text().splitlines()
    for i in (5, 50, 500):
        lines[i] = ",".join(lines[i].split(",")[:7])
    lines[6], lines[7] = (
        lines[6].replace(lines[6].split(",")[3], "", 1),
        lines[7].replace(lines[7].split(",")[3], "1.2.3", 1),
    )
    (tmp_path / "torn.csv").write_text("\n".join(lines) + "\n")
    *_, counts = sd_card.read_log(tmp_path / "torn.csv")
    assert counts["dropped_torn_lines_n"] == 5
    assert counts["rows_n"] == ROWS_N - 5
    (tmp_path / "torn.csv").write_text("\n".join([lines[0], *(line[:30] for line in lines[1:])]) + "\n")
    with pytest.raises(CaptureError, match="1600 of 1600 lines are torn"):
        sd_card.read_log(tmp_path / "torn.csv")


@pytest.mark.parametrize(
    ("step_uT", "scale"),
    [
        (100 / 6842, 0.15),
        (100 / 3750, 1.0),
        (1 / 75, 0.15),
        (100 / 16384, 1.0),
        (0.3, 1.0),
        (98.0, 20.0),
        (130.0, 20.0),
    ],
)
def test_correct_recordings_of_other_chips_are_accepted(step_uT, scale):
    rng = rng_for(0, "chips")
    b_uT = BASE_uT * scale + rng.normal(0, max(20 * step_uT, 0.3), (2000, 15))
    check_fields(np.rint(b_uT / step_uT) * step_uT, "a.csv")


def test_values_in_other_units_and_raw_counts_are_refused():
    b_uT, _ = readings("units")
    for factor, message in ((1000.0, "nT|full scale"), (1e-3, "earth's field"), (0.01, "earth's field|probably G")):
        with pytest.raises(CaptureError, match=message):
            check_fields(factor * b_uT, "a.csv")
    counts = np.rint(BASE_uT * 6 + 32768 + rng_for(0, "counts").normal(0, 6, (2000, 15)))
    with pytest.raises(CaptureError, match="raw counts"):
        check_fields(counts, "a.csv")


@pytest.mark.parametrize("chips_n", [5, 15])
@pytest.mark.parametrize("rate_hz", [5, 10, 20, 50, 100, 400])
def test_noise_alone_is_not_taken_for_a_touch_but_presses_are_found(rate_hz, chips_n):
    rng, refused_n, missed_n, n = rng_for(0, "quiet", rate_hz, chips_n), 0, 0, max(3 * rate_hz, 12)
    t_s = np.arange(n) / rate_hz
    for _ in range(60):
        b_uT = (np.tile([100.0, 50.0, -800.0], chips_n) + rng.normal(0, 3, (n, 3 * chips_n))).astype(np.float32)
        try:
            quiet_start(t_s, b_uT, where="log")
        except CaptureError:
            refused_n += 1
        pressed = b_uT + ((t_s >= 0.4) & (t_s < 2))[:, None] * np.tile([20.0, -10.0, 60.0], chips_n).astype(np.float32)
        try:
            missed_n += quiet_start(t_s, pressed, where="log") / rate_hz > 0.6
        except CaptureError:
            pass
    assert refused_n <= 2
    assert missed_n <= (60 if rate_hz == 5 else 1)  # at 5 Hz, the first two windows reach beyond the start of the press


@pytest.mark.parametrize(
    ("names", "remedy"),
    [
        (["PHASE", "x_mm", "Bx0", "by0", "Bz0"], "Rename PHASE to phase, by0 to By0."),
        (["phase", "x_mm", "Bx1", "By1", "Bz1"], "The chips seem to be numbered from 1"),
        (["phase", "x_mm", "mag"], "describe them in a file for option --columns"),
    ],
)
def test_renamings_are_proposed(names, remedy):
    with pytest.raises(CaptureError, match=remedy):
        check_columns(names, ["phase", "x_mm", "Bx0", "By0", "Bz0"], "here")


@pytest.mark.parametrize(
    "change",
    [
        lambda text: text.replace(b",", b"\t"),
        lambda text: text.replace(b",", b"; "),
        lambda text: text.replace(b",", b"  "),
        gzip.compress,
        lambda text: text.decode().encode("utf-16"),
    ],
    ids=["tab", "semicolon", "blanks", "gz", "utf-16"],
)
def test_table_may_have_tabs_or_be_compressed(tmp_path, change):
    file = tmp_path / "readings.csv"
    file.write_bytes(change(b"a,b\n1,2\n3,4\n"))
    found = TableFile(file, "here").read(["b"], ["a"])
    assert found.to_pydict() == {"b": [2.0, 4.0], "a": ["1", "3"]}

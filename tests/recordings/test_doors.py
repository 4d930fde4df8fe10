"""Tests that every door (byte stream, log, table) treats the same fault in the same way, and counts it.

A fault of one chip in some readings is dropped and counted; a board that never answers or never changes is refused with
a sentence that says so before any advice on units.
"""

import gzip
from pathlib import Path

import numpy as np
import pytest

import reskin
from reskin.board.faults import FaultDetector
from reskin.board.wire import Frames
from reskin.errors import CaptureError
from reskin.logs import quiet_start
from reskin.recordings.fault_policy import STANDARD_POLICY, FaultLog
from reskin.recordings.readers import sd_card
from reskin.recordings.tables import TableFile, check_columns
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


def by_stream(b_uT: np.ndarray, folder: Path) -> int:
    """Return how many frames of a stream are dropped."""
    temperature = np.full((len(b_uT), CHIPS_N), np.nan, np.float32)
    t_s = np.arange(len(b_uT)) / RATE_HZ
    frames = Frames(b_uT.astype(np.float32), temperature, np.full(len(b_uT), np.nan), 82 * (1 + np.arange(len(b_uT))))
    detector, log = FaultDetector(CHIPS_N, frame_bytes_n=82), FaultLog(STANDARD_POLICY, "a.bin", "ms")
    kept_n = 0
    for rows in np.array_split(np.arange(len(b_uT)), 4):
        part = frames.where(np.isin(np.arange(len(b_uT)), rows))
        kept_n += int(log.apply(detector.feed(part, t_s[rows]), t_s[rows]).keep.sum())
    return len(b_uT) - kept_n


def by_log(b_uT: np.ndarray, folder: Path) -> int:
    """Return how many lines of a log are dropped."""
    file = folder / "log.csv"
    rows = np.column_stack([np.arange(len(b_uT)) / RATE_HZ, b_uT])
    names = ",".join(sd_card.column_names(CHIPS_N, temperatures=False))
    np.savetxt(file, rows, delimiter=",", fmt="%.4f", header=names, comments="")
    return len(b_uT) - len(sd_card.read_log(file)[0])


def by_table(b_uT: np.ndarray, folder: Path) -> int:
    """Return how many rows of a table are dropped."""
    file, pressed = folder / "table.csv", (np.arange(len(b_uT)) // 200) % 2 == 1
    names = ["phase", "x_mm", "y_mm", *(f"B{axis}{chip}" for chip in range(CHIPS_N) for axis in "xyz"), "Fz_N"]
    lines = [",".join(names)]
    for i, row in enumerate(b_uT):
        place = f"{i // 400 * 2},{i // 800 * 3}"
        fields = ",".join(f"{value:.4f}" for value in row)
        lines.append(f"{'contact' if pressed[i] else 'noload'},{place},{fields},{2.0 * pressed[i]}")
    file.write_text("\n".join(lines) + "\n")
    return int(reskin.load_recording(file).attrs["counts"]["dropped_failed_read_rows_n"])


DOORS = {"stream": by_stream, "log": by_log, "table": by_table}


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("door", DOORS)
def test_failed_reads_of_one_chip_are_dropped_and_counted_at_every_door(door, fault, tmp_path):
    b_uT, spoilt = readings(fault)
    if door == "stream" and fault.startswith("impossible"):
        spoilt[: ROWS_N // 2] = False  # in a stream, the step is known after the first frames
    assert DOORS[door](b_uT, tmp_path) == 0
    b_uT[spoilt, 6:9] = FAULTS[fault]
    assert DOORS[door](b_uT, tmp_path) == spoilt.sum()


@pytest.mark.parametrize("door", ["log", "table"])
def test_boards_that_never_answer_or_never_change_are_refused_before_advice_on_units(door, tmp_path):
    b_uT, _ = readings("dead")
    for value, message in (
        (np.tile([-0.15, -0.15, -0.242], CHIPS_N), "the I2C read of a chip failed"),
        (np.zeros(15), "the I2C read of a chip failed"),
        (BASE_uT, "every reading is the same.*repeats one value"),
    ):  # fmt: skip
        with pytest.raises(CaptureError, match=message):
            DOORS[door](np.tile(value, (ROWS_N, 1)), tmp_path)
    b_uT[:, 6:9] = [-0.15, -0.15, -0.242]
    with pytest.raises(CaptureError, match="the I2C read of a chip failed"):
        DOORS[door](b_uT, tmp_path)


def test_cut_digits_and_torn_lines_of_logs_are_dropped_and_counted(tmp_path):
    b_uT, spoilt = readings("cut")
    cut = b_uT.copy()
    cut[spoilt, 8] = np.trunc(cut[spoilt, 8] / 10)
    assert by_log(cut, tmp_path) == pytest.approx(spoilt.sum(), abs=2)  # beside the start of a press, all differ
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


def test_fields_at_the_end_of_the_range_of_the_detected_step_are_counted(tmp_path):
    b_uT, _ = readings("clip")
    limit_uT = 0.15 * 2**15 - 0.15
    b_uT[:, 3] = np.minimum(b_uT[:, 3] + limit_uT - 320, limit_uT)
    clipped_n = int((b_uT[(np.arange(ROWS_N) // 200) % 2 == 1, 3] == limit_uT).sum())
    by_table(b_uT, tmp_path)
    counts = reskin.load_recording(tmp_path / "table.csv").attrs["counts"]
    assert counts["fault_saturated_flagged_n"] >= clipped_n > 100


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
    check_fields(np.rint(b_uT / step_uT) * step_uT, "a.csv", first_line_n=1)


def test_values_in_other_units_and_raw_counts_are_refused():
    b_uT, _ = readings("units")
    for factor, message in ((1000.0, "nT|full scale"), (1e-3, "earth's field"), (0.01, "earth's field|probably G")):
        with pytest.raises(CaptureError, match=message):
            check_fields(factor * b_uT, "a.csv", first_line_n=1)
    counts = np.rint(BASE_uT * 6 + 32768 + rng_for(0, "counts").normal(0, 6, (2000, 15)))
    with pytest.raises(CaptureError, match="raw counts"):
        check_fields(counts, "a.csv", first_line_n=1)


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
        check_columns(names, ["phase", "x_mm", "Bx0", "By0", "Bz0"], "here", layout="table")


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

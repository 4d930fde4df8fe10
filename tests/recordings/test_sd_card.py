"""Tests of reading and writing the logs that a board writes to an SD card, with faults and errors."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from reskin.board.faults import FAILED_B_uT, FAILED_TEMPERATURE_degC
from reskin.errors import CaptureError
from reskin.recordings.readers.sd_card import column_names, read_log, render
from reskin.seeds import rng_for


def random_log(frames_n=60, chips_n=2):
    rng = rng_for(0, "card", chips_n)
    step_uT = np.tile([0.2, 0.2, 0.32], chips_n)
    b_uT = (np.rint(rng.normal(0, 12, (frames_n, 3 * chips_n))) * step_uT + 500).astype(np.float32)
    t_s = (1 + np.arange(frames_n)) / 250
    return t_s, b_uT, rng.normal(25, 0.1, (frames_n, chips_n)).astype(np.float32)


@pytest.fixture
def log(tmp_path):
    file = tmp_path / "log.csv"
    file.write_text(render(*random_log()))
    return file


def lines(file):
    return file.read_text().splitlines(keepends=True)


@given(chips_n=st.integers(1, 8))
def test_written_log_is_read_unchanged(tmp_path_factory, chips_n):
    t_s, b_uT, temperature_degC = random_log(chips_n=chips_n)
    file = tmp_path_factory.mktemp("card") / "log.csv"
    file.write_text(render(t_s, b_uT, temperature_degC))
    read_s, read_uT, read_degC, account = read_log(file)
    np.testing.assert_allclose(read_s, t_s, atol=5.1e-5)  # Tolerance: times are written with four decimals.
    np.testing.assert_allclose(read_uT, b_uT, atol=5.1e-3)  # Tolerance: fields are written with two decimals.
    np.testing.assert_allclose(read_degC, temperature_degC, atol=5.1e-3)
    assert account["rows_n"] == account["rows_read_n"] == 60


def test_header_line_of_an_sd_card_log_equals_that_of_the_firmware(log):
    assert column_names(2) == ["t_s", "T0", "Bx0", "By0", "Bz0", "T1", "Bx1", "By1", "Bz1"]
    assert lines(log)[0] == "t_s,T0,Bx0,By0,Bz0,T1,Bx1,By1,Bz1\n"


def test_sd_card_log_without_temperatures_is_read(log):
    with_temperatures = read_log(log)
    columns = [[cell for i, cell in enumerate(row.split(",")) if i % 4 != 1] for row in lines(log)]
    log.write_text("".join(",".join(row) for row in columns))
    t_s, b_uT, temperature_degC, account = read_log(log)
    for read, expected in zip((t_s, b_uT, account), (*with_temperatures[:2], with_temperatures[3]), strict=True):
        np.testing.assert_equal(read, expected)
    assert temperature_degC.shape == with_temperatures[2].shape
    assert np.isnan(temperature_degC).all()


@pytest.mark.parametrize("separator", [";", "\t"])
def test_columns_may_have_another_order_and_separator_and_others_are_counted(log, separator):
    whole = read_log(log)
    rows = [row.rstrip().split(",") for row in lines(log)]
    log.write_text("".join(separator.join([*row[::-1], "note"]) + "\n" for row in rows))
    found = read_log(log)
    for one, other in zip(whole[:3], found[:3], strict=True):
        np.testing.assert_array_equal(one, other)
    assert found[3] == whole[3] | {"ignored_columns_n": 1}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda rows: rows[1:], "no column t_s, .* If line 1 has numbers, add the column names"),
        (lambda rows: [rows[0].replace("Bz1", "bz1"), *rows[1:]], "line 1 has no column Bz1"),
        (lambda rows: [rows[0].replace("T0,", ""), *rows[1:]], "line 1 has no column T0"),
        (lambda rows: [rows[0].replace("T0,", "").replace("T1,", ""), *rows[1:]], "60 of 60 lines are torn"),
        (lambda rows: ["phase,x_mm,y_mm,Bx0\n", *rows[1:]], "no column t_s, .* reskin add"),
        (lambda rows: [*rows[:-1], rows[-1].rstrip()], "the last line has no line break"),
        (lambda rows: [*rows[:9], rows[9].replace("0.0360", "0.0300"), *rows[10:]], "row 10: t_s must be later"),
        (lambda rows: [*rows[:9], rows[8], *rows[9:]], "row 10: t_s must be later"),
        (lambda rows: rows[:1], "the log has no lines"),
        (lambda rows: rows[:2], "fewer than two lines"),
        (lambda _: [], "the file is empty"),
    ],
)
def test_log_with_invalid_content_is_refused(log, change, message):
    log.write_text("".join(change(lines(log))))
    with pytest.raises(CaptureError, match=message) as refused:
        read_log(log)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    "damage",
    [
        lambda row: row[:20] + "\n",
        lambda row: row[: row.rindex(",")] + ",nan\n",
        lambda row: row[: row.rindex(",")] + ",\n",
        lambda row: row.replace(".", "x"),
    ],
    ids=["short", "nan", "empty", "no numbers"],
)
@pytest.mark.parametrize("line_i", [5, 60], ids=["inside", "last"])
def test_torn_lines_are_dropped_and_counted(log, damage, line_i):
    whole = read_log(log)
    rows = lines(log)
    log.write_text("".join([*rows[:line_i], damage(rows[line_i]), *rows[line_i + 1 :]]))
    t_s, b_uT, _, account = read_log(log)
    assert account["dropped_torn_lines_n"] == 1
    np.testing.assert_array_equal(b_uT, np.delete(whole[1], line_i - 1, axis=0))
    assert len(t_s) == account["rows_n"] == len(whole[0]) - 1


def test_errors_name_the_row_of_the_file_although_torn_lines_were_dropped(log):
    rows = lines(log)
    log.write_text("".join([*rows[:3], "1,2\n", *rows[3:9], rows[8], *rows[9:]]))
    with pytest.raises(CaptureError, match="row 11: t_s must be later"):
        read_log(log)


def test_missing_log_is_reported(tmp_path):
    with pytest.raises(CaptureError, match="file not found"):
        read_log(tmp_path / "log.csv")


def test_missing_frames_are_counted(log):
    rows = lines(log)
    log.write_text("".join([*rows[:10], *rows[13:30], *rows[31:]]))
    account = read_log(log)[3]
    assert (account["gaps_n"], account["gap_frames_n"]) == (2, 4)


def test_frames_with_failed_reads_and_stuck_chips_are_dropped(log):
    t_s, b_uT, temperature_degC = random_log()
    b_uT[3, :3], temperature_degC[3, 0] = FAILED_B_uT, FAILED_TEMPERATURE_degC
    b_uT[30:, 3:] = b_uT[30, 3:]  # There are 30 equal frames. From the 20th of them on, the chip counts as stuck.
    log.write_text(render(t_s, b_uT, temperature_degC))
    read_s, _, _, account = read_log(log)
    assert account["dropped_failed_read_rows_n"] == 1
    assert account["dropped_stuck_chip_rows_n"] == 11
    assert len(read_s) == account["rows_n"] == 60 - 12
    assert not np.isclose(read_s, t_s[3]).any()


@pytest.mark.parametrize("frames_n", [200, 400])
def test_chip_with_power_on_settings_is_refused(log, frames_n):
    t_s, b_uT, temperature_degC = random_log(frames_n=frames_n, chips_n=3)
    b_uT[:, 3:6] = (500 + (b_uT[:, 3:6] - 500) / [0.2, 0.2, 0.32] * [0.98, 0.98, 1.58]).astype(np.float32)
    log.write_text(render(t_s, b_uT, temperature_degC))
    with pytest.raises(CaptureError, match="the LSB of chip 1 must be"):
        read_log(log)


@pytest.mark.parametrize(
    ("factor", "rate"),
    [(1e3, "0.25"), (1 / 100, r"2.5e\+04")],
)
def test_time_in_another_unit_is_refused(log, factor, rate):
    header, *rows = lines(log)
    rows = [f"{factor * float(t_s):.7f},{rest}" for t_s, rest in (row.split(",", 1) for row in rows)]
    log.write_text("".join([header, *rows]))
    rule = "the rate must be 1 to 10000 lines per second; got " + rate
    with pytest.raises(CaptureError, match=rule + ". t_s must be in seconds"):
        read_log(log)


def test_byte_order_mark_is_ignored(log):
    plain = read_log(log)
    log.write_bytes(b"\xef\xbb\xbf" + log.read_bytes())
    marked = read_log(log)
    for one, other in zip(plain[:3], marked[:3], strict=True):
        np.testing.assert_array_equal(one, other)
    assert plain[3] == marked[3]


def log_with_faults(failed_n, stuck_n, frames_n=60):
    t_s, b_uT, temperature_degC = random_log(frames_n)
    b_uT[:failed_n, :3], temperature_degC[:failed_n, 0] = FAILED_B_uT, FAILED_TEMPERATURE_degC
    b_uT[frames_n - stuck_n :, 3:] = b_uT[-1, 3:]
    return t_s, b_uT, temperature_degC


def test_log_with_too_many_faults_is_refused(log):
    log.write_text(render(*log_with_faults(40, 0)))
    with pytest.raises(
        CaptureError,
        match="only 20 of 60 lines are fault-free: 40 had failed I2C reads, and 0 had stuck chips. At least 50 %",
    ):
        read_log(log)
    log.write_text(render(*log_with_faults(5, 50)))
    with pytest.raises(
        CaptureError,
        match=r"\d+ of 60 lines are fault-free: 5 had failed I2C reads, and \d+ had stuck chips. .*heck the wiring",
    ):
        read_log(log)
    log.write_text(render(*log_with_faults(30, 0)))
    assert read_log(log)[3]["rows_n"] == 30

"""Tests of reading and writing the probe log, a CSV file with the labels. Errors must name the invalid row."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from reskin.errors import CaptureError
from reskin.recordings import probe
from reskin.recordings.probe import LABELS, ProbeLog
from reskin.recordings.units import check_log
from reskin.seeds import rng_for

HEAD = "indentation,pass_i,phase,t_start_s,t_end_s,x_mm,y_mm,depth_mm,Fx_N,Fy_N,Fz_N\n"
GOOD = (
    HEAD
    + "0,0,noload,0.0,0.5,,,,,,\n0,0,contact,1.0,1.5,2,4,0.6,,,1.25\n"
    + "1,0,noload,2,2.5,,,,,,\n1,0,contact,3,3.5,4,4,0.8,,,2.5\n"
)


def assert_same(one: ProbeLog, other: ProbeLog) -> None:
    for name in ProbeLog.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)


def test_written_log_is_read_unchanged() -> None:
    log = probe.parse(GOOD, "probe.csv")
    assert log.indentation.tolist() == [0, 0, 1, 1]
    assert log.contact.tolist() == [False, True, False, True]
    assert log.t_end_s.tolist() == [0.5, 1.5, 2.5, 3.5]
    assert log.x_mm.tolist()[1::2] == [2.0, 4.0]
    assert np.isnan(log.x_mm[0])
    assert np.isnan(log.Fx_N).all()
    assert log.Fz_N[3] == 2.5


def test_columns_may_be_in_any_order() -> None:
    swapped = "\n".join(",".join(reversed(row.split(","))) for row in GOOD.splitlines()) + "\n"
    assert_same(probe.parse(swapped, "probe.csv"), probe.parse(GOOD, "probe.csv"))


def test_probe_log_can_be_read_from_a_file_or_from_its_text(tmp_path: Path) -> None:
    (tmp_path / "probe.csv").write_text(GOOD, encoding="utf-8")
    assert_same(probe.parse(tmp_path / "probe.csv", "probe.csv"), probe.parse(GOOD, "probe.csv"))


@given(
    lengths=st.lists(st.floats(1e-3, 1e3), min_size=4, max_size=4),
    begin_s=st.floats(-1e9, 1e9),
    label=st.floats(-(2.0**39), 2.0**39, width=32) | st.just(float("nan")),
)
def test_numbers_are_written_without_rounding(lengths: list[float], begin_s: float, label: float) -> None:
    edges_s = begin_s + np.cumsum(lengths)
    labels = {name: np.array([np.nan, label], np.float32) for name in LABELS}
    number = np.zeros(2, np.int32)
    log = ProbeLog(number, number, np.array([False, True]), edges_s[0::2], edges_s[1::2], **labels)
    assert_same(probe.parse(probe.render(log), "probe.csv"), log)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("Fz_N\n", "Fz_lbf\n", "no column 'Fz_N'; the file has .*Fz_lbf"),
        (",Fz_N\n", "\n", "no column 'Fz_N'"),
        ("Fy_N,Fz_N\n", "Fz_N,Fz_N\n", "no column 'Fy_N'"),
        ("0.6", "deep", "depth_mm in line 3 must be a number .*; got 'deep'"),
        ("0,0,contact", "0.5,0,contact", "row 3: indentation must be a whole number; got 0.5"),
        ("1,0,contact", "1,0,touch", "row 5: phase must be noload or contact; got touch"),
        ("1,0,contact", "1,0,", "row 5: phase must be noload or contact"),
        ("1,0,contact", ",0,contact", "row 5: indentation must be known"),
        ("1,0,contact", "1,-1,contact", "row 5: pass_i must be 0 or more; got -1"),
        ("2,2.5,", ",2.5,", "row 4: t_start_s must be known"),
        ("2,2.5,", "nan,2.5,", "row 4: t_start_s must be known"),
        ("1.0,1.5", "1.0,0.9", "row 3: t_end_s must be later than t_start_s in the same row; got 0.9"),
        ("2,2.5,", "1.4,2.5,", "row 4: t_start_s must be no earlier than t_end_s in the row above; got 1.4"),
        ("2.5\n", "inf\n", "Fz_N in line 5 must be a number .*; got 'inf'"),
        (
            "0,0,noload,0.0,0.5,,,,,,\n",
            "",
            "row 2: the phase of the first row of an indentation must be noload; got contact",
        ),
        (
            "1,0,contact",
            "1,0,noload",
            "row 5: the phase of the later rows of an indentation must be contact; got noload",
        ),
        ("1,0,contact", "0,0,contact", "row 5: indentation must be no smaller than in the row above; got 0"),
        (GOOD.removeprefix(HEAD), "", "the probe log has no rows"),
        (GOOD, "", "the file is empty"),
        (GOOD, "\x00\x01\x02", "no column"),
        (GOOD, "\n\n", "the file is empty"),
    ],
)
def test_error_names_the_row_of_an_invalid_log(old: str, new: str, message: str) -> None:
    assert old in GOOD
    with pytest.raises(CaptureError, match=rf"^probe\.csv.*({message})"):
        probe.parse(GOOD.replace(old, new, 1), "probe.csv")


def test_random_bytes_raise_a_capture_error(tmp_path: Path) -> None:
    noise = rng_for(0, "noise").bytes(4096)
    (tmp_path / "probe.csv").write_bytes(noise)
    with pytest.raises(CaptureError):
        probe.parse(tmp_path / "probe.csv", "probe.csv")
    with pytest.raises(CaptureError, match="file not found"):
        probe.parse(tmp_path / "absent.csv", "absent.csv")


UNITS_LOG = probe.parse(
    "indentation,pass_i,phase,t_start_s,t_end_s,x_mm,y_mm,depth_mm,Fx_N,Fy_N,Fz_N\n"
    "0,0,noload,0.0,0.5,,,,,,0\n0,0,contact,1.0,1.5,2,4,0.6,,,1.25\n"
    "1,0,noload,2,2.5,,,,,,0\n1,0,contact,3,3.5,16,4,0.8,,,2.5\n",
    "probe.csv",
)


@pytest.mark.parametrize(
    ("column", "factor", "message"),
    [
        ("x_mm", 1e-3, "places must be .* convert the places to mm"),
        ("x_mm", 1e3, "places must be .* convert the places to mm"),
        ("depth_mm", 1e-3, "the greatest depth must be .* convert the depths to mm"),
        ("depth_mm", 1e3, "the greatest depth must be .* convert the depths to mm"),
        ("Fz_N", 102.0, "force must be below 100 N; got 127.5 in line 3. If the unit of the file is g"),
        ("Fz_N", 1e3, "force must be below 100 N"),
        ("Fz_N", 1e-3, "force must be at least 0.05 N in one or more rows with contact; got 0.0025 N at most"),
        ("Fz_N", -1.0, "the median of Fz_N in contact must be positive; got -1.875 N. Reverse the sign"),
    ],
)
def test_other_units_or_signs_are_refused(column: str, factor: float, message: str) -> None:
    check_log(UNITS_LOG, "probe.csv")
    other = dataclasses.replace(UNITS_LOG, **{column: getattr(UNITS_LOG, column) * np.float32(factor)})
    with pytest.raises(CaptureError, match=rf"^probe.csv: {message}"):
        check_log(other, "probe.csv")


def test_probe_log_whose_labels_are_all_unknown_is_accepted() -> None:
    unknown = np.full(len(UNITS_LOG), np.nan, np.float32)
    check_log(dataclasses.replace(UNITS_LOG, **dict.fromkeys(probe.LABELS, unknown)), "probe.csv")

"""Tests that labels become a valid probe log, with equal dwells (stops of the tip) for chunks of any size."""

import math
import tracemalloc

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from reskin.errors import CaptureError
from reskin.recordings import probe
from reskin.recordings.header import PROBE_FILE
from reskin.recordings.labels import (
    Dwell,
    DWELL_MAX_s,
    DwellBuilder,
    GaugeLines,
    Label,
    ProbeLogWriter,
    SampleTable,
)

NUMBER = st.floats(-1e6, 1e6, width=32) | st.just(math.nan)
LABEL = st.builds(Label, st.booleans(), *[NUMBER] * 6, st.integers(0, 9))
DWELL = st.builds(lambda label, start_s, lasts_s: Dwell(label, start_s, start_s + lasts_s), LABEL,
                  st.floats(0, 100), st.floats(0.001, 5))  # fmt: skip


def test_writer_skips_dwells_that_do_not_fit_and_writes_the_touch(tmp_path):
    writer = ProbeLogWriter(tmp_path)
    # This dwell is skipped, because no no-load dwell comes before it.
    writer.write(Dwell(Label(True, 1.0, 2.0), 0.0, 1.0))
    writer.write(Dwell(Label(False), 1.0, 2.0))
    assert len((tmp_path / PROBE_FILE).read_text().splitlines()) == 1
    writer.write(Dwell(Label(True, 4.0, 8.0, Fz_N=0.5, pass_i=1), 3.0, 4.0))
    writer.write(Dwell(Label(True, 4.0, 8.0, Fz_N=0.7, pass_i=1), 4.0, 5.0))  # This is a later dwell of the same touch.
    writer.write(Dwell(Label(False), 4.5, 5.5))  # This dwell is skipped, because it begins before the touch has ended.
    log = probe.parse(tmp_path / PROBE_FILE, "log")
    assert log.indentation.tolist() == [0, 0, 0]
    assert log.contact.tolist() == [False, True, True]
    assert log.pass_i.tolist() == [1, 1, 1]
    assert log.Fz_N[1:] == pytest.approx([0.5, 0.7])
    assert math.isnan(log.x_mm[0])
    assert (writer.touches_n, writer.without_noload_n, writer.out_of_order_n) == (1, 1, 1)
    writer.close()
    # This dwell is skipped, because it comes too late, from a program that hangs.
    writer.write(Dwell(Label(True, 1.0, 1.0), 8.0, 9.0))


def test_touch_that_moves_to_another_place_without_a_lift_is_skipped(tmp_path):
    writer = ProbeLogWriter(tmp_path)
    places = [(4.0, 8.0), (4.001, 8.0), (5.0, 8.0), (4.0, 9.0), (math.nan, 8.0), (4.0, 8.0)]
    writer.write(Dwell(Label(False), 0.0, 1.0))
    for i, (x_mm, y_mm) in enumerate(places):
        writer.write(Dwell(Label(True, x_mm, y_mm), i + 1.0, i + 2.0))
    writer.close()
    log = probe.parse(tmp_path / PROBE_FILE, "log")
    assert log.t_start_s.tolist() == [0.0, 1.0, 2.0, 6.0]
    assert (writer.touches_n, writer.without_noload_n) == (1, 3)


@settings(max_examples=60)
@given(st.lists(DWELL, max_size=12))
def test_log_of_any_sequence_of_labels_can_be_read(tmp_path_factory, dwells):
    folder = tmp_path_factory.mktemp("labels")
    writer = ProbeLogWriter(folder)
    for dwell in dwells:
        writer.write(dwell)
    writer.close()
    if writer.touches_n:
        log = probe.parse(folder / PROBE_FILE, "log")
        assert len(set(log.indentation)) == writer.touches_n == (~log.contact).sum()


@pytest.mark.parametrize(
    ("label", "end_s"),
    [(Label(True, math.inf), 1.0), (Label(True, 1e12), 1.0), (Label(True, pass_i=-1), 1.0), (Label(True), 0.0),
     (Label(True), math.nan), (Label(True), 1e15)],
)  # fmt: skip
def test_invalid_label_is_refused(tmp_path, label, end_s):
    writer = ProbeLogWriter(tmp_path)
    with pytest.raises(CaptureError, match="a label: .* (must be|is not a valid time span)"):
        writer.write(Dwell(label, 0.0, end_s))
    writer.close()


HEAD = "unix_s,phase,x_mm,y_mm,Fz_N,note\n"


def rows(phase: str, first_s: float, n: int, x_mm: float, force_N: float = 0.0) -> str:
    return "".join(f"{first_s + 0.1 * i:.1f},{phase},{x_mm},2,{force_N},\n" for i in range(n))


def dwells_of(text: str, chunk_n: int = 10**6) -> tuple[list[Dwell], SampleTable]:
    table, dwells, data = SampleTable("log"), DwellBuilder(), text.encode()
    parts = [data[first : first + chunk_n] for first in range(0, len(data), chunk_n)]
    found = [dwell for part in parts for dwell in dwells.feed(table.feed(part))]
    return [*found, *dwells.close()], table


def test_each_phase_of_a_table_becomes_one_dwell():
    text = HEAD + rows("noload", 0, 30, 1) + rows("moving", 3, 5, 2) + rows("contact", 4, 4, 3, 0.5)
    (rest, touch), _ = dwells_of(text)
    assert (rest.label.contact, rest.t_start_s, rest.t_end_s) == (False, 0.0, 2.9)
    assert (touch.label.contact, touch.t_start_s, touch.label.x_mm) == (True, 4.0, 3.0)
    assert touch.label.Fz_N == 0.5


def test_dwell_ends_at_the_maximum_duration_and_where_the_place_changes():
    text = HEAD + "".join(rows("contact", i, 10, 3, 0.1 * (i + 1)) for i in range(3)) + rows("contact", 3, 3, 4)
    found, _ = dwells_of(text)
    assert all(dwell.t_end_s - dwell.t_start_s <= DWELL_MAX_s + 0.11 for dwell in found)
    assert found[-1].label.x_mm == 4
    assert sorted(dwell.label.Fz_N for dwell in found[:-1]) == [dwell.label.Fz_N for dwell in found[:-1]]
    assert len(found) == 6


@settings(max_examples=40)
@given(st.integers(1, 60))
def test_dwells_do_not_depend_on_the_size_of_chunks(chunk_n):
    text = HEAD + rows("noload", 0, 9, 1) + "noise\n\n1,2\n" + rows("contact", 4, 9, 3, 0.5)
    whole, parts = dwells_of(text), dwells_of(text, chunk_n)
    assert repr(whole[0]) == repr(parts[0])  # Results are compared as text, because NaN is not equal to itself.
    assert whole[1].bad_n == parts[1].bad_n == 2
    assert parts[1].first_bad == "noise"


@pytest.mark.parametrize("number", ["1_0", "\u0663", "nan", "inf", "0x1", ""])
def test_lines_with_other_numbers_than_decimal_ones_are_counted(number):
    _, table = dwells_of(f"t_s,phase,pass_i\n{number},contact,0\n1,contact,{number}\n")
    assert table.bad_n == 2


def test_table_without_phases_is_divided_by_a_threshold_of_the_force():
    forces_N = [0, 0.01] * 3 + [0.03] + [0.4] * 3
    text = "t_s,Fz_N\n" + "".join(f"{0.1 * i},{force_N}\n" for i, force_N in enumerate(forces_N))
    (rest, touch), table = dwells_of(text)
    assert table.clock == "t_s"
    assert (rest.label.contact, touch.label.contact) == (False, True)
    assert math.isnan(touch.label.x_mm)


@pytest.mark.parametrize("head", ["x_mm,y_mm,Fz_N", "t_s,unix_s,Fz_N", "t_s,x_mm,y_mm", "t_s,t_s,Fz_N", ""])
def test_invalid_columns_are_refused(head):
    with pytest.raises(CaptureError, match="row 1 must name exactly one of the columns unix_s and t_s"):
        SampleTable("log").feed(head.encode() + b"\n")


def test_lines_of_a_gauge_contain_one_or_three_numbers():
    gauge = GaugeLines("gauge")
    found = gauge.feed(b"0.50\r\n0.1 -0.2; 0.7\n1,2\nERR\n0.", 3.0) + gauge.feed(b"9\n", 4.0)
    assert [(one.t_s, one.label.Fz_N) for one in found] == [(3.0, 0.5), (3.0, 0.7), (4.0, 0.9)]
    assert (found[1].label.Fx_N, found[1].label.Fy_N) == (0.1, -0.2)
    assert (gauge.bad_n, gauge.first_bad) == (2, "1,2")


def test_line_that_never_ends_is_counted_without_growing_memory():
    gauge = GaugeLines("gauge")
    tracemalloc.start()
    for _ in range(1000):
        assert gauge.feed(b"x" * 100, 0.0) == []
    assert tracemalloc.get_traced_memory()[1] < 50_000
    tracemalloc.stop()
    assert gauge.bad_n == 1000 * 100 // 4100


def test_too_short_touches_are_counted():
    table, dwells = SampleTable("robot.csv"), DwellBuilder()
    changes = "t_s,phase,x_mm,y_mm\n0,noload,4,8\n1,contact,4,8\n2,noload,4,8\n3,contact,5,8\n4,noload,5,8\n"
    list(dwells.feed(table.feed(changes.encode())))
    assert dwells.short_n == 2
    assert dwells.summary().startswith("2 touches left out: at least 0.05 s must lie between")
    # The touch lasts 0.52 s. This is one dwell, and a rest of 0.01 s that is too short for another dwell.
    long = "".join(f"{5 + 0.01 * i:.2f},contact,4,8\n" for i in range(53))
    assert len(list(dwells.feed(table.feed((long + "6,noload,4,8\n").encode())))) == 1
    assert dwells.short_n == 2
    list(dwells.feed(table.feed(b"7,contact,4,8\n8,noload,4,8\n")))
    assert dwells.short_n == 3

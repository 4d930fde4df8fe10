"""Whatever a source says, the log is one that ingest takes, at any moment."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from reskin.errors import CaptureError
from reskin.recordings import probe
from reskin.recordings.header import PROBE_FILE
from reskin.recordings.labels import Dwell, Label, ProbeTape

NUMBER = st.floats(-1e6, 1e6, width=32) | st.just(math.nan)
LABEL = st.builds(Label, st.booleans(), *[NUMBER] * 6, st.integers(0, 9))
DWELL = st.builds(lambda label, start_s, lasts_s: Dwell(label, start_s, start_s + lasts_s), LABEL,
                  st.floats(0, 100), st.floats(0.001, 5))  # fmt: skip


def test_a_touch_is_written_with_the_rest_before_it_and_not_before(tmp_path):
    tape = ProbeTape(tmp_path)
    tape.write(Dwell(Label(True, 1.0, 2.0), 0.0, 1.0))  # no rest before it
    tape.write(Dwell(Label(False), 1.0, 2.0))
    assert len((tmp_path / PROBE_FILE).read_text().splitlines()) == 1
    tape.write(Dwell(Label(True, 4.0, 8.0, Fz_N=0.5, pass_i=1), 3.0, 4.0))
    tape.write(Dwell(Label(True, 4.0, 8.0, Fz_N=0.7, pass_i=1), 4.0, 5.0))  # the touch goes on
    tape.write(Dwell(Label(False), 4.5, 5.5))  # before the touch has ended
    log = probe.parse(tmp_path / PROBE_FILE, "log")
    assert log.indentation.tolist() == [0, 0, 0]
    assert log.contact.tolist() == [False, True, True]
    assert log.pass_i.tolist() == [1, 1, 1]
    assert log.Fz_N[1:] == pytest.approx([0.5, 0.7])
    assert math.isnan(log.x_mm[0])
    assert (tape.touches_n, tape.without_noload_n, tape.out_of_order_n) == (1, 1, 1)
    tape.close()
    tape.write(Dwell(Label(True, 1.0, 1.0), 8.0, 9.0))  # of a program that was not waited for


def test_a_touch_that_goes_on_elsewhere_without_a_lift_is_left_out(tmp_path):
    tape = ProbeTape(tmp_path)
    places = [(4.0, 8.0), (4.001, 8.0), (5.0, 8.0), (4.0, 9.0), (math.nan, 8.0), (4.0, 8.0)]
    tape.write(Dwell(Label(False), 0.0, 1.0))
    for i, (x_mm, y_mm) in enumerate(places):
        tape.write(Dwell(Label(True, x_mm, y_mm), i + 1.0, i + 2.0))
    tape.close()
    log = probe.parse(tmp_path / PROBE_FILE, "log")
    assert log.t_start_s.tolist() == [0.0, 1.0, 2.0, 6.0]
    assert (tape.touches_n, tape.without_noload_n) == (1, 3)


@settings(max_examples=60)
@given(st.lists(DWELL, max_size=12))
def test_any_labels_make_a_log_that_can_be_read(tmp_path_factory, dwells):
    folder = tmp_path_factory.mktemp("labels")
    tape = ProbeTape(folder)
    for dwell in dwells:
        tape.write(dwell)
    tape.close()
    if tape.touches_n:
        log = probe.parse(folder / PROBE_FILE, "log")
        assert len(set(log.indentation)) == tape.touches_n == (~log.contact).sum()


@pytest.mark.parametrize(
    ("label", "end_s"),
    [(Label(True, math.inf), 1.0), (Label(True, 1e39), 1.0), (Label(True, pass_i=-1), 1.0), (Label(True), 0.0),
     (Label(True), math.nan), (Label(True), 1e15)],
)  # fmt: skip
def test_what_is_no_number_or_no_time_is_refused(tmp_path, label, end_s):
    tape = ProbeTape(tmp_path)
    with pytest.raises(CaptureError, match="a label: .* must be"):
        tape.write(Dwell(label, 0.0, end_s))
    tape.close()

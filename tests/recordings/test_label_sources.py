"""Tests that each source of labels writes a probe log.

Sources are a program, prompts in the terminal, a force gauge, and the growing table of a robot.
"""

import re
import threading
import time
from dataclasses import replace
from itertools import count, repeat

import numpy as np
import pytest

from reskin.errors import CaptureError, ParamsError
from reskin.recordings import probe
from reskin.recordings.header import PROBE_FILE
from reskin.recordings.labels import (
    ForceGauge,
    Label,
    LabelContext,
    LabelSource,
    LabelThread,
    ProbeLogWriter,
    Prompts,
    from_gauge,
    from_program,
    from_table,
    parse_places,
)
from reskin.seeds import rng_for

DWELL_s = 0.002
LONG_S = 120.0  # A time limit in s, which a passing test never reaches.


@pytest.fixture
def context(tmp_path):
    marks = []
    context = LabelContext(ProbeLogWriter(tmp_path), time.time, threading.Event(), lambda *mark: marks.append(mark))
    context.marks = marks
    yield context
    context.writer.close()


def log_of(folder):
    return probe.parse(folder / PROBE_FILE, "log")


def prompts(lines, *, scan="random", forces=None, text="grid:3x2:4", dwell_s=DWELL_s):
    printed = []
    prompter = Prompts(
        parse_places(text), dwell_s, printed.append, lambda: iter(lines), forces, rng_for(0, "keys"), scan
    )
    return prompter, printed


def test_program_that_moves_a_robot_yields_labels(context, tmp_path):
    def pokes():
        for x_mm in (4.0, 12.0):
            yield Label(False)
            yield Label(True, x_mm, 8.0, Fz_N=0.5)

    assert from_program(pokes(), DWELL_s).run(context) == ""
    assert context.writer.touches_n == 2
    log = log_of(tmp_path)
    assert log.x_mm[log.contact].tolist() == [4.0, 12.0]
    assert (log.t_end_s - log.t_start_s >= DWELL_s - 1e-5).all()


def test_function_that_returns_labels_is_called_until_it_returns_none(context, tmp_path):
    labels = [None, Label(True, 1.0, 1.0), Label(False)]
    from_program(labels.pop, DWELL_s).run(context)
    assert len(log_of(tmp_path)) == 2


def test_labelling_ends_if_the_robot_fails_or_a_label_is_invalid(context):
    def pokes():
        yield Label(False)
        raise RuntimeError("the robot is in its limits")

    label_thread = LabelThread(from_program(pokes(), DWELL_s), context)
    label_thread._thread.join()
    assert label_thread.end() == "0 touches labelled; labels ended: the robot is in its limits"
    assert isinstance(label_thread.failed, RuntimeError)
    with pytest.raises(ParamsError, match=r"must be reskin.lifted\(\) or reskin.touch\(...\); got 'lifted'"):
        from_program(["lifted"], DWELL_s).run(LabelContext(context.writer, time.time, threading.Event(), context.mark))


def test_recording_does_not_wait_for_a_hanging_program(context):
    hung = threading.Event()
    label_thread = LabelThread(LabelSource("hangs", None, lambda _: str(hung.wait(30))), context)
    assert label_thread.end(0.05) == "0 touches labelled"
    hung.set()


def test_prompts_name_the_places_in_another_order_in_each_pass(context, tmp_path):
    prompter, printed = prompts([""] * 24 + ["q"])
    prompter.run(context)
    log = log_of(tmp_path)
    places = [tuple(xy) for xy in np.stack([log.x_mm, log.y_mm], axis=1)[log.contact].tolist()]
    assert set(places[:6]) == set(places[6:]) == {(x, y) for x in (0.0, 4.0, 8.0) for y in (0.0, 4.0)}
    assert places[:6] != places[6:]
    assert log.pass_i[log.contact].tolist() == [0] * 6 + [1] * 6
    shown = [line for line in printed if "press place" in line]
    assert all(f"x {x:g}, y {y:g} mm" in line for line, (x, y) in zip(shown, places, strict=True))
    assert "the next place is place" in shown[0]


def test_answer_to_a_prompt_may_be_an_index_a_force_or_skip(context, tmp_path):
    lines = ["", "4", "", "0.8N", "", "2 1.5 n", "", "99", "what", "s", "", "q"]
    prompter, printed = prompts(lines, scan="snake", text="line:5:2@1,8")
    prompter.run(context)
    log = log_of(tmp_path)
    assert log.x_mm[log.contact].tolist() == [9.0, 3.0, 5.0]
    assert log.Fz_N[log.contact][1:] == pytest.approx([0.8, 1.5])
    assert np.isnan(log.Fz_N[log.contact][0])
    assert len([line for line in printed if "is neither a place" in line]) == 2


@pytest.mark.parametrize(
    ("line", "x_mm", "force_N"),
    [("12N", 0, 12), ("10N", 0, 10), ("10.5N", 0, 10.5), ("3 2.5N", 3, 2.5), ("3", 3, np.nan), ("12", 12, np.nan)],
)
def test_answer_with_a_number_and_unit_is_read_as_a_force_and_not_as_a_place(context, tmp_path, line, x_mm, force_N):
    prompter, printed = prompts(
        ["", "3.5", "1 2", "12N3", "1.2.3N", "3 N N", line, "", "q"], scan="snake", text="line:13:1"
    )
    prompter.run(context)
    log = log_of(tmp_path)
    np.testing.assert_equal((log.x_mm[1], log.Fz_N[1]), (x_mm, force_N))
    assert len([line for line in printed if "is neither a place" in line]) == 5


def test_prompts_in_snake_order_reverse_every_second_row():
    assert parse_places("grid:3x2:4").order("snake", rng_for(0, "x")) == [0, 1, 2, 5, 4, 3]
    assert parse_places("robot.csv") is None
    for wrong in ("grid:0x2:4", "line:5:0", "grid:9999x9999:1"):
        with pytest.raises(ParamsError, match="places must be 1 to"):
            parse_places(wrong)


def wait_until(condition):
    end_s = time.monotonic() + LONG_S
    while not condition():
        assert time.monotonic() < end_s
        time.sleep(0.002)


class FakeGauge:
    """The serial port of a force gauge, which sends these chunks of bytes and is then unplugged."""

    def __init__(self, chunks):
        self.chunks, self.sent_n, self.gone = iter(chunks), 0, False

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def read(self, *_):
        time.sleep(0.002)
        for chunk in self.chunks:
            self.sent_n += 1
            return chunk
        self.gone = True
        raise OSError("gone")


@pytest.fixture
def fake_gauge(monkeypatch):
    def connect(chunks):
        gauge = FakeGauge(chunks)
        monkeypatch.setattr("reskin.recordings.labels.open_port", lambda *_: gauge)
        monkeypatch.setattr("reskin.recordings.labels.read_waiting", FakeGauge.read)
        return gauge

    return connect


class GaugeContext(LabelContext):
    """The context of a label. Instead of a fixed time, a label lasts until the gauge has sent data or is unplugged."""

    gauge: FakeGauge

    def hold(self, label, dwell_s):
        held, before_n = super().hold(label, dwell_s), self.gauge.sent_n
        wait_until(lambda: self.gauge.gone or self.gauge.sent_n > before_n + 2)
        return held._replace(t_end_s=self.unix_s())


def with_gauge(context, gauge):
    gauge_context = GaugeContext(context.writer, context.unix_s, context.stop, context.mark)
    gauge_context.gauge = gauge
    return gauge_context


def test_force_of_a_touch_is_the_mean_of_the_gauges_readings(context, tmp_path, fake_gauge):
    gauge = fake_gauge(repeat(b"0.4\n0.6\n"))
    prompter, _ = prompts(["", "", "q"], forces=ForceGauge("gauge", 9600))
    assert prompter.run(with_gauge(context, gauge)) == ""
    log = log_of(tmp_path)
    assert log.Fz_N[log.contact] == pytest.approx(0.5)


def test_touches_during_which_the_gauge_sends_nothing_are_counted(context, fake_gauge):
    fake_gauge(repeat(b""))
    prompter, _ = prompts(["", "", "", "0.8N", "", "", "q"], forces=ForceGauge("gauge", 9600))
    assert prompter.run(context) == "2 touches during which the gauge at gauge sent no force"


def test_labels_continue_after_the_gauge_is_unplugged(context, fake_gauge):
    gauge = fake_gauge([b"0.5\n"])
    prompter, _ = prompts(["", "", "", "0.8N", "q"], forces=ForceGauge("gauge", 9600))
    assert "gauge: lost the connection to the force gauge" in (message := prompter.run(with_gauge(context, gauge)))
    assert "All later forces are missing" in message
    assert context.writer.touches_n == 2


def test_touches_are_detected_by_the_force_if_a_gauge_is_the_only_label_source(context, tmp_path, fake_gauge):
    fake_gauge([b"0.00\n"] * 40 + [b"0.50\n"] * 40 + [b"oops\n"])
    # The clock is simulated. With a real clock, a busy machine would split a touch of 0.5 s into several touches.
    ticks = count()
    context = replace(context, unix_s=lambda: 1e9 + 0.002 * next(ticks))
    label_thread = LabelThread(from_gauge("gauge", 9600), context)
    label_thread._thread.join()
    unplugged = "labels ended: gauge: lost the connection to the force gauge: gone. The forces"
    assert unplugged in label_thread.end()
    assert isinstance(label_thread.failed, CaptureError)
    log = log_of(tmp_path)
    assert log.contact.tolist() == [False, True]
    assert log.Fz_N[1] == pytest.approx(0.5)
    assert np.isnan(log.x_mm[1])


class PollCounter(threading.Event):
    """A stop event that counts how often a program waits for it.

    The reader of a growing table waits for this event each time it looks for new rows (polls).
    """

    def __init__(self):
        super().__init__()
        self.polls_n = 0

    def wait(self, timeout=None):
        self.polls_n += 1
        return super().wait(timeout)


@pytest.mark.parametrize("exists", [False, True])
def test_rows_that_are_appended_to_a_table_are_read(context, tmp_path, exists):
    file, old = tmp_path / "robot.csv", "t_s,phase,x_mm,y_mm\n"
    rows = "".join(f"{7 + 0.1 * i:.1f},{phase},4,8\n" for i, phase in enumerate(["noload"] * 3 + ["contact"] * 3))
    if exists:
        file.write_text(old + rows.replace("\n7.", "\n1."))
    poll_counter = PollCounter()
    label_thread = LabelThread(from_table(file), replace(context, stop=poll_counter))
    wait_until(lambda: poll_counter.polls_n)
    with file.open("a") as stream:
        stream.write(rows if exists else old + rows)
    before_n = poll_counter.polls_n
    # Two polls are awaited, because the first one may have begun before the rows were appended.
    wait_until(lambda: poll_counter.polls_n > before_n + 1)
    assert label_thread.end(LONG_S) == "1 touches labelled"
    log = log_of(tmp_path)
    assert log.t_start_s.tolist() == pytest.approx([7.0, 7.3])
    assert context.marks[-1][1] == pytest.approx(7.5)
    assert context.marks[-1][0] == pytest.approx(time.time(), abs=LONG_S)


@pytest.mark.parametrize(
    ("interruption", "problem"),
    [("replaced", "replaced"), ("cut", r"shortened to \d+ bytes, but \d+ bytes had"), ("removed", "removed")],
)
def test_labelling_ends_if_the_growing_table_is_replaced_or_cut(context, tmp_path, interruption, problem):
    file, header = tmp_path / "robot.csv", "t_s,phase\n"
    file.write_text(header)
    label_thread = LabelThread(from_table(file), context)
    for begin_s in range(int(LONG_S / 0.02)):
        with file.open("a") as stream:
            stream.write("".join(f"{begin_s}.{i},{'contact' if i > 4 else 'noload'}\n" for i in range(9)))
        time.sleep(0.02)
        if context.marks:  # There is a mark as soon as the source has skipped the rows that existed before.
            break
    if interruption == "replaced":
        (tmp_path / "new.csv").write_text(header)
        (tmp_path / "new.csv").replace(file)
    elif interruption == "cut":
        file.write_text(header)
    else:
        file.unlink()
    label_thread._thread.join(LONG_S)
    message = label_thread.end()
    assert re.search(f"the file was {problem}", message)
    assert not message.startswith("0 touches")

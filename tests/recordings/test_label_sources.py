"""Each source of labels writes a log that ingest takes, without a board, a robot or a person."""

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
from reskin.recordings.label_sources import (
    ForceGauge,
    LabelContext,
    LabelSource,
    LabelThread,
    Prompts,
    from_gauge,
    from_program,
    from_table,
    parse_places,
)
from reskin.recordings.labels import Label, ProbeLogWriter
from reskin.seeds import rng_for

DWELL_s = 0.002
LONG_S = 120.0  # for what must not happen in a test that passes


@pytest.fixture
def context(tmp_path):
    marks = []
    context = LabelContext(ProbeLogWriter(tmp_path), time.time, threading.Event(), lambda *mark: marks.append(mark))
    context.marks = marks
    yield context
    context.writer.close()


def log_of(folder):
    return probe.parse(folder / PROBE_FILE, "log")


def prompts(words, *, scan="random", forces=None, text="grid:3x2:4", dwell_s=DWELL_s):
    said = []
    asked = Prompts(parse_places(text), dwell_s, said.append, lambda: iter(words), forces, rng_for(0, "keys"), scan)
    return asked, said


def test_a_robots_program_moves_and_says_where_it_stands(context, tmp_path):
    def pokes():
        for x_mm in (4.0, 12.0):
            yield Label(False)
            yield Label(True, x_mm, 8.0, Fz_N=0.5)

    assert from_program(pokes(), DWELL_s).run(context) == ""
    assert context.writer.touches_n == 2
    log = log_of(tmp_path)
    assert log.x_mm[log.contact].tolist() == [4.0, 12.0]
    assert (log.t_end_s - log.t_start_s >= DWELL_s - 1e-5).all()


def test_a_function_is_called_each_time_until_it_gives_none(context, tmp_path):
    labels = [None, Label(True, 1.0, 1.0), Label(False)]
    from_program(labels.pop, DWELL_s).run(context)
    assert len(log_of(tmp_path)) == 2


def test_what_is_no_label_and_a_robot_that_fails_end_the_labels_and_are_told(context):
    def pokes():
        yield Label(False)
        raise RuntimeError("the robot is in its limits")

    label_thread = LabelThread(from_program(pokes(), DWELL_s), context)
    label_thread._thread.join()
    assert label_thread.end() == "0 touches labelled; labels ended: the robot is in its limits"
    assert isinstance(label_thread.failed, RuntimeError)
    with pytest.raises(ParamsError, match=r"must be reskin.lifted\(\) or reskin.touch\(...\); got 'lifted'"):
        from_program(["lifted"], DWELL_s).run(LabelContext(context.writer, time.time, threading.Event(), context.mark))


def test_a_program_that_hangs_is_not_waited_for(context):
    hung = threading.Event()
    label_thread = LabelThread(LabelSource("hangs", None, lambda _: str(hung.wait(30))), context)
    assert label_thread.end(0.05) == "0 touches labelled"
    hung.set()


def test_a_person_presses_the_places_shown_in_an_order_drawn_anew_each_pass(context, tmp_path):
    asked, said = prompts([""] * 24 + ["q"])
    asked.run(context)
    log = log_of(tmp_path)
    places = [tuple(xy) for xy in np.stack([log.x_mm, log.y_mm], axis=1)[log.contact].tolist()]
    assert set(places[:6]) == set(places[6:]) == {(x, y) for x in (0.0, 4.0, 8.0) for y in (0.0, 4.0)}
    assert places[:6] != places[6:]
    assert log.pass_i[log.contact].tolist() == [0] * 6 + [1] * 6
    shown = [line for line in said if "press place" in line]
    assert all(f"x {x:g}, y {y:g} mm" in line for line, (x, y) in zip(shown, places, strict=True))
    assert "then place" in shown[0]


def test_another_index_a_force_and_a_slip_of_the_finger_are_understood(context, tmp_path):
    words = ["", "4", "", "0.8N", "", "2 1.5 n", "", "99", "what", "s", "", "q"]
    asked, said = prompts(words, scan="snake", text="line:5:2@1,8")
    asked.run(context)
    log = log_of(tmp_path)
    assert log.x_mm[log.contact].tolist() == [9.0, 3.0, 5.0]
    assert log.Fz_N[log.contact][1:] == pytest.approx([0.8, 1.5])
    assert np.isnan(log.Fz_N[log.contact][0])
    assert len([line for line in said if "is no place" in line]) == 2


@pytest.mark.parametrize(
    ("words", "x_mm", "force_N"),
    [("12N", 0, 12), ("10N", 0, 10), ("10.5N", 0, 10.5), ("3 2.5N", 3, 2.5), ("3", 3, np.nan), ("12", 12, np.nan)],
)
def test_a_force_is_never_cut_into_a_place_and_a_smaller_one(context, tmp_path, words, x_mm, force_N):
    asked, said = prompts(["", "3.5", "1 2", "12N3", "1.2.3N", "3 N N", words, "", "q"], scan="snake", text="line:13:1")
    asked.run(context)
    log = log_of(tmp_path)
    np.testing.assert_equal((log.x_mm[1], log.Fz_N[1]), (x_mm, force_N))
    assert len([line for line in said if "is no place" in line]) == 5


def test_a_snake_goes_there_and_back_and_places_that_are_none_are_refused():
    assert parse_places("grid:3x2:4").order("snake", rng_for(0, "x")) == [0, 1, 2, 5, 4, 3]
    assert parse_places("robot.csv") is None
    for wrong in ("grid:0x2:4", "line:5:0", "grid:9999x9999:1"):
        with pytest.raises(ParamsError, match="places must be 1 to"):
            parse_places(wrong)


def wait_until(is_so):
    end_s = time.monotonic() + LONG_S
    while not is_so():
        assert time.monotonic() < end_s
        time.sleep(0.002)


class Telling:
    """A gauge's port that says what it is told to; then it is unplugged."""

    def __init__(self, chunks):
        self.chunks, self.told_n, self.gone = iter(chunks), 0, False

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def read(self, *_):
        time.sleep(0.002)
        for chunk in self.chunks:
            self.told_n += 1
            return chunk
        self.gone = True
        raise OSError("gone")


@pytest.fixture
def telling(monkeypatch):
    def tell(chunks):
        gauge = Telling(chunks)
        monkeypatch.setattr("reskin.recordings.label_sources.open_port", lambda *_: gauge)
        monkeypatch.setattr("reskin.recordings.label_sources.read_waiting", Telling.read)
        return gauge

    return tell


class Heard(LabelContext):
    """A context where a label holds until the gauge has said something, or is gone, however late the machine is."""

    gauge: Telling

    def hold(self, label, dwell_s):
        held, before_n = super().hold(label, dwell_s), self.gauge.told_n
        wait_until(lambda: self.gauge.gone or self.gauge.told_n > before_n + 2)
        return held._replace(t_end_s=self.unix_s())


def heard(context, gauge):
    beside = Heard(context.writer, context.unix_s, context.stop, context.mark)
    beside.gauge = gauge
    return beside


def test_a_gauge_beside_the_keys_gives_each_touch_its_mean_force(context, tmp_path, telling):
    gauge = telling(repeat(b"0.4\n0.6\n"))
    asked, _ = prompts(["", "", "q"], forces=ForceGauge("gauge", 9600))
    assert asked.run(heard(context, gauge)) == ""
    log = log_of(tmp_path)
    assert log.Fz_N[log.contact] == pytest.approx(0.5)


def test_touches_of_which_the_gauge_said_nothing_are_counted(context, telling):
    telling(repeat(b""))
    asked, _ = prompts(["", "", "", "0.8N", "", "", "q"], forces=ForceGauge("gauge", 9600))
    assert asked.run(context) == "2 touches without a force: the gauge at gauge sent none while they lasted"


def test_a_gauge_that_is_unplugged_beside_the_keys_is_told_and_touches_go_on(context, telling):
    gauge = telling([b"0.5\n"])
    asked, _ = prompts(["", "", "", "0.8N", "q"], forces=ForceGauge("gauge", 9600))
    assert "gauge: the force gauge must be plugged in" in (told := asked.run(heard(context, gauge)))
    assert "Forces are missing from then on" in told
    assert context.writer.touches_n == 2


def test_a_gauge_alone_tells_touches_by_force_and_that_it_was_unplugged(context, tmp_path, telling):
    telling([b"0.00\n"] * 40 + [b"0.50\n"] * 40 + [b"oops\n"])
    ticks = count()  # a clock of its own: where the machine stalls, a touch of 0.5 s becomes several
    context = replace(context, unix_s=lambda: 1e9 + 0.002 * next(ticks))
    label_thread = LabelThread(from_gauge("gauge", 9600), context)
    label_thread._thread.join()
    unplugged = "labels ended: gauge: the force gauge must be plugged in until the recording ends; got gone. What came"
    assert unplugged in label_thread.end()
    assert isinstance(label_thread.failed, CaptureError)
    log = log_of(tmp_path)
    assert log.contact.tolist() == [False, True]
    assert log.Fz_N[1] == pytest.approx(0.5)
    assert np.isnan(log.x_mm[1])


class Looks(threading.Event):
    """Counts how often somebody who follows a table has looked at it: each time it waits for this."""

    def __init__(self):
        super().__init__()
        self.looks_n = 0

    def wait(self, timeout=None):
        self.looks_n += 1
        return super().wait(timeout)


@pytest.mark.parametrize("there", [False, True])
def test_a_table_is_followed_as_it_grows_and_its_own_clock_is_marked(context, tmp_path, there):
    file, old = tmp_path / "robot.csv", "t_s,phase,x_mm,y_mm\n"
    rows = "".join(f"{7 + 0.1 * i:.1f},{phase},4,8\n" for i, phase in enumerate(["noload"] * 3 + ["contact"] * 3))
    if there:
        file.write_text(old + rows.replace("\n7.", "\n1."))
    looks = Looks()
    label_thread = LabelThread(from_table(file), replace(context, stop=looks))
    wait_until(lambda: looks.looks_n)
    with file.open("a") as stream:
        stream.write(rows if there else old + rows)
    before_n = looks.looks_n
    wait_until(lambda: looks.looks_n > before_n + 1)  # the first may have been begun before
    assert label_thread.end(LONG_S) == "1 touches labelled"
    log = log_of(tmp_path)
    assert log.t_start_s.tolist() == pytest.approx([7.0, 7.3])
    assert context.marks[-1][1] == pytest.approx(7.5)
    assert context.marks[-1][0] == pytest.approx(time.time(), abs=LONG_S)


@pytest.mark.parametrize(
    ("how", "said"),
    [("replaced", "another file in its place"), ("cut", r"10 bytes, of which \d+ were read"), ("removed", "no file")],
)
def test_a_table_that_does_not_go_on_ends_the_labels_with_a_sentence(context, tmp_path, how, said):
    file, header = tmp_path / "robot.csv", "t_s,phase\n"
    file.write_text(header)
    label_thread = LabelThread(from_table(file), context)
    for begin_s in range(int(LONG_S / 0.02)):
        with file.open("a") as stream:
            stream.write("".join(f"{begin_s}.{i},{'contact' if i > 4 else 'noload'}\n" for i in range(9)))
        time.sleep(0.02)
        if context.marks:  # what was there before is passed over
            break
    if how == "replaced":
        (tmp_path / "new.csv").write_text(header)
        (tmp_path / "new.csv").replace(file)
    elif how == "cut":
        file.write_text(header)
    else:
        file.unlink()
    label_thread._thread.join(LONG_S)
    told = label_thread.end()
    assert re.search(f"a table that is followed must be the same file, with rows appended; got {said}", told)
    assert not told.startswith("0 touches")

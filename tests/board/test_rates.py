"""Tests of measured frame rates, computed limits of the rate, and the sentence that explains a rate by a limit."""

import re
from dataclasses import astuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from reskin import cli
from reskin.board import find
from reskin.board.port import BAUD
from reskin.board.rates import RateMeasurement, RateMeter, RepeatCounter, explain, find_limits, measure
from reskin.board.stream import decode_all
from reskin.seeds import rng_for
from tests.live.boards import make_script
from tests.live.faults import inject


def recognise_at_due_times(script):
    """Return the board that is recognised from a script. All frames arrive at the times at which they are due."""
    return find.recognise("port", [(piece, t_s) for piece, t_s in zip(script.pieces, script.t_s, strict=True) if piece])


def with_fault(name, *, wire="binary"):
    return inject(make_script(pokes_n=0, wire=wire), f"{name}@0+99")


def at_rate(rate_hz):
    return make_script(pokes_n=0, rate_hz=float(rate_hz), quiet_s=5.0)


def measured(**changed):
    values = {"frames_n": 1000, "arrived_hz": 400.0, "sent_hz": 400.0, "method": "arrivals"}
    values |= {"repeated_frames": 0.0, "repeated_readings": 0.0}
    return RateMeasurement(**(values | changed))


@pytest.mark.parametrize("wire", ["binary", "binary-clock", "text-txyz"])
@pytest.mark.parametrize("rate_hz", [15.0, 83.0, 400.0])
def test_frame_rate_of_the_emulator_is_measured(wire, rate_hz):
    script = make_script(pokes_n=0, wire=wire, rate_hz=rate_hz, quiet_s=5.0)
    board = recognise_at_due_times(script)
    rate = board.rate
    assert rate.arrived_hz == pytest.approx(rate_hz, rel=1e-6)
    # The board sends the time of its clock in single precision.
    assert rate.sent_hz == pytest.approx(rate_hz, rel=1e-3)
    assert rate.method == ("clock" if wire == "binary-clock" else "arrivals")
    assert board.frame_bytes_n == np.mean([len(piece) for piece in script.pieces])
    assert (rate.repeated_frames, rate.repeated_readings) == (0, 0)


@given(st.lists(st.integers(1, 300), min_size=1, max_size=8))
def test_measured_rate_does_not_depend_on_the_size_of_portions(lengths):
    script = with_fault("slow-chips", wire="binary-clock")
    frames, _ = decode_all(b"".join(script.pieces), "binary-clock", 5, "script")
    meter, portion = RateMeter(5, 0.0), np.searchsorted(np.cumsum(lengths), np.arange(len(frames)), "right")
    for i in range(len(lengths) + 1):
        meter.feed(frames.where(portion == i), script.t_s[portion == i])
    parts, whole = meter.measure(), measure(frames, list(zip(script.pieces, script.t_s.tolist(), strict=True)))
    assert astuple(parts)[1:3] == pytest.approx(astuple(whole)[1:3], rel=1e-4)
    assert (parts.frames_n, *astuple(parts)[3:]) == (whole.frames_n, *astuple(whole)[3:])


def test_measured_rate_is_not_changed_by_silence_or_by_bytes_that_arrive_together():
    script = make_script(pokes_n=0)
    chunks = list(zip(script.pieces, script.t_s.tolist(), strict=True))
    waiting = [(b"".join(script.pieces[:200]), 0.0), *((piece, t_s - 0.4975) for piece, t_s in chunks[200:])]
    silent = [*chunks[:300], *((piece, t_s + 60) for piece, t_s in chunks[300:])]
    assert find.recognise("port", waiting).rate.arrived_hz == pytest.approx(400, rel=1e-6)
    assert find.recognise("port", silent).rate.arrived_hz == pytest.approx(400, rel=1e-2)


@pytest.mark.parametrize(("every_n", "stuck", "frames"), [(1, False, 0.0), (2, False, 0.0), (5, False, 0.0),
                                                         (5, True, 0.2), (10, False, 0.5)])  # fmt: skip
def test_repeated_readings_are_counted_per_chip(every_n, stuck, frames):
    """Each chip converts once in n frames. A single chip that is stuck must not affect the median over chips."""
    frame_i, chip_i = np.indices((1000, 5))
    values = rng_for(every_n, "values").normal(size=(1000, 5, 3))
    b_uT = values[frame_i - (frame_i - chip_i) % every_n, chip_i]
    if stuck:
        b_uT[:, 2] = 7.0
    counter = RepeatCounter(5)
    for part in np.array_split(b_uT.reshape(1000, 15), 7):
        counter.feed(part)
    assert counter.readings == pytest.approx(1 - 1 / every_n, abs=0.002)
    assert counter.frames == pytest.approx(frames, abs=0.002)


def test_rate_limits_of_the_papers_board_equal_those_computed_from_a_count_of_bits():
    """The bits on the I2C bus are counted independently: 9 per byte, plus start, repeated start and stop."""
    read = ["address", "RM", "address", "status", *"TTXXYYZZ"]
    start = ["address", "SM", "address", "status"]
    read_s, start_s = ((9 * len(part) + 3) / 400e3 for part in (read, start))
    expected = {
        "82 bytes a frame at 115200 baud": 115200 / 820,
        "5 chips with 111 bits of I2C at 400 kHz each": 1 / (5 * read_s),
        "5 chips read one after the other, 1.84 ms and 150 bits of I2C at 400 kHz each,": 1
        / (5 * (1.84e-3 + start_s + read_s)),
        "5 chips started together and then read, 1.84 ms and 5 x 150 bits of I2C at 400 kHz,": 1
        / (1.84e-3 + 5 * (start_s + read_s)),
        "5 chips read one after the other by Adafruit's library, 11.8 ms and 150 bits of I2C at 400 kHz each,": 1
        / (5 * (11.84e-3 + start_s + read_s)),
        "chips that convert on their own, 1.84 ms a reading,": 1 / 1.84e-3,
        "82 bytes a frame over full-speed USB": 1_216_000 / 82,
    }
    limits = find_limits(5, 82, baud=115200)
    found = {limit.cause: limit.hz for limit in limits}
    assert {cause: found[cause] for cause in expected} == pytest.approx(expected)
    assert [limit.hz for limit in limits] == sorted(limit.hz for limit in limits)


@given(st.integers(1, 64), st.floats(18, 2000), st.floats(1e-4, 0.3))
def test_rate_limits_are_lower_for_more_chips_longer_frames_or_slower_conversion(
    chips_n, frame_bytes_n, conversion_time_s
):
    def rates(*arguments):
        limits = find_limits(arguments[0], arguments[1], baud=115200, conversion_time_s=arguments[2])
        return np.array([limit.hz for limit in limits if "together" not in limit.cause])

    before = rates(chips_n, frame_bytes_n, conversion_time_s)
    for slower in ((chips_n + 1, frame_bytes_n, conversion_time_s), (chips_n, 2 * frame_bytes_n, conversion_time_s),
                   (chips_n, frame_bytes_n, 2 * conversion_time_s)):  # fmt: skip
        after = rates(*slower)
        assert (after <= before).all()
        assert (after < before).any()


@pytest.mark.parametrize(
    ("script", "sentence"),
    [
        (at_rate(83), "^83.0 Hz arrive; 5 chips read one after the other, 1.84 ms and 150 bits of I2C at 400 kHz "
         r"each, allow 90\.3 Hz, which would explain it$"),
        (at_rate(16), "^16.0 Hz arrive; 5 chips read one after the other by Adafruit's library, .* would explain it$"),
        (at_rate(140), "^140 Hz arrive; 82 bytes a frame at 115200 baud allow 140 Hz, which would explain it$"),
        (at_rate(400), "^400 Hz arrive; no computed limit is near it, but a pause in the board's program"),
        (at_rate(3), "^15 frames are too few"),
        (with_fault("slow-chips"), "^400 Hz arrive, but 66 % of a chip's readings repeat the one before.*, at 134 Hz; "
         r"conversions of 7\.\d+ ms \(OSR 1 with DIG_FILT 4\) would explain it$"),
        (with_fault("repeated"), "^800 Hz arrive, but 50 % of a chip's readings repeat .*, at 400 Hz; "),
        (with_fault("repeated", wire="binary-clock"), "^800 Hz arrive of 400 Hz .*: the same frames arrive more than"),
        (with_fault("torn", wire="binary-clock"), "^321 Hz arrive of 400 Hz .*: 20 % of the frames are lost "),
    ],
)  # fmt: skip
def test_rate_of_an_emulated_board_is_explained_by_its_limit_or_fault(script, sentence):
    """In fault `torn`, each frame that is cut is lost together with the next frame, so two of ten frames are lost."""
    board = recognise_at_due_times(script)
    assert re.search(sentence, explain(board.rate, find_limits(board.chips_n, board.frame_bytes_n, baud=BAUD)))


def test_explanation_depends_on_the_settings_of_the_chips():
    slow = measured(arrived_hz=0.98, sent_hz=0.98)
    assert "no computed limit" in explain(slow, find_limits(5, 82, baud=115200))
    limits = find_limits(5, 82, baud=115200, conversion_time_s=0.2)
    assert "5 chips read one after the other, 200 ms and" in explain(slow, limits)
    frozen = measured(repeated_readings=0.999, repeated_frames=0.999)
    assert "all repeat the same reading" in explain(frozen, limits)


def test_command_prints_the_rate_its_explanation_and_the_limits(monkeypatch, capsys):
    listened_s = []

    def scan(names, *, listening_s):
        listened_s.append((names, listening_s))
        return [
            recognise_at_due_times(with_fault("slow-chips", wire="binary-clock")),
            find.DetectedBoard("/dev/x", "no bytes arrived"),
        ]

    monkeypatch.setattr(find, "scan_ports", scan)
    cli.find_ports(["/dev/y"], hunt=False, rate=True, seconds=3.0, osr=3, dig_filt=7)
    output = capsys.readouterr().out
    assert listened_s == [(["/dev/y"], 3.0)]
    assert "port: binary-clock, 5 chips, 600 frames of 86 bytes\n  sent     400.0 Hz, by the board's clock\n" in output
    assert "repeated 0.0% of frames; 66.5% of each chip's readings" in output
    assert "       5.0 Hz: chips that convert on their own, 200 ms a reading\n" in output
    assert output.endswith("/dev/x: no bytes arrived\n")

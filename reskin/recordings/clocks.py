"""The clocks of a capture: the times at which frames arrived, and the conversion of these times to the rig's clock.

Stream time is the time of a frame: a time of arrival, or a time computed from a constant frame rate. Probe time is the
time on the clock of the rig, which the probe log uses. A linear map converts stream time to probe time. It is fitted
either to sync marks (pairs of times at which both clocks recorded the same event), or to the contacts that are visible
in the field.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import pyarrow as pa
from jaxtyping import Float32, Float64, Int8, Int64

from reskin.errors import CaptureError
from reskin.recordings import tables
from reskin.recordings.probe import ProbeLog

TYPES = {"byte_end": pa.int64(), "t_s": pa.float64()}


@dataclass(frozen=True)
class Arrivals:
    """The times at which the chunks of a stream arrived.

    `byte_end` is the number of bytes from the start of the stream to the end of each chunk, and `t_s` is the chunk's
    time of arrival.
    """

    byte_end: Int64[np.ndarray, " c"]
    t_s: Float64[np.ndarray, " c"]

    def __len__(self) -> int:
        return len(self.byte_end)


def parse(source: str | Path, where: str) -> Arrivals:
    """Read times of arrival from CSV text (`source` is a str) or from a file (`source` is a path).

    Raises `CaptureError` if a row is wrong; the error names the first such row.
    """
    table = tables.parse_csv(source, TYPES, where)
    if len(table) < 2:
        raise CaptureError(
            f"{where}: the file has {len(table)} rows, but two or more times of arrival are needed. Record the capture "
            "again, or state a constant frame rate in header.json: set kind to rate and rate_hz to the rate in section "
            "clock."
        )
    byte_end, t_s = (table.column(name).to_numpy() for name in TYPES)
    for bad, name, rule in (
        (~np.isfinite(byte_end), "byte_end", "known"),  # Arrow gives NaN for an empty field
        (~np.isfinite(t_s), "t_s", "a finite time"),
        (byte_end < 0, "byte_end", "0 or more"),
        (np.diff(byte_end, prepend=-1) <= 0, "byte_end", "more than in the row above"),
        (np.diff(t_s, prepend=t_s[0]) < 0, "t_s", "no earlier than in the row above"),
    ):
        tables.refuse_row(bad, where, name, rule, {"byte_end": byte_end, "t_s": t_s}[name], "Record the capture again.")
    if t_s[-1] == t_s[0]:
        raise CaptureError(f"{where}: t_s is {t_s[0]} in every row. Check the clock of the recorder, and record again.")
    return Arrivals(byte_end, t_s)


def render(arrivals: Arrivals) -> str:
    """Return times of arrival as CSV text, from which `parse` returns the same times."""
    return tables.render_csv(pa.table({name: getattr(arrivals, name) for name in TYPES}))


def times_of(end_byte: Int64[np.ndarray, " f"], arrivals: Arrivals) -> Float64[np.ndarray, " f"]:
    """Return the time at which the last byte of each frame arrived.

    Only the times at which whole chunks were read are known, so the times are interpolated linearly between the ends of
    chunks. If the delay in the port's buffer is neglected, a byte arrived between two reads: that of the previous chunk
    and that of its own chunk. Therefore, the error is less than the time between these two reads. In the first chunk,
    times are extrapolated at the stream's mean rate of bytes. The time of a frame after the last chunk is NaN.
    """
    byte_end, t_s = arrivals.byte_end, arrivals.t_s
    s_per_byte = (t_s[-1] - t_s[0]) / (byte_end[-1] - byte_end[0])
    before_s = np.minimum(end_byte - byte_end[0], 0) * s_per_byte
    return np.interp(end_byte, byte_end, t_s, right=np.nan) + before_s


# The fitted rate of the clock (seconds of probe time per second of stream time) may differ from 1 by at most this
# value. Real differences are up to a few per cent, because the nominal frame rate may be inaccurate. A larger
# difference means that a mark is in milliseconds, or that the two times of a mark belong to different events.
RATE_LIMIT = 0.1

# To align the clocks without marks, the stream is divided into time steps. For each step, the field shows whether the
# skin was in contact; this is the contact signal. The probe log states when it should have been in contact. The offset
# is probe time minus stream time. `_search` finds the offset at which both agree best in the first SEARCH_STEPS_N
# steps. Then `_follow` finds one offset for each window of about WINDOW_STEPS_N steps, and `_line` fits a line to them.
# How well both agree is called the match. It is counted in indentations, and is 0 on average for a random offset.
STEPS_PER_DWELL_N = 16  # number of steps in the median contact dwell
STEPS_MAX_N = 2**27  # maximum number of steps of a stream: 128 MB, enough for 1e6 indentations of 8 dwells each
SEARCH_STEPS_N = 2**16  # 4,000 dwells, in which a rate error of 50 ppm accumulates to 0.2 dwells
WINDOW_STEPS_N = 2**14  # 1,000 dwells
EXPLAINED_MIN = 0.5  # smallest match that is accepted, as a fraction of its largest possible value
# The best offset must match this many more indentations than every other offset. If the rig repeats the same
# indentation periodically, an offset that is wrong by one period matches only one indentation less, and one more
# contact may be too weak to detect. Therefore, the number exceeds 1.
MARGIN_MIN = 1.5
# Offsets at which stream and dwells overlap less than this fraction of the largest overlap are ignored, because the few
# dwells in a small overlap can fit by chance.
OVERLAP_MIN = 0.5
# The peak of the match can have a flat top. The middle between the two offsets at which the match is 5 % below the top
# is therefore taken as its position.
PEAK_DROP = 0.05
# A frame is in contact if the distance of its field from the no-load field exceeds this multiple of the noise, which is
# the median distance of frames without contact. With 15 channels, this is 2.7 standard deviations above the median.
AWAY_NOISES = 1.5
# The no-load field is updated in each stretch of the stream, which lasts about as long as this many indentations.
STRETCH_PERIODS_N = 32
START_FRAMES_N = 4  # the no-load field at the start of the stream is the median field of this many frames
REFERENCE_FRAMES_N = 4096  # about this many frames of a stretch, at most, are used to estimate the no-load field
_REMEDY = "Add sync marks: reskin add ... --mark STREAM_S,PROBE_S, where both numbers are times of the same event."

# A block of frames: their stream times [f] and their fields in uT [f ch]. The annotations do not name the axes, because
# the number of frames f differs from block to block.
Block = tuple[Float64[np.ndarray, "_"], Float32[np.ndarray, "_ _"]]


@dataclass(frozen=True)
class ClockMap:
    """Linear map from stream time to probe time: probe_s = offset_s + rate * stream_s.

    The line was fitted to sync marks or, if there are none, to the offsets of windows of the stream. `residual_s` is
    the largest distance of a mark or window from this line. `explained` states how well the dwells of the probe log
    agree with the contacts in the field. It is 1 if all dwells agree, or if marks were given. For a random offset, it
    is 0 on average.
    """

    offset_s: float
    rate: float
    residual_s: float
    explained: float

    def probe_s(self, stream_s: Float64[np.ndarray, " f"]) -> Float64[np.ndarray, " f"]:
        """Convert stream times to probe times; NaN stays NaN."""
        return self.offset_s + self.rate * stream_s


def from_marks(marks: Float64[np.ndarray, "m 2"], where: str) -> ClockMap:
    """Fit the clock map to sync marks; each row of `marks` is a stream time and a probe time of the same event.

    A single mark determines only the offset; the rate is then assumed to be 1. Several marks also determine the rate.
    """
    if len(np.unique(marks[:, 0])) < len(marks):
        raise CaptureError(
            f"{where}: two marks in clock.marks have the same stream time: {marks.tolist()}. Remove one of these marks "
            "from header.json."
        )
    return _line(marks[:, 0], marks[:, 1] - marks[:, 0], 1.0, where)


def from_contacts(blocks: Iterable[Block], log: ProbeLog, where: str) -> ClockMap:
    """Find the clock map that aligns the contacts visible in the field with the dwells of the probe log.

    At the start of the stream, the robot must be lifted. The function needs 1 byte of memory for each time step of the
    stream. A step is 1/16 of the median duration of a contact dwell.
    """
    if not log.contact.any():
        raise CaptureError(f"{where}: the probe log has no contacts. Record the capture again.")
    step_s = float(np.median((log.t_end_s - log.t_start_s)[log.contact])) / STEPS_PER_DWELL_N
    pattern = _Pattern(log)
    start_s, signal = _contact_signal(blocks, pattern, step_s, where)
    offset_s = _search(signal[:SEARCH_STEPS_N], pattern, start_s, step_s, where)
    mid_s, offsets_s, matched, overlap = [], [], 0.0, 0.0
    window_s = start_s
    for window in np.array_split(signal, -(-len(signal) // WINDOW_STEPS_N)):
        shift_s, window_matched, window_overlap = _follow(window, pattern, window_s + offset_s, step_s)
        matched, overlap = matched + window_matched, overlap + window_overlap
        if window_matched > EXPLAINED_MIN * window_overlap:
            offset_s += shift_s
            mid_s.append(window_s + len(window) * step_s / 2)
            offsets_s.append(offset_s)
        window_s += len(window) * step_s
    if matched <= EXPLAINED_MIN * overlap:
        agreed = matched / max(overlap, 1e-9)
        raise CaptureError(
            f"{where}: the contacts that the field shows agree with only {agreed:.0%} of the dwells of the probe log, "
            f"but more than {EXPLAINED_MIN:.0%} must agree. {_REMEDY}"
        )
    return _line(np.array(mid_s), np.array(offsets_s), matched / overlap, where)


class _Pattern:
    """The contact signal that is expected from the probe log.

    It is positive in contact dwells, negative in no-load dwells, and 0 between dwells; its sum is 0. It is scaled so
    that the mean total magnitude of an indentation is 1.
    """

    def __init__(self, log: ProbeLog) -> None:
        dwell_s = log.t_end_s - log.t_start_s
        total_s = dwell_s[log.contact].sum(), dwell_s[~log.contact].sum()
        firsts = log.t_start_s[~log.contact]  # each indentation begins with its only no-load dwell
        self.start_s, self.end_s = float(log.t_start_s[0]), float(log.t_end_s[-1])
        self.period_s = float(np.median(np.diff(firsts))) if len(firsts) > 1 else self.end_s - self.start_s
        self.quiet = 1 - float(total_s[0]) / (self.end_s - self.start_s)  # fraction of the time without contact
        weight = len(firsts) * dwell_s * np.where(log.contact, 0.5 / total_s[0], -0.5 / total_s[1])
        ends = np.cumsum(weight)
        self._knots_s = np.stack([log.t_start_s, log.t_end_s], axis=1).ravel()
        self._running = np.stack([ends - weight, ends], axis=1).ravel()

    def expected(self, start_s: float, steps_n: int, step_s: float) -> Float64[np.ndarray, " g"]:
        """Return the expected contact signal in `steps_n` steps, which begin at probe time `start_s`."""
        return np.diff(np.interp(start_s + step_s * np.arange(steps_n + 1), self._knots_s, self._running))


def _search(signal: Int8[np.ndarray, " g"], pattern: _Pattern, start_s: float, step_s: float, where: str) -> float:
    """Return the best offset in s (probe time minus stream time); raise if another offset fits almost as well."""
    steps_n = min(int((pattern.end_s - pattern.start_s) / step_s) + 1, SEARCH_STEPS_N)
    # In steps without a frame, the signal is 0. It is scaled to a mean magnitude of 1, so that the scale of the match
    # does not depend on the number of these steps.
    samples = signal / np.abs(signal).mean()
    expected = pattern.expected(pattern.start_s, steps_n, step_s)
    overlap = _correlate(np.abs(expected), np.abs(samples))  # the largest possible match at each offset
    # Without the second term, a wrong offset with a larger overlap could have a higher score than the right offset.
    score = _correlate(expected, samples) - EXPLAINED_MIN * overlap
    score[overlap < OVERLAP_MIN * overlap.max()] = 0.0
    top_i = int(score.argmax())
    elsewhere = np.abs(np.arange(len(score)) - top_i) * step_s > pattern.period_s / 2
    margin = score[top_i] - score[elsewhere].max(initial=0.0)
    # `unexplained` is the overlap minus the match. Its unit is one indentation. If the signal has the wrong sign in a
    # dwell, the dwell adds to the overlap and is subtracted from the match, so it counts twice.
    unexplained = (1 - EXPLAINED_MIN) * overlap[top_i] - score[top_i]
    if margin < MARGIN_MIN + unexplained / 2:
        raise CaptureError(
            f"{where}: two offsets between the clocks align the contacts in the field with the probe log almost "
            f"equally well. The two offsets differ by {margin:.2g} of {np.abs(expected).sum():.0f} indentations. "
            f"{_REMEDY}"
        )
    return pattern.start_s + (top_i - (len(signal) - 1)) * step_s - start_s


def _follow(
    window: Int8[np.ndarray, " g"], pattern: _Pattern, probe_s: float, step_s: float
) -> tuple[float, float, float]:
    """Find the shift in s at which a window of the contact signal agrees best with the probe log.

    The shift is relative to `probe_s`, the probe time at which the window is expected to begin. Also returns the match
    of the window, and its overlap with the dwells, which is the largest possible match.
    """
    reach_n = int(pattern.period_s / step_s) // 2 + 1
    steps_n = len(window) + 2 * reach_n
    expected = pattern.expected(probe_s - reach_n * step_s, steps_n, step_s)
    samples = window.astype(np.float64)
    score = _correlate(expected, samples)[len(samples) - 1 : steps_n]
    top_i = int(score.argmax())
    overlap = np.abs(expected[top_i : top_i + len(window)]) @ np.abs(samples)
    return (_middle(score, top_i) - reach_n) * step_s, float(score[top_i]), float(overlap)


def _correlate(signal: Float64[np.ndarray, " a"], window: Float64[np.ndarray, " b"]) -> Float64[np.ndarray, " c"]:
    """Correlate two signals at every lag at which they overlap."""
    # imported here, because only captures without clock marks need it, and its import takes half a second
    from scipy.signal import correlate

    return np.asarray(correlate(signal, window, method="fft"))


def _middle(score: Float64[np.ndarray, " g"], top_i: int) -> float:
    """Return the position of the peak whose highest value is at `top_i`, interpolated between steps.

    The position is the middle between the two sides of the peak, see `PEAK_DROP`.
    """
    level = (1 - PEAK_DROP) * score[top_i]
    below_i = np.flatnonzero(score < level)
    left_i, right_i = below_i[below_i < top_i][-1:], below_i[below_i > top_i][:1]
    if not len(left_i) or not len(right_i):
        return float(top_i)
    left, right = int(left_i[0]), int(right_i[0])
    rise = (level - score[left]) / (score[left + 1] - score[left])
    fall = (level - score[right]) / (score[right - 1] - score[right])
    return float(left + rise + right - fall) / 2


def _contact_signal(
    blocks: Iterable[Block], pattern: _Pattern, step_s: float, where: str
) -> tuple[float, Int8[np.ndarray, " g"]]:
    """Return the time of the first step of the stream, and the contact signal.

    The contact signal has one value for each step: +1 (contact), -1 (no contact) or 0 (no frame, or undecided). A frame
    is in contact if its field differs from the no-load field by more than noise, see `AWAY_NOISES`. The no-load field
    is updated in each stretch of the stream, as follows. The probe log gives the fraction of time without contact. The
    same fraction of the frames is assumed to be without contact: those whose fields are nearest to the previous no-load
    field. The new no-load field is the mean over the nearer half of these frames. The noise is the distance from the
    new no-load field within which half of the frames without contact lie.
    """
    stretch_s = STRETCH_PERIODS_N * pattern.period_s
    parts: list[tuple[int, Int8[np.ndarray, " g"]]] = []
    noload_uT, noise_uT, start_s = None, np.inf, 0.0
    for t_s, b_uT in _stretches(blocks, stretch_s):
        if noload_uT is None:
            noload_uT, start_s = np.median(b_uT[:START_FRAMES_N], axis=0), float(t_s[0])
        # Do not update the no-load field from a short stretch, because all its frames may be in contact.
        if noise_uT == np.inf or t_s[-1] - t_s[0] > stretch_s / 4:
            sample = b_uT[:: -(-len(b_uT) // REFERENCE_FRAMES_N)]
            distance_uT = np.linalg.norm(sample - noload_uT, axis=1)
            noload_uT = sample[distance_uT <= np.quantile(distance_uT, pattern.quiet / 2)].mean(axis=0)
            noise_uT = float(np.quantile(np.linalg.norm(sample - noload_uT, axis=1), pattern.quiet / 2))
        contact = np.linalg.norm(b_uT - noload_uT, axis=1) > AWAY_NOISES * noise_uT
        if (t_s[-1] - start_s) / step_s > STEPS_MAX_N:
            rule = f"at most {STEPS_MAX_N * step_s:.0f} s long, because the dwells of its probe log are so short"
            raise CaptureError(where, "the stream", rule, f"{t_s[-1] - start_s:.0f} s", _REMEDY)
        step_i = ((t_s - start_s) / step_s).astype(np.int64)
        # If there are several frames in a step, the majority of these frames decides whether it is in contact.
        votes = np.bincount(step_i - step_i[0], np.where(contact, 1, -1))
        parts.append((int(step_i[0]), np.sign(votes).astype(np.int8)))
    if not parts:
        raise CaptureError(f"{where}: the stream has no frames. Record the capture again.")
    signal = np.zeros(parts[-1][0] + len(parts[-1][1]), np.int8)
    for first_i, part in parts:
        signal[first_i : first_i + len(part)] = part
    return start_s, signal


def _stretches(blocks: Iterable[Block], stretch_s: float) -> Iterator[Block]:
    """Cut blocks into stretches that last at most `stretch_s`; omit frames whose time or field is not finite."""
    for t_s, b_uT in blocks:
        good = np.isfinite(b_uT).all(axis=1) & np.isfinite(t_s)
        t_s, b_uT = t_s[good], b_uT[good]
        cuts = [0, *(np.flatnonzero(np.diff(t_s // stretch_s)) + 1), len(t_s)]
        for begin, end in pairwise(cuts):
            if end > begin:
                yield t_s[begin:end], b_uT[begin:end]


def _line(
    stream_s: Float64[np.ndarray, " m"], offset_s: Float64[np.ndarray, " m"], explained: float, where: str
) -> ClockMap:
    """Fit the clock map by least squares to offsets (probe time minus stream time) at several stream times.

    If there is only one offset, the rate of the map is 1.
    """
    # Subtract the mean of the times, so that no precision is lost if a clock counts the seconds since 1970.
    mid_s, mean_s = stream_s.mean(), offset_s.mean()
    spread_s2 = ((stream_s - mid_s) ** 2).sum()
    slope = float(((stream_s - mid_s) * (offset_s - mean_s)).sum() / spread_s2) if len(stream_s) > 1 else 0.0
    residual_s = float(np.abs(offset_s - mean_s - slope * (stream_s - mid_s)).max())
    if abs(slope) > RATE_LIMIT:
        raise CaptureError(
            f"{where}: the clocks of rig and stream differ in speed by a factor of {1 + slope:.6g}, but this factor "
            f"must be between {1 - RATE_LIMIT:g} and {1 + RATE_LIMIT:g}. If the header contains clock.marks, check "
            "that both times of each mark belong to the same event and are in seconds."
        )
    return ClockMap(float(mean_s - slope * mid_s), 1 + slope, residual_s, explained)

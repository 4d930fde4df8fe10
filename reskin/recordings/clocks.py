"""Clocks: arrival times of frames, and the linear map from stream time to probe time."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import pyarrow as pa
from jaxtyping import Bool, Float32, Float64, Int8, Int64

from reskin.errors import CaptureError
from reskin.recordings import tables
from reskin.recordings.probe import ProbeLog

TYPES = {"byte_end": pa.int64(), "t_s": pa.float64()}


@dataclass(frozen=True)
class Arrivals:
    """Arrival time of each chunk of a stream, and number of bytes from the start of the stream to the chunk's end."""

    byte_end: Int64[np.ndarray, " c"]
    t_s: Float64[np.ndarray, " c"]

    def __len__(self) -> int:
        return len(self.byte_end)


def parse(source: str | Path, where: str) -> Arrivals:
    """Read arrivals from CSV text, or from the file at a path; raise `CaptureError` naming the first bad row."""
    table = tables.parse_csv(source, TYPES, where)
    if len(table) < 2:
        raise CaptureError(
            f"{where}: {len(table)} rows of arrivals; two or more are needed. Set a rate in the header instead."
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
        raise CaptureError(f"{where}: t_s is {t_s[0]} in every row. Check the recorder's clock.")
    return Arrivals(byte_end, t_s)


def render(arrivals: Arrivals) -> str:
    """Write arrivals as CSV; `parse` returns the same arrivals."""
    return tables.render_csv(pa.table({name: getattr(arrivals, name) for name in TYPES}))


def times_of(end_byte: Int64[np.ndarray, " f"], arrivals: Arrivals) -> Float64[np.ndarray, " f"]:
    """Return the time of each frame's last byte, interpolated linearly between the ends of chunks.

    Apart from the delay in the port's buffer, a byte arrived after the previous chunk was read and before its own chunk
    was read. Therefore, the error is less than the time between these two reads. In the first chunk, times are
    extrapolated at the stream's mean rate. The time of a frame after the last chunk is NaN.
    """
    byte_end, t_s = arrivals.byte_end, arrivals.t_s
    s_per_byte = (t_s[-1] - t_s[0]) / (byte_end[-1] - byte_end[0])
    before_s = np.minimum(end_byte - byte_end[0], 0) * s_per_byte
    return np.interp(end_byte, byte_end, t_s, right=np.nan) + before_s


def constant_rate(frame: Float64[np.ndarray, " f"], rate_hz: float) -> Float64[np.ndarray, " f"]:
    """Return the time of each frame in s from the start of a stream with a constant frame rate.

    `frame` is the position of each frame's end in the stream, in units of frames. If all frames have the same length,
    this position is the number of bytes up to the frame's end, divided by the length, so that damaged bytes also take
    time. Otherwise, it is the number of the frame, from 1. If frames were lost before the stream was saved, all later
    times are too early.
    """
    return frame / rate_hz


# Maximum deviation of a clock's fitted rate from 1. Real deviations are a few per cent, because the nominal frame rate
# may be inaccurate. A larger deviation means that a mark is in milliseconds, or that its two times belong to different
# events.
RATE_LIMIT = 0.1

# To align the clocks without marks, the stream is divided into time steps. `_search` finds an offset for the first
# SEARCH_STEPS_N steps. Then `_follow` finds one offset per window of about WINDOW_STEPS_N steps. Finally, `_line` fits
# a line to the offsets of the windows.
STEPS_PER_DWELL_N = 16  # number of steps in the median contact dwell, which is called a dwell length below
STEPS_MAX_N = 2**27  # maximum length of a stream: 128 MB, or 1e6 indentations of 8 dwell lengths each
SEARCH_STEPS_N = 2**16  # 4,000 dwell lengths, in which a rate error of 50 ppm accumulates to 0.2 dwell lengths
WINDOW_STEPS_N = 2**14  # 1,000 dwell lengths
# Minimum match between dwells and field, as a fraction of the largest possible match. The fraction is 1 if the field
# agrees with every dwell. For a random offset, it is 0 on average.
EXPLAINED_MIN = 0.5
# The best offset must match this many more indentations than every other offset. The number exceeds 1, because an
# offset that is wrong by one period of a periodic protocol matches only one indentation less, and one contact may be
# too weak to detect.
MARGIN_MIN = 1.5
# Minimum overlap of stream and dwells, relative to the largest overlap at any offset. If the overlap is small, its few
# dwells can fit by chance.
OVERLAP_MIN = 0.5
# A peak of the match can have a flat top. Its position is therefore the middle between the two points where the match
# has dropped to 5 % below the top.
PEAK_DROP = 0.05
# Contact threshold for the distance of a frame's field from the no-load field, as a multiple of the median distance of
# frames without contact. For 15 channels, the threshold is 2.7 standard deviations of these distances above their
# median.
AWAY_NOISES = 1.5
# the no-load field is updated once per stretch of the stream; a stretch has this many indentations
STRETCH_PERIODS_N = 32
START_FRAMES_N = 4  # the first no-load field is the median of this many first frames
REFERENCE_FRAMES_N = 4096  # at most this many frames of a stretch are used to estimate the no-load field
_REMEDY = "Add sync marks: reskin add ... --mark STREAM_S,PROBE_S (the times of one event on the two clocks)."

# Stream times [f] and fields in uT [f ch]. The annotations do not name the axes, because f differs from block to block.
Block = tuple[Float64[np.ndarray, "_"], Float32[np.ndarray, "_ _"]]


@dataclass(frozen=True)
class ClockMap:
    """Linear map from stream time to probe time: probe_s = offset_s + rate * stream_s.

    `residual_s` is the largest misfit of the sync marks, or of the windows, to which the line was fitted. `explained`
    states how well the dwells coincide with contacts in the field. It is 1 if all dwells coincide or if marks were
    given, and on average 0 for a random offset.
    """

    offset_s: float
    rate: float
    residual_s: float
    explained: float

    def probe_s(self, stream_s: Float64[np.ndarray, " f"]) -> Float64[np.ndarray, " f"]:
        """Convert stream times to probe times; NaN stays NaN."""
        return self.offset_s + self.rate * stream_s


def from_marks(marks: Float64[np.ndarray, "m 2"], where: str) -> ClockMap:
    """Fit the clock map to sync marks, one row (stream time, probe time) each.

    A single mark determines only the offset, and the rate is 1. Several marks also determine the rate.
    """
    given = marks.tolist()
    if not given or not np.isfinite(marks).all():
        raise CaptureError(where, "clock.marks", "one or more pairs of finite times", given, "Correct them.")
    if len(np.unique(marks[:, 0])) < len(marks):
        raise CaptureError(f"{where}: clock.marks has two marks at one stream time: {given}. Keep one of them.")
    return _line(marks[:, 0], marks[:, 1] - marks[:, 0], 1.0, where)


def from_contacts(blocks: Iterable[Block], log: ProbeLog, where: str) -> ClockMap:
    """Find the clock map that aligns the contacts visible in the field with the dwells of the probe log.

    The stream must begin with the robot lifted. The function needs 1 byte of memory per time step; a step is 1/16 of
    the median contact dwell.
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
            f"{where}: the field agrees with {agreed:.0%} of the dwells; over {EXPLAINED_MIN:.0%} must agree. {_REMEDY}"
        )
    return _line(np.array(mid_s), np.array(offsets_s), matched / overlap, where)


class _Pattern:
    """The expected contact signal: positive in contact dwells, negative in no-load dwells, with a sum of zero."""

    def __init__(self, log: ProbeLog) -> None:
        dwell_s = log.t_end_s - log.t_start_s
        weight = np.where(log.contact, 0.5 / dwell_s[log.contact].sum(), 0.5 / dwell_s[~log.contact].sum())
        firsts = log.t_start_s[~log.contact]  # each indentation begins with its only no-load dwell
        self.start_s, self.end_s = float(log.t_start_s[0]), float(log.t_end_s[-1])
        self.period_s = float(np.median(np.diff(firsts))) if len(firsts) > 1 else self.end_s - self.start_s
        # Fraction of the time without contact.
        self.quiet = 1 - float(dwell_s[log.contact].sum()) / (self.end_s - self.start_s)
        scaled = len(firsts) * weight * dwell_s  # scaled so that one indentation has weight 1
        self._knots_s = np.stack([log.t_start_s, log.t_end_s], axis=1).ravel()
        self._signed = _running(np.where(log.contact, scaled, -scaled))
        self._unsigned = _running(scaled)

    def signed(self, start_s: float, steps_n: int, step_s: float) -> Float64[np.ndarray, " g"]:
        """Return the weights of `steps_n` steps of probe time; they are 0 between dwells."""
        return np.diff(np.interp(start_s + step_s * np.arange(steps_n + 1), self._knots_s, self._signed))

    def unsigned(self, start_s: float, steps_n: int, step_s: float) -> Float64[np.ndarray, " g"]:
        """Return the magnitudes of the weights of `signed`."""
        return np.diff(np.interp(start_s + step_s * np.arange(steps_n + 1), self._knots_s, self._unsigned))


def _running(weight: Float64[np.ndarray, " d"]) -> Float64[np.ndarray, " e"]:
    """Return the cumulative weight at the start and at the end of each dwell."""
    total = np.cumsum(weight)
    return np.stack([total - weight, total], axis=1).ravel()


def _search(signal: Int8[np.ndarray, " g"], pattern: _Pattern, start_s: float, step_s: float, where: str) -> float:
    """Return the best offset (probe time minus stream time, in s); raise if another offset fits about as well."""
    steps_n = min(int((pattern.end_s - pattern.start_s) / step_s) + 1, SEARCH_STEPS_N)
    samples = signal / np.abs(signal).mean()  # scaled to a mean magnitude of 1, because most steps may have no frame
    weights, unsigned = (weigh(pattern.start_s, steps_n, step_s) for weigh in (pattern.signed, pattern.unsigned))
    overlap = _correlate(unsigned, np.abs(samples))
    # The score is the match minus the match of a barely acceptable fit with the same overlap. Without the second term,
    # an offset with a larger overlap could have a higher score despite a mismatched dwell.
    score = _correlate(weights, samples) - EXPLAINED_MIN * overlap
    score[overlap < OVERLAP_MIN * overlap.max()] = 0.0
    top_i = int(score.argmax())
    elsewhere = np.abs(np.arange(len(score)) - top_i) * step_s > pattern.period_s / 2
    margin = score[top_i] - score[elsewhere].max(initial=0.0)
    # The overlap minus the match, in indentations. A dwell in which the signal has the wrong sign counts twice.
    unexplained = (1 - EXPLAINED_MIN) * overlap[top_i] - score[top_i]
    if margin < MARGIN_MIN + unexplained / 2:
        raise CaptureError(
            f"{where}: the field fits the dwells at two times almost equally well, with matches that differ by "
            f"{margin:.2g} of {unsigned.sum():.0f} indentations. {_REMEDY}"
        )
    return pattern.start_s + (top_i - (len(signal) - 1)) * step_s - start_s


def _follow(
    window: Int8[np.ndarray, " g"], pattern: _Pattern, probe_s: float, step_s: float
) -> tuple[float, float, float]:
    """Find the best shift in s of a window of the contact signal, which is expected to begin at `probe_s`.

    Also returns the window's match with the pattern, and the window's overlap with the dwells, which is the largest
    possible match.
    """
    reach_n = int(pattern.period_s / step_s) // 2 + 1
    begin_s, steps_n = probe_s - reach_n * step_s, len(window) + 2 * reach_n
    samples = window.astype(np.float64)
    score = _correlate(pattern.signed(begin_s, steps_n, step_s), samples)[len(samples) - 1 : steps_n]
    top_i = int(score.argmax())
    overlap = pattern.unsigned(begin_s + top_i * step_s, len(window), step_s) @ np.abs(samples)
    return (_middle(score, top_i) - reach_n) * step_s, float(score[top_i]), float(overlap)


def _correlate(signal: Float64[np.ndarray, " a"], window: Float64[np.ndarray, " b"]) -> Float64[np.ndarray, " c"]:
    """Correlate two signals at every lag at which they overlap, by FFT.

    This replaces scipy.signal.correlate, whose import takes a second.
    """
    from scipy.fft import irfft, next_fast_len, rfft  # imported late, because only captures without clock marks need it

    lags_n = len(signal) + len(window) - 1
    size = next_fast_len(lags_n, real=True)
    return irfft(rfft(signal, size) * rfft(window[::-1], size), size)[:lags_n]


def _middle(score: Float64[np.ndarray, " g"], top_i: int) -> float:
    """Return the position of the peak at `top_i`, interpolated between steps; see `PEAK_DROP`."""
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
    """Return the time of the first step, and +1 (contact), -1 (no-load) or 0 (no frame) for each step of the stream."""
    parts: list[tuple[int, Int8[np.ndarray, " g"]]] = []
    start_s = None
    for t_s, contact in _detect_contact(blocks, pattern):
        start_s = t_s[0] if start_s is None else start_s
        step_i = (t_s - start_s) / step_s
        if step_i[-1] > STEPS_MAX_N:
            rule = f"at most {STEPS_MAX_N * step_s:.0f} s long for dwells this short"
            raise CaptureError(where, "the stream", rule, f"{t_s[-1] - start_s:.0f} s", _REMEDY)
        first_i, index_i = int(step_i[0]), step_i.astype(np.int64) - int(step_i[0])
        # The sign of a step with several frames is that of the majority of these frames.
        parts.append((first_i, np.sign(np.bincount(index_i, np.where(contact, 1, -1))).astype(np.int8)))
    if start_s is None:
        raise CaptureError(f"{where}: the stream has no frames. Record the capture again.")
    signal = np.zeros(parts[-1][0] + len(parts[-1][1]), np.int8)
    for first_i, part in parts:
        signal[first_i : first_i + len(part)] = part
    return float(start_s), signal


def _detect_contact(
    blocks: Iterable[Block], pattern: _Pattern
) -> Iterator[tuple[Float64[np.ndarray, "_"], Bool[np.ndarray, "_"]]]:
    """Yield times, and for each frame whether its field differs from the no-load field by more than noise.

    The no-load field is updated in each stretch of frames. The probe log gives the fraction of time without contact.
    This fraction of the frames, namely those with the smallest distance from the previous no-load field, is assumed to
    be without contact. The half of these frames with the smaller distances gives the new no-load field and the noise.
    """
    noload_uT, noise_uT = None, np.inf
    for t_s, b_uT in _stretches(blocks, STRETCH_PERIODS_N * pattern.period_s):
        if noload_uT is None:
            noload_uT = np.median(b_uT[:START_FRAMES_N], axis=0)
        # Do not update the no-load field from a short stretch, because all its frames may be in contact.
        if noise_uT == np.inf or t_s[-1] - t_s[0] > STRETCH_PERIODS_N * pattern.period_s / 4:
            sample = b_uT[:: -(-len(b_uT) // REFERENCE_FRAMES_N)]
            distance_uT = np.linalg.norm(sample - noload_uT, axis=1)
            noload_uT = sample[distance_uT <= np.quantile(distance_uT, pattern.quiet / 2)].mean(axis=0)
            noise_uT = float(np.quantile(np.linalg.norm(sample - noload_uT, axis=1), pattern.quiet / 2))
        yield t_s, np.linalg.norm(b_uT - noload_uT, axis=1) > AWAY_NOISES * noise_uT


def _stretches(blocks: Iterable[Block], stretch_s: float) -> Iterator[Block]:
    """Cut blocks into stretches of at most `stretch_s`; leave out frames whose time or field is not finite."""
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
    """Fit the clock map to offsets (probe time minus stream time) by least squares; with one offset, the rate is 1."""
    # the times are centred for precision, because clocks may count from 1970
    mid_s, mean_s = stream_s.mean(), offset_s.mean()
    spread_s2 = ((stream_s - mid_s) ** 2).sum()
    slope = float(((stream_s - mid_s) * (offset_s - mean_s)).sum() / spread_s2) if len(stream_s) > 1 else 0.0
    residual_s = float(np.abs(offset_s - mean_s - slope * (stream_s - mid_s)).max())
    if abs(slope) > RATE_LIMIT:
        raise CaptureError(
            f"{where}: clock.marks give the clock a rate of {1 + slope:.6g}, not 1 within {RATE_LIMIT}. Check that "
            "each mark is one event, in seconds."
        )
    return ClockMap(float(mean_s - slope * mid_s), 1 + slope, residual_s, explained)

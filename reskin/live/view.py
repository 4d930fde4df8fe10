"""The last ten seconds as a page draws them. In: readings. Out: binary messages, of a size that no stream makes grow.

Traces are kept as least and greatest values of bins of 20 ms. Refuses to know ports, and who looks.
"""

import struct
from collections import deque

import numpy as np
from jaxtyping import Float, Float64

from reskin.live.tracker import Layout, Readings

WINDOW_S, BIN_S = 10.0, 0.02
BINS_N = round(WINDOW_S / BIN_S)
LATENCIES_N = 4000  # of the last frames: ten seconds at 400 Hz
SENT_KEPT_N = 64  # messages that may be on their way to a screen
HEAD = struct.Struct("<IHHd")  # message, chips, bins, time of the last reading since the start
NUMBERS_N = 12  # x_mm, y_mm, F_N, sd x, sd y, contact, rate, lost bytes, and four latencies in ms


class View:
    """Remembers bins by the time that they are of; one that is too old is written over."""

    def __init__(self, layout: Layout, start_s: float) -> None:
        self._layout, self._start_s = layout, start_s
        self._chips_n = len(layout.chips_mm)
        self._bin = np.full(BINS_N, -1)  # which each place of the ring holds
        self._low = np.full((BINS_N, 1 + self._chips_n), np.nan, np.float32)  # force in N, then |dB| of each chip in uT
        self._high = self._low.copy()
        self._last: Readings | None = None
        self._message_i = 0
        self._sent: deque[tuple[int, float]] = deque(maxlen=SENT_KEPT_N)
        self.to_estimate_s: deque[float] = deque(maxlen=LATENCIES_N)
        self.to_screen_s: deque[float] = deque(maxlen=LATENCIES_N)

    @property
    def newest_bin(self) -> int:
        return int(self._bin.max())

    def feed(self, readings: Readings, now_s: float) -> None:
        """Take estimates that were ready at `now_s`."""
        self._last = readings
        self.to_estimate_s.extend((now_s - readings.t_s).tolist())
        chips_uT = np.linalg.norm(readings.db_uT.reshape(len(readings), -1, 3), axis=2)
        values = np.column_stack([readings.answer[:, 2], chips_uT]).astype(np.float32)
        bins = ((readings.t_s - self._start_s) / BIN_S).astype(int)
        for number in np.unique(bins):
            rows, i = values[bins == number], number % BINS_N
            if self._bin[i] != number:
                self._bin[i], self._low[i], self._high[i] = number, np.nan, np.nan
            self._low[i] = np.fmin(self._low[i], np.fmin.reduce(rows))
            self._high[i] = np.fmax(self._high[i], np.fmax.reduce(rows))

    def message(self, after_bin: int, *, rate_hz: float, lost_bytes_n: int) -> bytes:
        """Write the last reading, and the bins from `after_bin` on, which may have grown since; nothing before any."""
        last = self._last
        if last is None:
            return b""
        self._message_i += 1
        self._sent.append((self._message_i, float(last.t_s[-1])))
        newest = self.newest_bin
        numbers = np.arange(max(after_bin, newest - BINS_N + 1, 0), newest + 1)
        numbers = numbers[self._bin[numbers % BINS_N] == numbers]  # a bin in which nothing came holds an older one
        i = numbers % BINS_N
        latencies_ms = [*_percentiles_ms(self.to_estimate_s), *_percentiles_ms(self.to_screen_s)]
        now = [*last.answer[-1], *last.sd_mm[-1], last.contact[-1], rate_hz, lost_bytes_n, *latencies_ms]
        change_uT = np.einsum("kij,kj->ki", self._layout.turn, last.db_uT[-1].reshape(-1, 3).astype(np.float64))
        t_s = float(last.t_s[-1]) - self._start_s
        head = HEAD.pack(self._message_i % 2**32, self._chips_n, len(i), t_s)
        parts = [
            np.array(now),
            change_uT.ravel(),
            numbers * BIN_S - t_s,  # small: of days since the start, 32 bits would round to more than a bin
            self._low[i].ravel(),
            self._high[i].ravel(),
        ]
        return head + np.concatenate(parts).astype("<f4").tobytes()

    def seen(self, message_i: int, now_s: float) -> None:
        """Note that a screen has shown a message."""
        for sent_i, t_s in self._sent:
            if sent_i == message_i:
                self.to_screen_s.append(now_s - t_s)


def _percentiles_ms(times_s: deque[float]) -> Float[np.ndarray, "2"] | Float64[np.ndarray, "2"]:
    return 1e3 * np.percentile(times_s, [50, 99]) if times_s else np.full(2, np.nan)

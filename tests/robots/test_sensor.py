"""Tests of `SkinSensor`, which has the methods of a LeRobot sensor.

The sensor reads an emulated board on a pseudo-terminal, or a reader that returns frames when a test allows it.
"""

import math
import os
import threading
from contextlib import suppress

import numpy as np
import pytest

import reskin
from reskin.errors import ReskinError
from reskin.live.tracker import LiveSkin
from reskin.robots.sensor import ESTIMATE, SkinConnectionError, SkinSensor, SkinSensorConfig
from tests.live.boards import PLACES, POKE_S, QUIET_S, RATE_HZ, ScriptReader, make_script, plugged_in, write_model
from tests.live.faults import inject

QUIET_N, POKED_N = round(QUIET_S * RATE_HZ), round((QUIET_S + POKE_S) * RATE_HZ)
FIELDS = [f"B{axis}{chip}_uT" for chip in range(5) for axis in "xyz"]


class GatedReader(ScriptReader):
    """A reader that returns only as many frames as a test has allowed by a call of `allow`."""

    def __init__(self, script) -> None:
        super().__init__(script)
        self._allowed_n, self._changed, self._idle = QUIET_N, threading.Condition(), threading.Event()

    def allow(self, frames_n: int) -> None:
        with self._changed:
            self._allowed_n = frames_n
            self._idle.clear()
            self._changed.notify_all()

    def wait(self) -> None:
        """Wait until all allowed frames have been evaluated."""
        assert self._idle.wait(60)

    def take(self, wait_s: float) -> list[tuple[bytes, float]]:
        with self._changed:
            if self._i >= self._allowed_n:
                self._idle.set()
            if not self._changed.wait_for(lambda: self._i < self._allowed_n, wait_s):
                return []
        return super().take(wait_s)


@pytest.fixture
def gated(monkeypatch, tmp_path):
    """Return a function that makes a sensor and its reader."""

    def make(script, **config) -> tuple[SkinSensor, GatedReader]:
        reader = GatedReader(script)
        monkeypatch.setattr("reskin.live.tracker.Reader", lambda port, baud: reader)
        return SkinSensor(SkinSensorConfig(port="gated", model=write_model(tmp_path), **config)), reader

    return make


@pytest.mark.skipif(not hasattr(os, "openpty"), reason="needs pseudo-terminals")
def test_sensor_reads_an_emulated_board(tmp_path):
    with plugged_in(make_script(quiet_s=2.5), loop=True) as port:
        sensor = SkinSensor(SkinSensorConfig(port=port, model=write_model(tmp_path)))
        with sensor:
            assert list(sensor.observation_features) == [*FIELDS, *ESTIMATE]
            reading = sensor.read()
            while not reading["contact"]:
                assert math.isnan(reading["x_mm"])
                assert reading["F_N"] == 0
                reading = sensor.async_read(timeout_ms=5000)
            assert list(reading) == list(sensor.observation_features)
            found = [reading[name] for name in ("x_mm", "y_mm", "F_N")]
            assert np.abs(found - PLACES).max(axis=1).min() < 0.5
        assert not sensor.is_connected


def test_async_read_returns_each_reading_only_once(gated):
    sensor, reader = gated(make_script(), without_contact=-1.0)
    sensor.connect(warmup=False)
    try:
        reader.wait()
        quiet = sensor.async_read(timeout_ms=0)
        assert (quiet["x_mm"], quiet["sd_y_mm"], quiet["contact"], quiet["F_N"]) == (-1.0, -1.0, 0.0, 0.0)
        with pytest.raises(TimeoutError, match="no usable reading within 0 ms. The board says"):
            sensor.async_read(timeout_ms=0)
        reader.allow(QUIET_N + 100)
        reader.wait()
        touched = sensor.async_read(timeout_ms=0)
        assert touched["contact"] == 1.0
        np.testing.assert_allclose([touched[name] for name in ("x_mm", "y_mm", "F_N")], PLACES[0], atol=0.5)
        assert sensor.read_latest(max_age_ms=1e9) == touched
        with pytest.raises(TimeoutError, match="older than -1 ms"):
            sensor.read_latest(max_age_ms=-1)
        reader.allow(POKED_N)
        reader.wait()
        threading.Timer(0.05, reader.allow, [POKED_N + 2 * round(RATE_HZ)]).start()
        sensor.zero()
        assert sensor.async_read(timeout_ms=60_000)["contact"] == 0.0
    finally:
        sensor.disconnect()


def test_async_read_returns_no_unusable_readings(gated):
    sensor, reader = gated(inject(make_script(), "failed-read@1.5+1"))
    with sensor:
        reader.wait()
        with suppress(TimeoutError):
            sensor.async_read(timeout_ms=0)  # the last usable reading, unless `connect` has read it
        reader.allow(POKED_N)
        reader.wait()
        with pytest.raises(TimeoutError, match="chip 1: failed I2C reads"):
            sensor.async_read(timeout_ms=0)


def test_wrong_calls_and_failures_of_the_connection_raise(gated, monkeypatch):
    sensor, _ = gated(make_script())
    for method in (sensor.read, sensor.async_read, sensor.read_latest, sensor.zero, sensor.disconnect):
        with pytest.raises(ConnectionError, match=r"SkinSensor\(gated\) is not connected. Call connect first."):
            method()
    sensor.connect()
    with pytest.raises(SkinConnectionError, match="connected already"):
        sensor.connect()
    monkeypatch.setattr(LiveSkin, "poll", lambda *_, **__: 1 / 0)
    with pytest.raises(ZeroDivisionError):  # an error of the background thread
        for _ in range(1000):
            sensor.read()
    sensor.disconnect()
    monkeypatch.undo()
    with pytest.raises(ConnectionError, match="nowhere"):
        SkinSensor(SkinSensorConfig(port="/dev/nowhere")).connect()
    with pytest.raises(ReskinError, match="a model"):
        SkinSensor(SkinSensorConfig(port="/dev/nowhere", model=3)).connect()
    assert reskin.errors.CaptureError in SkinConnectionError.__mro__

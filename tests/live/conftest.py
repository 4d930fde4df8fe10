"""Fixtures of the live tests. They set longer time limits, because tests also run on busy machines."""

import pytest

LONG_S = 120.0


@pytest.fixture(autouse=True)
def patient(monkeypatch):
    monkeypatch.setattr("reskin.live.tracker.OPENING_S", LONG_S)
    # In a test, a client answers a ping only after it has read all earlier messages, which can take long.
    monkeypatch.setattr("reskin.live.server.HEARTBEAT_S", LONG_S)

"""Longer time limits: they are meant for quiet machines, and tests also run on busy ones."""

import pytest

LONG_S = 120.0


@pytest.fixture(autouse=True)
def patient(monkeypatch):
    monkeypatch.setattr("reskin.live.tracker.OPENING_S", LONG_S)
    monkeypatch.setattr("reskin.live.server.HEARTBEAT_S", LONG_S)  # a test answers a ping when it has read all before

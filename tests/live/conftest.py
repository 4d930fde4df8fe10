"""What a board or a page may take at most is for healthy machines: on one that starves, tests wait for longer."""

import pytest

LONG_S = 120.0


@pytest.fixture(autouse=True)
def patient(monkeypatch):
    monkeypatch.setattr("reskin.live.tracker.OPENING_S", LONG_S)
    monkeypatch.setattr("reskin.live.server.HEARTBEAT_S", LONG_S)  # a test answers a ping when it has read all before

"""Headers for tests: every field of a plausible capture, any of which a test may change."""

from typing import Any

from pipeline.capture.header import Clock, Header


def make_header(**changed: Any) -> Header:
    """Make a header of a recorded lab capture with five chips; `changed` fields are checked like the rest."""
    fields: dict[str, Any] = {
        "format": "reskin-capture/1",
        "capture": "a_capture",
        "board": "board1",
        "skin": "skin1",
        "source": "recorded",
        "layout": "lab",
        "wire": None,
        "chips_n": 5,
        "unit_b": "uT",
        "unit_force": "N",
        "unit_place": "mm",
        "firmware": None,
        "clock": Clock(kind="recording", rate_hz=None, marks=()),
        "protocol": "",
        "contacts_before_n": 0,
        "options": {},
        "files": {},
        "note": "",
    }
    return Header(**(fields | changed))

"""Headers for tests: every field of a plausible capture, any of which a test may change."""

from typing import Any

from pipeline.capture.header import Header, recorded

LAB = {"board": "board1", "skin": "skin1", "layout": "lab", "chips_n": 5, "protocol": "", "note": ""}


def make_header(**changed: Any) -> Header:
    """Make a header of a recorded lab capture with five chips; `changed` fields are checked like the rest."""
    return recorded("test", **({"capture": "a_capture"} | LAB | changed))

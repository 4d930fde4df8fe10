"""Helpers for tests: headers of captures, and the default policy for faulty rows."""

from pathlib import Path
from typing import Any

from reskin.config import parse, read_yaml
from reskin.recordings import header
from reskin.recordings.fault_policy import FaultPolicy
from reskin.recordings.header import Header

LAB = {"board": "board1", "skin": "skin1", "layout": "lab", "chips_n": 5, "protocol": "", "note": ""}
PARAMS = read_yaml(Path(__file__).parents[2] / "params.yaml")
DEFAULT_POLICY = parse(FaultPolicy, PARAMS["faults"], "params.yaml: faults")


def make_header(**changed: Any) -> Header:
    """Return the header of a recorded lab capture with five chips. `changed` replaces fields and validates them."""
    return header.make_header("test", **({"capture": "a_capture"} | LAB | changed))

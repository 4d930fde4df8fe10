"""Sizes of tests: `RESKIN_SLOW_TESTS=1` runs slow tests too, and others at full size. `make bench` sets it."""

import os
from typing import Any

FULL = os.environ.get("RESKIN_SLOW_TESTS") == "1"


def size(full: Any, tiny: Any) -> Any:
    """Return `full` if slow tests are run, else `tiny`."""
    return full if FULL else tiny

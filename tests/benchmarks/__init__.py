"""Benchmarks. `make bench` runs them at full size; the test suite runs each one at a tiny size.

A size is written as `size(FULL, TINY)`. Assertions about times and training results apply at full size only.
"""

import os
from typing import Any

FULL = os.environ.get("RESKIN_BENCHMARKS") == "full"


def size(full: Any, tiny: Any) -> Any:
    """Return `full` if the environment variable RESKIN_BENCHMARKS is "full", else `tiny`."""
    return full if FULL else tiny

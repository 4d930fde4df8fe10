"""Benchmarks. `make bench` runs them at full size; the test suite runs each at a tiny size, so that it keeps working.

Sizes are written `size(FULL, TINY)`. Times and learnt results are asserted at full size only.
"""

import os
from typing import Any

FULL = os.environ.get("RESKIN_BENCHMARKS") == "full"


def size(full: Any, tiny: Any) -> Any:
    """Return the first value if RESKIN_BENCHMARKS is `full`, else the second."""
    return full if FULL else tiny

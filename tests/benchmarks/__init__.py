"""Benchmarks. `make bench` runs them at full size; in the test suite each runs at a tiny size, so that none rots.

Sizes are written `size(FULL, TINY)`. What is asserted about times or learnt results is asserted at full size only.
"""

import os
from typing import Any

FULL = os.environ.get("RESKIN_BENCHMARKS") == "full"


def size(full: Any, tiny: Any) -> Any:
    """Return the first value if RESKIN_BENCHMARKS is `full`, else the second."""
    return full if FULL else tiny

"""One-line texts of objects that hold arrays, for notebooks and error messages."""

from dataclasses import fields
from typing import Any

import numpy as np


def one_line(of: Any) -> str:
    """Return the name of a dataclass and its fields; of arrays their shape, of other large values their type.

    Use it as `__repr__`: the default prints every number.
    """
    shown = (f"{one.name}={_show(getattr(of, one.name))}" for one in fields(of))
    return f"{type(of).__name__}({', '.join(shown)})"


def _show(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return str(list(value.shape))
    if value is None or isinstance(value, str | bool | int | float):
        return repr(value)
    return f"<{type(value).__name__}>"

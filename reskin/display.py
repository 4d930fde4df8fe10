"""One-line representations of dataclasses that hold arrays, for notebooks and error messages."""

from dataclasses import fields
from typing import Any

import numpy as np


def one_line(instance: Any) -> str:
    """Return the name and fields of a dataclass, with shapes for arrays and types for other objects.

    Use this function as `__repr__`, because the default `__repr__` prints every number of an array.
    """
    parts = (f"{field.name}={_show(getattr(instance, field.name))}" for field in fields(instance))
    return f"{type(instance).__name__}({', '.join(parts)})"


def _show(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return str(list(value.shape))
    if value is None or isinstance(value, str | bool | int | float):
        return repr(value)
    return f"<{type(value).__name__}>"

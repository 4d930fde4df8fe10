"""Represent dataclasses that contain arrays in one line, for notebooks and error messages."""

from dataclasses import fields
from typing import Any

import numpy as np


def one_line(instance: Any) -> str:
    """Return a text with the class name and the fields of a dataclass.

    An array is represented by its shape, a number or a text by its value, and another object by its type. A class can
    use this function as its `__repr__`. The default `__repr__` would print the numbers of its arrays.
    """
    parts = (f"{field.name}={_show(getattr(instance, field.name))}" for field in fields(instance))
    return f"{type(instance).__name__}({', '.join(parts)})"


def _show(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return str(list(value.shape))
    if value is None or isinstance(value, str | bool | int | float):
        return repr(value)
    return f"<{type(value).__name__}>"

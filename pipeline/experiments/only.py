"""The one capture of a folder that a question reads: more than one is an error, not a choice. Knows no argv."""

from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

from pipeline.core.errors import SchemaError

Capture = TypeVar("Capture")


def only(captures: Sequence[Capture], folder: Path) -> Capture:
    """Give the capture of a folder that holds one."""
    if len(captures) != 1:
        remedy = "Ask its protocol of one skin (skins_n), and simulate it again."
        raise SchemaError(folder, "captures", "one, as its question reads no more", len(captures), remedy)
    return captures[0]

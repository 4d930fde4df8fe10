"""Synthetic readings and rows for tests."""

from collections.abc import Sequence

import numpy as np

from reskin.data.rows import Rows
from reskin.schema import Readings
from reskin.seeds import rng_for


def readings(capture: str = "c0", board: str = "b0", skin: str = "s0", f: int = 6, **changes: object) -> Readings:
    """Return readings of one chip in two passes.

    Every reading is at another place, with a force of 1 N, and its field change is the number of its row.
    """
    ones = np.ones(f, np.float32)
    values = {
        "capture": capture, "board": board, "skin": skin, "source": "recorded",
        "indentation": np.arange(f, dtype=np.int32), "pass_i": (np.arange(f, dtype=np.int32) * 2) // f,
        "reading_i": np.zeros(f, np.int32), "x_mm": np.arange(f, dtype=np.float32), "y_mm": 2 * ones,
        "depth_mm": ones, "Fx_N": ones * np.nan, "Fy_N": ones * np.nan, "Fz_N": ones,
        "b_uT": np.arange(f, dtype=np.float32)[:, None] + np.full((f, 3), 100, np.float32),
        "noload_uT": np.full((f, 3), 100, np.float32), "temperature_degC": np.full((f, 1), 25, np.float32),
        "t_s": np.arange(f, dtype=np.float64), "n_contacts": np.arange(f, dtype=np.int32),
    }  # fmt: skip
    return Readings(**(values | changes))


def rows(boards: Sequence[str], skins: Sequence[str], pass_i: Sequence[int] | None = None) -> Rows:
    """Return rows with these labels and random fields. Every row is an indentation of its own."""
    rng = rng_for(0, "rows")
    f = len(boards)
    return Rows(
        np.array([f"c_{skin}" for skin in skins]), np.array(boards), np.array(skins),
        rng.normal(0, 50, (f, 3)).astype(np.float32),
        rng.uniform(0, 16, (f, 3)).astype(np.float32), np.array(pass_i or [0] * f, np.int32),
        np.arange(f), {},
    )  # fmt: skip

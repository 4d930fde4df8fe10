"""A dozen pokes anywhere, one change of field each. In: readings while a skin is at work. Out: pokes, once enough.

Refuses to know what is learnt from them.
"""

import numpy as np
from jaxtyping import Float64

from pipeline.live.skin import Readings

POKES_N = 12
READINGS_MIN_N = 4  # of a contact: fewer are a knock


class Pokes:
    """Remembers the strongest reading of the contact that lasts, and of those that have ended."""

    def __init__(self) -> None:
        self._found_uT: list[Float64[np.ndarray, " ch"]] = []
        self._strongest_uT: Float64[np.ndarray, " ch"] | None = None
        self._readings_n = 0

    def __len__(self) -> int:
        return len(self._found_uT)

    @property
    def enough(self) -> bool:
        return len(self) >= POKES_N

    @property
    def db_uT(self) -> Float64[np.ndarray, "n ch"]:
        return np.array(self._found_uT)

    def feed(self, readings: Readings) -> None:
        """Take the next readings; what could not be read ends no contact."""
        known = np.isfinite(readings.db_uT).all(axis=1)
        for db_uT, contact in zip(readings.db_uT[known].astype(np.float64), readings.contact[known], strict=True):
            if contact:
                self._readings_n += 1
                if self._strongest_uT is None or np.linalg.norm(db_uT) > np.linalg.norm(self._strongest_uT):
                    self._strongest_uT = db_uT
            else:
                self._end_contact()

    def _end_contact(self) -> None:
        if self._strongest_uT is not None and self._readings_n >= READINGS_MIN_N and not self.enough:
            self._found_uT.append(self._strongest_uT)
        self._strongest_uT, self._readings_n = None, 0

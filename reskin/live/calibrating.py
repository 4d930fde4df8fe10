"""A dozen pokes anywhere, or at places that are shown. In: readings while a skin is at work. Out: pokes, once enough.

Refuses to know what is learnt from them.
"""

import numpy as np
from jaxtyping import Bool, Float64

from reskin.data.grid import CENTRE_MM
from reskin.live.tracker import Readings
from reskin.seeds import rng_for

POKES_N = 12
SHOWN_MM = CENTRE_MM + 3.0 * np.array([-1.5, -0.5, 0.5, 1.5])  # of the shown places, along x and along y
READINGS_MIN_N = 4  # of a contact: fewer are a knock


class Pokes:
    """Remembers the strongest reading of the contact that lasts, and of those that have ended."""

    def __init__(self, pokes_n: int = POKES_N) -> None:
        self.pokes_n = pokes_n
        self._found_uT: list[Float64[np.ndarray, " ch"]] = []
        self._strongest_uT: Float64[np.ndarray, " ch"] | None = None
        self._readings_n = 0

    def __len__(self) -> int:
        return len(self._found_uT)

    @property
    def enough(self) -> bool:
        return len(self) >= self.pokes_n

    @property
    def words(self) -> str:
        """Say what is to be done next."""
        return f"poke {len(self) + 1} of {self.pokes_n}, anywhere"

    @property
    def next_mm(self) -> list[float] | None:
        """Give the place to press, if it matters."""
        return None

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


class ShownPokes(Pokes):
    """Pokes at the places of a grid, in random order, each where it was shown; every other one is kept for a test."""

    def __init__(self) -> None:
        self.place_mm = rng_for(0, "shown places").permutation(
            np.stack(np.meshgrid(SHOWN_MM, SHOWN_MM), axis=-1).reshape(-1, 2)
        )
        super().__init__(len(self.place_mm))

    @property
    def words(self) -> str:
        return f"press {len(self) + 1} of {self.pokes_n}, at the cross"

    @property
    def next_mm(self) -> list[float] | None:
        return None if self.enough else self.place_mm[len(self)].tolist()

    @property
    def kept(self) -> Bool[np.ndarray, " n"]:
        """Mark the pokes that nothing is learnt from."""
        return np.arange(self.pokes_n) % 2 == 1

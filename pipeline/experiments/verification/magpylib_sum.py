"""The field of many dipoles as magpylib.core has it, for checks and races. In: dipoles, observers, SI. Out: tesla.

Refuses to know skins and pokes.
"""

import numpy as np
from jaxtyping import Float
from scipy.constants import mu_0

from pipeline.physics.skin import Dipoles


def field_of(dipoles: Dipoles, observers_m: Float[np.ndarray, "o 3"]) -> Float[np.ndarray, "o 3"]:
    """Sum magpylib's field of dipoles at observers, in tesla: one call over every pair."""
    from magpylib.core import dipole_Hfield

    places_m, moments = dipoles
    separation_m = (observers_m[:, None] - places_m).reshape(-1, 3)
    h_A_m = dipole_Hfield(observers=separation_m, moments=np.tile(moments, (len(observers_m), 1)))
    return mu_0 * h_A_m.reshape(len(observers_m), -1, 3).sum(axis=1)

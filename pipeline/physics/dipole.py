"""Field of point dipoles. In: places, moments, observers, all SI. Out: magnetic flux density in tesla.

The textbook form; `change` is the same kernel compiled, for dipoles that move.
Refuses to know skins, chips and deformation.
"""

import numpy as np
from jaxtyping import Float
from scipy.constants import mu_0

from pipeline.core.errors import ParamsError

MU0_4PI = mu_0 / (4 * np.pi)  # CODATA, T m / A; not exactly 1e-7 since 2019


def field(
    positions_m: Float[np.ndarray, "s 3"], moments_A_m2: Float[np.ndarray, "s 3"], observers_m: Float[np.ndarray, "o 3"]
) -> Float[np.ndarray, "o 3"]:
    """Sum the fields of all dipoles at each observer, in tesla."""
    return field_of_each(positions_m, moments_A_m2, observers_m).sum(axis=1)


def field_of_each(
    positions_m: Float[np.ndarray, "s 3"], moments_A_m2: Float[np.ndarray, "s 3"], observers_m: Float[np.ndarray, "o 3"]
) -> Float[np.ndarray, "o s 3"]:
    """Give the field of each dipole at each observer: mu0/4pi (3 (m.r) r / r^5 - m / r^3), in tesla."""
    # The axis of three comes first inside, so that every product runs over long contiguous rows.
    separation = observers_m.T[:, :, None] - positions_m.T[:, None, :]
    moment = moments_A_m2.T[:, None, :]
    r2 = (separation * separation).sum(axis=0)
    if r2.size and not r2.min() > 0:
        raise ParamsError("dipole field", "distance to a chip", "above 0 m", "0 or NaN", "Move the chip.")
    along = 3 * (moment * separation).sum(axis=0) / r2
    each = (along * separation - moment) * (MU0_4PI / (r2 * np.sqrt(r2)))
    return np.moveaxis(each, 0, 2)

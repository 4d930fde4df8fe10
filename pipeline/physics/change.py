"""What moving dipoles change in the field. In: dipoles before and after, observers, all SI. Out: the change in tesla.

Summed node by node, never as the difference of two large sums, and compiled: most of a simulation's time goes here.
Refuses to know skins, chips and why dipoles move.
"""

from math import cos, sin, sqrt
from typing import no_type_check

import numpy as np
from jaxtyping import Float
from numba import njit

from pipeline.errors import ParamsError, complain
from pipeline.physics.dipole import MU0_4PI


def change_of_field(
    rest: tuple[Float[np.ndarray, "s 3"], Float[np.ndarray, "s 3"]],
    moved: tuple[Float[np.ndarray, "s 3"], Float[np.ndarray, "s 3"]],
    observers_m: Float[np.ndarray, "o 3"],
) -> Float[np.ndarray, "o 3"]:
    """Sum K(x) m' - K(X) m over the dipoles (positions in m, moments in A m^2) at rest (X, m) and moved (x, m')."""
    change_T = MU0_4PI * _sum_of_changes(*rest, *moved, observers_m)
    if not np.isfinite(change_T).all():
        raise ParamsError(complain("change of field", "distance to a chip", "above 0 m", "0 or NaN", "Move the chip."))
    return change_T


@njit(cache=True, fastmath=False)
@no_type_check
def turned(moments, axis, angle_rad):
    """Turn each moment about its unit axis, right-handed (Rodrigues); all arrays have one row a dipole."""
    out = np.empty_like(moments)
    for i in range(len(moments)):
        c, s = cos(angle_rad[i]), sin(angle_rad[i])
        (mx, my, mz), (ax, ay, az) = moments[i], axis[i]
        along = (ax * mx + ay * my + az * mz) * (1 - c)
        out[i, 0] = c * mx + s * (ay * mz - az * my) + along * ax
        out[i, 1] = c * my + s * (az * mx - ax * mz) + along * ay
        out[i, 2] = c * mz + s * (ax * my - ay * mx) + along * az
    return out


# error_model: a division by zero gives infinity, as in NumPy, and is refused above; no test for it inside the loop.
@njit(cache=True, fastmath=False, error_model="numpy")
@no_type_check
def _sum_of_changes(nodes, moments, moved, moved_moments, observers):
    total = np.zeros_like(observers)
    for o in range(len(observers)):
        x, y, z = observers[o]
        bx = by = bz = 0.0
        for i in range(len(nodes)):
            dx, dy, dz = x - moved[i, 0], y - moved[i, 1], z - moved[i, 2]
            over_r2 = 1 / (dx * dx + dy * dy + dz * dz)
            over_r3 = over_r2 * sqrt(over_r2)
            along = 3 * over_r2 * (moved_moments[i, 0] * dx + moved_moments[i, 1] * dy + moved_moments[i, 2] * dz)
            ex, ey, ez = x - nodes[i, 0], y - nodes[i, 1], z - nodes[i, 2]
            over_q2 = 1 / (ex * ex + ey * ey + ez * ez)
            over_q3 = over_q2 * sqrt(over_q2)
            before = 3 * over_q2 * (moments[i, 0] * ex + moments[i, 1] * ey + moments[i, 2] * ez)
            bx += (along * dx - moved_moments[i, 0]) * over_r3 - (before * ex - moments[i, 0]) * over_q3
            by += (along * dy - moved_moments[i, 1]) * over_r3 - (before * ey - moments[i, 1]) * over_q3
            bz += (along * dz - moved_moments[i, 2]) * over_r3 - (before * ez - moments[i, 2]) * over_q3
        total[o, 0], total[o, 1], total[o, 2] = bx, by, bz
    return total

"""What moving dipoles change in the field. In: dipoles before and after, observers, all SI. Out: the change in tesla.

Subtracted node by node, never as the difference of two large sums, and compiled: most of a simulation's time goes here.
Refuses to know skins, chips and why dipoles move.
"""

from math import sqrt
from typing import no_type_check

import numpy as np
from jaxtyping import Float
from numba import njit

from pipeline.core.errors import ParamsError
from pipeline.physics.dipole import MU0_4PI


def change_of_field(
    rest: tuple[Float[np.ndarray, "s 3"], Float[np.ndarray, "s 3"]],
    moved: tuple[Float[np.ndarray, "s 3"], Float[np.ndarray, "s 3"]],
    observers_m: Float[np.ndarray, "o 3"],
) -> Float[np.ndarray, "o 3"]:
    """Sum K(x) m' - K(X) m over the dipoles (positions in m, moments in A m^2) at rest (X, m) and moved (x, m').

    Columns that lie together in memory (Fortran order, as `flow_map.move` gives them) are not copied.
    """
    rows = [np.ascontiguousarray(part.T) for part in (*rest, *moved)]
    change_T = MU0_4PI * _sum_of_changes(*rows, np.ascontiguousarray(observers_m))
    if not np.isfinite(change_T).all():
        raise ParamsError("change of field", "distance to a chip", "above 0 m", "0 or NaN", "Move the chip.")
    return change_T


# Without fastmath the loop over nodes is still vectorised, since it sums nothing; what stays changes exactly nothing.
# error_model: a division by zero gives infinity, as in NumPy, and is refused above; no test for it inside the loop.
@njit(cache=True, error_model="numpy")
@no_type_check
def _sum_of_changes(nodes, moments, moved, moved_moments, observers):
    u, v, w, p, q, t = nodes[0], nodes[1], nodes[2], moments[0], moments[1], moments[2]
    a, b, c, f, g, h = moved[0], moved[1], moved[2], moved_moments[0], moved_moments[1], moved_moments[2]
    change_x, change_y, change_z = np.empty(len(u)), np.empty(len(u)), np.empty(len(u))
    total = np.zeros_like(observers)
    for o in range(len(observers)):
        x, y, z = observers[o]
        for i in range(len(u)):
            dx, dy, dz = x - a[i], y - b[i], z - c[i]
            over_r2 = 1 / (dx * dx + dy * dy + dz * dz)
            over_r3 = over_r2 * sqrt(over_r2)
            along = 3 * over_r2 * (f[i] * dx + g[i] * dy + h[i] * dz)
            ex, ey, ez = x - u[i], y - v[i], z - w[i]
            over_q2 = 1 / (ex * ex + ey * ey + ez * ez)
            over_q3 = over_q2 * sqrt(over_q2)
            before = 3 * over_q2 * (p[i] * ex + q[i] * ey + t[i] * ez)
            change_x[i] = (along * dx - f[i]) * over_r3 - (before * ex - p[i]) * over_q3
            change_y[i] = (along * dy - g[i]) * over_r3 - (before * ey - q[i]) * over_q3
            change_z[i] = (along * dz - h[i]) * over_r3 - (before * ez - t[i]) * over_q3
        total[o, 0], total[o, 1], total[o, 2] = _total(change_x), _total(change_y), _total(change_z)
    return total


# reassoc: lets several partial sums run side by side. Infinities and NaN are still seen.
@njit(cache=True, fastmath={"reassoc"})
@no_type_check
def _total(parts):
    total = 0.0
    for i in range(len(parts)):
        total += parts[i]
    return total

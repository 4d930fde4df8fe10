"""A poke without shortcuts: no table, no interpolation. In: a skin, a poke. Out: moved dipoles.

Every node is followed by itself, its moment turned by the R of F = R U from a singular value decomposition: too slow
for a capture. Refuses to know chips and how fields are summed (`magpylib_sum`).
"""

import numpy as np
from jaxtyping import Float

from pipeline.experiments.verification.kinematics import descent
from pipeline.physics import flow
from pipeline.physics.skin import Dipoles, Skin


def moved_dipoles(skin: Skin, poke_m: Float[np.ndarray, "3"], steps_n: int) -> Dipoles:
    """Carry all dipoles of a skin through a poke (x, y, depth) in so many steps; none may lie on the poke's axis."""
    away_m = skin.nodes_m[:, :2] - poke_m[:2]
    r_m = np.linalg.norm(away_m, axis=1)
    depths_m = descent(float(poke_m[2]) + skin.depth_zero_m, steps_n)
    press = flow.Press(skin.thickness_m, skin.tip_radius_m, skin.base)
    end = flow.follow(r_m, skin.nodes_m[:, 2], depths_m, press=press)[-1]
    outward = np.column_stack([away_m / r_m[:, None], np.zeros_like(r_m)])
    places_m = np.column_stack([poke_m[:2] + end.r_m[:, None] * outward[:, :2], end.z_m])
    u, _, vt = np.linalg.svd(end.f)
    plane = np.stack([(skin.moments_A_m2 * outward).sum(axis=1), skin.moments_A_m2[:, 2]], axis=1)
    turned = np.einsum("sij,sj->si", u @ vt, plane)
    aside = skin.moments_A_m2 - plane[:, :1] * outward - plane[:, 1:] * (0, 0, 1)
    return places_m, aside + turned[:, :1] * outward + turned[:, 1:] * (0, 0, 1)

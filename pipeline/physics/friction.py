"""Friction under a dragged tip. In: its path, normal force, stiffness, friction. Out: the force along the path.

A spring sticks to the skin until Coulomb lets it slide: Q = min(k_t s, mu F) (PHYSICS 4), in two dimensions.
Refuses to know the layer that makes the spring (`shear`), clocks and fields: the speed does not matter.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Bool, Float
from pydantic import Field

from pipeline.core.config import Strict
from pipeline.core.errors import ParamsError


class Friction(Strict):
    """How well tip and skin hold on to each other."""

    coefficient: Annotated[float, Field(ge=0, le=10)]


@dataclass(frozen=True)
class Drag:
    """What the skin feels at each place of a path; the material under the tip rested at path - elastic."""

    force_N: Float[np.ndarray, "t 2"]  # on the skin, so along the tip's motion
    elastic_m: Float[np.ndarray, "t 2"]
    sliding: Bool[np.ndarray, " t"]


def drag(
    path_m: Float[np.ndarray, "t 2"],
    normal_N: Float[np.ndarray, " t"],
    *,
    stiffness_N_per_m: Float[np.ndarray, "t 2 2"] | Float[np.ndarray, " t"] | float,
    friction: float,
) -> Drag:
    """Follow a tip that touches at the first place of `path_m`; places without normal force are no contact.

    A stiffness is a number, or a symmetric matrix where a skin gives more in one direction than in another.

    Return mapping (Simo & Hughes 1998): the spring follows the whole step, and what exceeds the disc |Q| <= mu F is cut
    off radially as slip. A step sticks or slides only if both its ends are in contact: where in between the tip lifted
    or touched is not known, so the spring starts anew.
    """
    stiffness = np.asarray(stiffness_N_per_m, dtype=float)
    if stiffness.ndim < 3:
        stiffness = np.where(np.eye(2, dtype=bool), np.broadcast_to(stiffness, normal_N.shape)[:, None, None], 0.0)
    _refuse(path_m, normal_N, stiffness, friction)
    limit_N, touching = friction * normal_N, normal_N > 0
    force_N, elastic_m = np.zeros(path_m.shape), np.zeros(path_m.shape)
    sliding = np.zeros(len(path_m), dtype=bool)
    for now in range(1, len(path_m)):
        if not (touching[now] and touching[now - 1]):
            continue
        trial_m = elastic_m[now - 1] + path_m[now] - path_m[now - 1]
        trial_N = np.hypot(*(stiffness[now] @ trial_m))
        sliding[now] = trial_N > limit_N[now]
        elastic_m[now] = trial_m * (limit_N[now] / trial_N) if sliding[now] else trial_m
        force_N[now] = stiffness[now] @ elastic_m[now]
    return Drag(force_N, elastic_m, sliding)


def _refuse(
    path_m: Float[np.ndarray, "t 2"],
    normal_N: Float[np.ndarray, " t"],
    stiffness: Float[np.ndarray, "t 2 2"],
    friction: float,
) -> None:
    if not np.isfinite(path_m).all():
        raise ParamsError("drag", "every place", "finite", "NaN or infinity", "Mend the path.")
    along = np.diagonal(stiffness, axis1=1, axis2=2)
    for what, unit, values in (("normal force", "N", normal_N), ("stiffness", "N/m", along)):
        if not (np.isfinite(values) & (values >= 0)).all():
            worst = values[~(np.isfinite(values) & (values >= 0))][0]
            raise ParamsError("drag", what, f"0 {unit} or more and finite", f"{worst}", "Check its sign.")
    if not 0 <= friction < np.inf:
        raise ParamsError("drag", "friction", "0 or more and finite", f"{friction}", "Check the scene.")

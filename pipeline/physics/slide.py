"""A finite skin slides and turns on its base as one; a layer stiffens as it thins. Places, forces, SI -> motions.

The base drags every piece of skin alike, so where and how the material under the tip is taken decides the rest. How it
is taken, and how force grows with depth, are empirical: fitted on two recorded boards (scene lab), explained by nothing
here. Refuses to know what the layer itself does (`flow_map`), magnets and chips.
"""

from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Float
from numba import njit

from pipeline.core.errors import ParamsError

LETS_GO_N = 8.0  # force at which the slide away from the middle is gone: chosen with both boards in view
STIFFENING = 1.5  # exponent of the thinning layer: chosen with both boards in view
DEEPEST = 0.72  # of the thickness: a larger force counts as the one that goes so deep
CURVE_N = 2000  # depths at which the force is inverted, linear between; off by less than 1e-6 of the thickness


@dataclass(frozen=True)
class Hold:
    """How the tip takes the material under it sideways."""

    give_m: tuple[float, float]  # of the rig's arm, with the skin that it holds
    away: float  # slide away from the skin's middle at no force, per distance from it


@dataclass(frozen=True)
class Slide:
    """The motion of a skin as one, a poke a row: it turns by `spin_rad` about z and its middle, then moves."""

    move_m: Float[np.ndarray, "n 2"]
    spin_rad: Float[np.ndarray, " n"]


def under_tip_m(
    places_m: Float[np.ndarray, "n 2"], force_N: Float[np.ndarray, " n"], hold: Hold
) -> Float[np.ndarray, "n 2"]:
    """Give how the material under the tip is taken: give - away (1 - F / F_lets_go) p, p from the middle."""
    return np.array(hold.give_m) - hold.away * (1 - force_N / LETS_GO_N)[:, None] * places_m


def rigid(places_m: Float[np.ndarray, "n 2"], taken_m: Float[np.ndarray, "n 2"], sides_m: tuple[float, float]) -> Slide:
    """Find the motion that takes the places so far against the least drag, the mean square displacement of the skin.

    u = f + theta z x X with u(p) = D: f = (I + q q^T / rho^2)^-1 D, theta = q.f / rho^2, q = z x p; rho^2, the mean of
    r^2 over the skin, is (a^2 + b^2) / 12. A place off the middle spends part of its displacement on spin.
    """
    rho2_m2 = (sides_m[0] ** 2 + sides_m[1] ** 2) / 12
    q_m = np.stack([-places_m[:, 1], places_m[:, 0]], axis=1)
    spin_rad = (q_m * taken_m).sum(axis=1) / (rho2_m2 + (q_m * q_m).sum(axis=1))
    return Slide(taken_m - q_m * spin_rad[:, None], spin_rad)


def apply(
    slide: Slide, poke_i: int, dipoles: tuple[Float[np.ndarray, "s 3"], Float[np.ndarray, "s 3"]]
) -> tuple[Float[np.ndarray, "s 3"], Float[np.ndarray, "s 3"]]:
    """Turn positions (from the skin's middle) and moments, and move the positions; without a slide nothing changes."""
    positions_m, moments_A_m2 = (np.ascontiguousarray(part.T) for part in dipoles)
    turn = float(np.cos(slide.spin_rad[poke_i])), float(np.sin(slide.spin_rad[poke_i]))
    x_m, y_m = slide.move_m[poke_i]
    return _turn(positions_m, turn, (x_m, y_m)).T, _turn(moments_A_m2, turn, (0.0, 0.0)).T


@njit(cache=True, error_model="numpy")
@no_type_check
def _turn(rows, turn, move):
    (cos, sin), out = turn, np.empty_like(rows)
    for i in range(rows.shape[1]):
        out[0, i] = cos * rows[0, i] - sin * rows[1, i] + move[0]
        out[1, i] = sin * rows[0, i] + cos * rows[1, i] + move[1]
        out[2, i] = rows[2, i]
    return out


def force_at(depth_m: Float[np.ndarray, " n"], *, stiffness_N_m2: float, thickness_m: float) -> Float[np.ndarray, " n"]:
    """Give the force of a tip on a layer that thins under it: K d^2 (1 - d/h)^(-3/2)."""
    if not (np.all(depth_m >= 0) and np.all(depth_m < thickness_m)):
        got = f"{np.min(depth_m):.3g} ... {np.max(depth_m):.3g} m"
        raise ParamsError("poke", "depth", f"0 m or more and below {thickness_m:.3g} m", got, "Poke less deep.")
    return stiffness_N_m2 * depth_m**2 * (1 - depth_m / thickness_m) ** -STIFFENING


def depth_at(force_N: Float[np.ndarray, " n"], *, stiffness_N_m2: float, thickness_m: float) -> Float[np.ndarray, " n"]:
    """Give the depth at which a tip feels a force: at most `DEEPEST` thicknesses."""
    if not stiffness_N_m2 > 0:
        raise ParamsError("layer", "stiffness", "above 0 N/m^2", f"{stiffness_N_m2}", "Check its unit.")
    curve_m = np.linspace(0, DEEPEST * thickness_m, CURVE_N)
    known_N = force_at(curve_m, stiffness_N_m2=stiffness_N_m2, thickness_m=thickness_m)
    return np.interp(force_N, known_N, curve_m)

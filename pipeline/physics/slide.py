"""A finite skin slides and turns on its base as one; a layer stiffens as it thins. Places, forces, SI -> motions.

The base holds every piece of skin alike, by springs as soft in all directions: so where and how the material under the
tip is taken, or which force pulls there, decides the rest, for pressing and for dragging. How a press takes it, and how
force grows with depth, are empirical: fitted on two recorded boards (scene lab), explained by nothing here. Refuses to
know what the layer itself does (`flow_map`, `shear`), magnets and chips.
"""

from dataclasses import dataclass
from typing import Annotated, no_type_check

import numpy as np
from jaxtyping import Float
from numba import njit
from pydantic import Field
from scipy.constants import kilo, micro, milli

from pipeline.core.config import Strict
from pipeline.core.errors import ParamsError

STIFFENING = 1.5  # exponent of the thinning layer: chosen with both boards in view
DEEPEST = 0.72  # of the thickness: a larger force counts as the one that goes so deep
MIDDLE_M = np.zeros(2)
CURVE_N = 2000  # depths at which the force is inverted, linear in its root between; off by less than 1e-6 thicknesses


class HoldDesign(Strict):
    """Section `skin.hold`: how the base holds a skin that slides on it, and how force grows on it."""

    give_um: tuple[float, float]  # of the rig's arm under a press, with the skin that the tip holds, x and y
    away_um_mm: Annotated[float, Field(ge=0, le=100)]  # slide away from the skin's middle at no force
    lets_go_mm2: Annotated[float, Field(gt=0, le=1e6)]  # of d^2 (1 - d/h)^(-3/2), where that slide is gone
    force_per_modulus: Annotated[float, Field(gt=0, le=100)]  # K / E of `force_at`
    springs_N_mm: Annotated[float, Field(gt=0, le=1e6)]  # force that slides the skin as one: screws, clips, friction


@dataclass(frozen=True)
class Hold:
    """The same of one skin, SI."""

    give_m: tuple[float, float]
    away: float
    lets_go_m2: float
    stiffness_N_m2: float
    springs_N_per_m: float


def hold_of(design: HoldDesign, modulus_Pa: float) -> Hold:
    """Scale a design's hold to the skin's modulus; how far it slides under a depth does not depend on that."""
    return Hold(
        give_m=(design.give_um[0] * micro, design.give_um[1] * micro),
        away=design.away_um_mm * micro / milli,
        lets_go_m2=design.lets_go_mm2 * milli**2,
        stiffness_N_m2=design.force_per_modulus * modulus_Pa,
        springs_N_per_m=design.springs_N_mm * kilo,
    )


@dataclass(frozen=True)
class Slide:
    """The motion of a skin as one, a poke a row: it turns by `spin_rad` about z and its middle, then moves."""

    move_m: Float[np.ndarray, "n 2"]
    spin_rad: Float[np.ndarray, " n"]


def under_tip_m(
    places_m: Float[np.ndarray, "n 2"], load: Float[np.ndarray, " n"], *, give_m: tuple[float, float], away: float
) -> Float[np.ndarray, "n 2"]:
    """Give how a press takes the material under the tip: give - away (1 - load) p, p from the skin's middle.

    `load` is the force over the one at which the slide away is gone.
    """
    return np.array(give_m) - away * (1 - load)[:, None] * places_m


def load_of(depth_m: Float[np.ndarray, " n"], hold: Hold, thickness_m: float) -> Float[np.ndarray, " n"]:
    """Give the load of `under_tip_m` at depths: F(d) / F(where the slide is gone), at most 1, whatever the modulus."""
    return np.minimum(force_at(depth_m, stiffness_N_m2=1.0, thickness_m=thickness_m) / hold.lets_go_m2, 1.0)


def compliance_m_per_N(
    places_m: Float[np.ndarray, "n 2"], sides_m: tuple[float, float], springs_N_per_m: float
) -> Float[np.ndarray, "n 2 2"]:
    """Give how far a force at a place slides that place along: (I + q q^T / rho^2) / springs, see `rigid`."""
    q_m = np.stack([-places_m[:, 1], places_m[:, 0]], axis=1)
    spun = q_m[:, :, None] * q_m[:, None, :] / _rho2_m2(sides_m)
    return (np.eye(2) + spun) / springs_N_per_m


def rigid(places_m: Float[np.ndarray, "n 2"], taken_m: Float[np.ndarray, "n 2"], sides_m: tuple[float, float]) -> Slide:
    """Find the motion that takes the places so far against the least work of the springs, mean square displacement.

    u = f + theta z x X with u(p) = D: f = (I + q q^T / rho^2)^-1 D, theta = q.f / rho^2, q = z x p; rho^2, the mean of
    r^2 over the skin, is (a^2 + b^2) / 12. A place off the middle spends part of its displacement on spin.
    """
    q_m = np.stack([-places_m[:, 1], places_m[:, 0]], axis=1)
    spin_rad = (q_m * taken_m).sum(axis=1) / (_rho2_m2(sides_m) + (q_m * q_m).sum(axis=1))
    return Slide(taken_m - q_m * spin_rad[:, None], spin_rad)


def apply(
    slide: Slide,
    poke_i: int,
    dipoles: tuple[Float[np.ndarray, "s 3"], Float[np.ndarray, "s 3"]],
    middle_m: Float[np.ndarray, "2"] = MIDDLE_M,
) -> tuple[Float[np.ndarray, "s 3"], Float[np.ndarray, "s 3"]]:
    """Turn positions about the skin's middle and moments, and move the positions; without a slide nothing changes."""
    positions_m, moments_A_m2 = (part.T.copy() for part in dipoles)
    apply_in_place(slide, poke_i, (positions_m.T, moments_A_m2.T), middle_m)
    return positions_m.T, moments_A_m2.T


def apply_in_place(
    slide: Slide,
    poke_i: int,
    dipoles: tuple[Float[np.ndarray, "s 3"], Float[np.ndarray, "s 3"]],
    middle_m: Float[np.ndarray, "2"] = MIDDLE_M,
) -> None:
    """Do as `apply` does to the arrays themselves, which nobody else may need: a poke moves thousands of dipoles."""
    positions_m, moments_A_m2 = dipoles
    cos, sin = float(np.cos(slide.spin_rad[poke_i])), float(np.sin(slide.spin_rad[poke_i]))
    (x_m, y_m), (middle_x_m, middle_y_m) = slide.move_m[poke_i], middle_m
    # R (X - middle) + middle + move
    move_m = x_m + (1 - cos) * middle_x_m + sin * middle_y_m, y_m + (1 - cos) * middle_y_m - sin * middle_x_m
    _turn(positions_m.T, (cos, sin), move_m)
    _turn(moments_A_m2.T, (cos, sin), (0.0, 0.0))


@njit(cache=True, error_model="numpy")
@no_type_check
def _turn(rows, turn, move):
    cos, sin = turn
    for i in range(rows.shape[1]):
        x, y = rows[0, i], rows[1, i]
        rows[0, i] = cos * x - sin * y + move[0]
        rows[1, i] = sin * x + cos * y + move[1]


def force_at(depth_m: Float[np.ndarray, " n"], *, stiffness_N_m2: float, thickness_m: float) -> Float[np.ndarray, " n"]:
    """Give the force of a tip on a layer that thins under it: K d^2 (1 - d/h)^(-3/2)."""
    if not (np.all(depth_m >= 0) and np.all(depth_m < thickness_m)):
        got = f"{np.min(depth_m):.3g} ... {np.max(depth_m):.3g} m"
        raise ParamsError("poke", "depth", f"0 m or more and below {thickness_m:.3g} m", got, "Poke less deep.")
    return stiffness_N_m2 * depth_m**2 * (1 - depth_m / thickness_m) ** -STIFFENING


def beyond_n(force_N: Float[np.ndarray, " n"], *, stiffness_N_m2: float, thickness_m: float) -> int:
    """Count the forces that `depth_at` holds at its deepest, as they lie beyond it."""
    deepest_m = np.array([DEEPEST * thickness_m])
    return int((force_N > force_at(deepest_m, stiffness_N_m2=stiffness_N_m2, thickness_m=thickness_m)).sum())


def depth_at(force_N: Float[np.ndarray, " n"], *, stiffness_N_m2: float, thickness_m: float) -> Float[np.ndarray, " n"]:
    """Give the depth at which a tip feels a force: at most `DEEPEST` thicknesses; `beyond_n` counts what is held."""
    if not stiffness_N_m2 > 0:
        raise ParamsError("layer", "stiffness", "above 0 N/m^2", f"{stiffness_N_m2}", "Check its unit.")
    curve_m = np.linspace(0, DEEPEST * thickness_m, CURVE_N)
    known_N = force_at(curve_m, stiffness_N_m2=stiffness_N_m2, thickness_m=thickness_m)
    root = np.sqrt(np.maximum(force_N, 0.0))  # the force starts as a square of the depth; a tip that pulls has none
    return np.interp(root, np.sqrt(known_N), curve_m)


def _rho2_m2(sides_m: tuple[float, float]) -> float:
    return (sides_m[0] ** 2 + sides_m[1] ** 2) / 12

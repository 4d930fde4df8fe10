"""How a finite skin slides and turns on its base as one, and how its force grows with depth. SI units.

The base holds every piece of skin alike, by springs as soft in all directions. So where and how the material under the
tip is taken, or which force pulls there, decides the rest, for pressing and for dragging. A tip cannot drag a skin
further than its friction allows: a slide is bounded by that (`gripped`), and goes to zero with the force.

The force is that of the elastic layer on a sliding base, which `deformation` moves, times (1 - d/h)^(-3/2): the layer
stiffens as it thins. That factor is 1.2 at 0.2 mm and 4.0 at 1.2 mm of a 2 mm skin. It and how a press takes the skin
are empirical: chosen on two recorded boards (scene lab), which the layer's force alone does not fit.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, no_type_check

import numpy as np
from jaxtyping import Float
from numba import njit
from pydantic import Field
from scipy.constants import kilo, micro, milli

from reskin.config import Strict
from reskin.errors import ParamsError
from reskin.physics import layer

STIFFENING = 1.5  # exponent of the thinning layer: chosen with both boards in view; 1.25 to 2 explain them as well
DEEPEST = 0.72  # of the thickness: a larger force counts as the one that goes so deep
MIDDLE_M = np.zeros(2)
CURVE_N = 2000  # depths at which the force is inverted; between them d is linear in F^(2/3), as Hertz's is


class HoldDesign(Strict):
    """Section `skin.hold`: how the base holds a skin that slides on it."""

    give_um: tuple[float, float]  # of the rig's arm under a press, with the skin that the tip holds, x and y
    away_um_mm: Annotated[float, Field(ge=0, le=100)]  # slide away from the skin's middle under a firm grip
    lets_go_mm2: Annotated[float, Field(gt=0, le=1e6)]  # force over Young's modulus at which that slide is gone
    springs_N_mm: Annotated[float, Field(gt=0, le=1e6)]  # force that slides the skin as one: screws, clips, friction
    friction: Annotated[float, Field(gt=0, le=10)]  # of the tip on the skin: bounds what a press slides


@dataclass(frozen=True)
class Hold:
    """The same of one skin, SI."""

    give_m: tuple[float, float]
    away: float
    lets_go_m2: float
    springs_N_per_m: float
    friction: float

    @property
    def grip_N_per_m(self) -> float:
        """Normal force over the slide that it can hold: k / mu, see `gripped`; infinite without friction."""
        return self.springs_N_per_m / self.friction if self.friction > 0 else np.inf


def hold_of(design: HoldDesign) -> Hold:
    """Convert a design's hold to SI."""
    return Hold(
        give_m=(design.give_um[0] * micro, design.give_um[1] * micro),
        away=design.away_um_mm * micro / milli,
        lets_go_m2=design.lets_go_mm2 * milli**2,
        springs_N_per_m=design.springs_N_mm * kilo,
        friction=design.friction,
    )


@dataclass(frozen=True)
class Slide:
    """The motion of a skin as one, a poke a row: it turns by `spin_rad` about z and its middle, then moves."""

    move_m: Float[np.ndarray, "n 2"]
    spin_rad: Float[np.ndarray, " n"]

    def times(self, share: Float[np.ndarray, " n"]) -> "Slide":
        """Give a share of each motion."""
        return Slide(self.move_m * share[:, None], self.spin_rad * share)


def under_tip_m(
    places_m: Float[np.ndarray, "n 2"], load: Float[np.ndarray, " n"], *, give_m: tuple[float, float], away: float
) -> Float[np.ndarray, "n 2"]:
    """Give how a press takes the material under a tip that holds it: give - away (1 - load) p, p from the middle.

    `load` is the force over the one at which the slide away is gone; `gripped` says how far a light press does it.
    """
    return np.array(give_m) - away * (1 - load)[:, None] * places_m


def gripped(slide: Slide, force_N: Float[np.ndarray, " n"], grip_N_per_m: float) -> Slide:
    """Bound slides by the friction of a tip that presses with these forces.

    A slide u needs the sideways force k |u|, which Coulomb bounds by mu F. The share that is reached,
    1 - exp(-mu F / (k |u|)), is below both bounds: k |u| share <= mu F, and the whole slide under a firm press.
    `grip_N_per_m` is k / mu.
    """
    with np.errstate(invalid="ignore"):  # no slide that nothing grips
        needed_N = grip_N_per_m * np.hypot(*slide.move_m.T)
    moves = needed_N > 0
    with np.errstate(over="ignore"):  # of a slide so small that any force takes all of it
        share = np.where(moves, -np.expm1(-force_N / np.where(moves, needed_N, 1.0)), 0.0)
    return slide.times(share)


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


def force_at(
    depth_m: Float[np.ndarray, " n"], *, modulus_Pa: float, thickness_m: float, tip_radius_m: float
) -> Float[np.ndarray, " n"]:
    """Give the force of a tip on a sliding layer that thins under it: that of `layer.force` times `stiffening`."""
    elastic_N = layer.force(
        depth_m, thickness_m=thickness_m, tip_radius_m=tip_radius_m, modulus_Pa=modulus_Pa, base="slipping"
    )
    return elastic_N * stiffening(depth_m, thickness_m)


def stiffening(depth_m: Float[np.ndarray, " n"], thickness_m: float) -> Float[np.ndarray, " n"]:
    """Give by how much a layer is stiffer that thins under a tip, against pressing and (assumed) shear alike."""
    return (1 - np.maximum(depth_m, 0.0) / thickness_m) ** -STIFFENING


def beyond_n(force_N: Float[np.ndarray, " n"], *, modulus_Pa: float, thickness_m: float, tip_radius_m: float) -> int:
    """Count the forces that `depth_at` holds at its deepest, as they lie beyond it."""
    at_m = np.array([_deepest_m(thickness_m, tip_radius_m)])
    deepest_N = force_at(at_m, modulus_Pa=modulus_Pa, thickness_m=thickness_m, tip_radius_m=tip_radius_m)
    return int((force_N > deepest_N).sum())


def depth_at(
    force_N: Float[np.ndarray, " n"], *, modulus_Pa: float, thickness_m: float, tip_radius_m: float
) -> Float[np.ndarray, " n"]:
    """Give the depth at which a tip feels a force: at most `DEEPEST` thicknesses; `beyond_n` counts what is held."""
    if not modulus_Pa > 0:
        raise ParamsError("layer", "modulus", "above 0 Pa", f"{modulus_Pa}", "Check its unit.")
    curve_m, curve_m2 = _curve(thickness_m, tip_radius_m)
    relative_m2 = np.maximum(force_N, 0.0) / modulus_Pa  # a tip that pulls has no force
    return np.interp(np.cbrt(relative_m2**2), curve_m2, curve_m)


def _deepest_m(thickness_m: float, tip_radius_m: float) -> float:
    """Give the depth that is followed at most: `DEEPEST` thicknesses, and less than the radius of a sharp tip."""
    return min(DEEPEST * thickness_m, 0.999 * tip_radius_m)


@lru_cache(maxsize=64)
def _curve(thickness_m: float, tip_radius_m: float) -> tuple[Float[np.ndarray, " c"], Float[np.ndarray, " c"]]:
    # Depths, and (F / E)^(2/3) there.
    curve_m = np.linspace(0, _deepest_m(thickness_m, tip_radius_m), CURVE_N)
    known_m2 = force_at(curve_m, modulus_Pa=1.0, thickness_m=thickness_m, tip_radius_m=tip_radius_m)
    return curve_m, np.cbrt(known_m2**2)


def _rho2_m2(sides_m: tuple[float, float]) -> float:
    return (sides_m[0] ** 2 + sides_m[1] ** 2) / 12

"""Rigid sliding of a finite skin on its base, and the normal force as a function of depth.

All values are in SI units. When a tip presses or drags a skin that is not glued to its base, the whole skin slides a
little. The base is modelled by springs that are distributed evenly under the skin and are equally stiff in all lateral
directions. With this model, the rigid motion of the skin follows from the displacement of the material under the tip
(for a press), or from the tangential force (for a drag). The friction between tip and skin limits the motion. Without
normal force, there is therefore no motion (see `limit_by_friction`).

The normal force is the force of an elastic layer that is bonded to its base (module `layer`), multiplied by the factor
(1 - d/h)^-n, where d is the depth, h is the thickness and n is the `stiffening`. With n = 0, the layer is linear
elastic. With n above 0, it becomes stiffer as it becomes thinner. The displacements of the material are those of a
layer that slips on its base, but the force assumes that the friction under a press holds the base. The displacement of
the whole skin due to a press is empirical: it was fitted to recorded boards, because the elastic layer alone does not
describe the recordings.
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
from reskin.physics.magnet import Dipoles

DEEPEST = 0.72  # greatest depth that `depth_at` returns, as a fraction of the thickness
CENTRE_M = np.zeros(2)
# Number of points on the curve from which `depth_at` interpolates the depth. Between the points, the depth is linear in
# force^(2/3), as in Hertz's theory.
CURVE_N = 2000


class HoldDesign(Strict):
    """Section `skin.hold` of the settings: how the base holds a skin, and how a press displaces the skin.

    The settings describe a skin that can slide on its base. See `press_displacement_m` and `limit_by_friction` for the
    formulas.
    """

    # displacement along x and y due to a press, which is the same at all places, because the robot's arm yields
    give_um: tuple[float, float]
    # displacement towards the skin's centre due to a light press, divided by the distance from the centre
    away_um_mm: Annotated[float, Field(ge=0, le=100)]
    # Force at which the displacement towards the centre vanishes. Up to this force, it decreases linearly.
    lets_go_N: Annotated[float, Field(gt=0, le=1e6)]
    springs_N_mm: Annotated[float, Field(gt=0, le=1e6)]  # lateral stiffness of the base, due to screws, clips, friction
    friction: Annotated[float, Field(gt=0, le=10)]  # friction coefficient between tip and skin

    def in_si(self) -> "Hold":
        """Convert to SI units."""
        return Hold(
            give_m=(self.give_um[0] * micro, self.give_um[1] * micro),
            away=self.away_um_mm * micro / milli,
            lets_go_N=self.lets_go_N,
            springs_N_per_m=self.springs_N_mm * kilo,
            friction=self.friction,
        )


@dataclass(frozen=True)
class Hold:
    """The settings of `HoldDesign`, converted to SI units."""

    give_m: tuple[float, float]
    away: float
    lets_go_N: float
    springs_N_per_m: float
    friction: float

    @property
    def grip_N_per_m(self) -> float:
        """Normal force that is needed to move the skin by friction, divided by the displacement.

        The value is k / mu, where k is the lateral stiffness of the base and mu is the friction coefficient. It is
        infinite if mu is 0.
        """
        return self.springs_N_per_m / self.friction if self.friction > 0 else np.inf


@dataclass(frozen=True)
class RigidMotion:
    """The rigid motion of a skin in each of n indentations.

    A motion is a rotation about the skin's centre, which is followed by a translation.
    """

    move_m: Float[np.ndarray, "n 2"]  # translation
    spin_rad: Float[np.ndarray, " n"]  # angle of the rotation

    def scaled(self, share: Float[np.ndarray, " n"]) -> "RigidMotion":
        """Return the motions, with the translation and the angle of each motion multiplied by its own factor."""
        return RigidMotion(self.move_m * share[:, None], self.spin_rad * share)


def press_displacement_m(
    places_m: Float[np.ndarray, "n 2"], load: Float[np.ndarray, " n"], *, give_m: tuple[float, float], away: float
) -> Float[np.ndarray, "n 2"]:
    """Return the lateral displacement of the material under a tip that presses the skin and does not slip.

    The displacement is give - away (1 - load) p, where p is the place relative to the skin's centre. The second term
    displaces the material towards the centre. In a light press, the tip slips, so that the displacement is smaller than
    this result (see `limit_by_friction`).

    Parameters
    ----------
    places_m : place of each press, relative to the skin's centre
    load : force of each press, divided by the force at which the second term vanishes; at most 1
    give_m : displacement that is the same at all places
    away : displacement towards the centre in a light press, divided by the distance from the centre
    """
    return np.array(give_m) - away * (1 - load)[:, None] * places_m


def limit_by_friction(motion: RigidMotion, force_N: Float[np.ndarray, " n"], grip_N_per_m: float) -> RigidMotion:
    """Reduce rigid motions to the motions that Coulomb friction can cause at the normal forces F.

    To displace the skin by u, the tip must exert the lateral force k |u|, where k is the stiffness of the base's
    springs. The friction, however, exerts at most the force mu F, where mu is the friction coefficient. The motion is
    therefore multiplied by the factor 1 - exp(-mu F / (k |u|)). With this factor, the lateral force is always below
    mu F. For a strong press, the factor is close to 1, so that the motion is hardly reduced. `grip_N_per_m` is k / mu.
    """
    with np.errstate(invalid="ignore"):  # if both the motion and the friction are 0, the product inf * 0 is NaN
        needed_N = grip_N_per_m * np.hypot(*motion.move_m.T)
    moves = needed_N > 0
    with np.errstate(over="ignore"):  # the quotient overflows to infinity if the motion is extremely small
        share = np.where(moves, -np.expm1(-force_N / np.where(moves, needed_N, 1.0)), 0.0)
    return motion.scaled(share)


def compliance_m_per_N(
    places_m: Float[np.ndarray, "n 2"], sides_m: tuple[float, float], springs_N_per_m: float
) -> Float[np.ndarray, "n 2 2"]:
    """Return the compliance of the base: the displacement of the skin at each place per lateral force at this place.

    The compliance is the matrix (I + q q^T / rho^2) / k, where q and rho are defined in `rigid_motion` and k is
    `springs_N_per_m`.
    """
    q_m = np.stack([-places_m[:, 1], places_m[:, 0]], axis=1)
    rotational = q_m[:, :, None] * q_m[:, None, :] / _rho2_m2(sides_m)
    return (np.eye(2) + rotational) / springs_N_per_m


def rigid_motion(
    places_m: Float[np.ndarray, "n 2"], displacement_m: Float[np.ndarray, "n 2"], sides_m: tuple[float, float]
) -> RigidMotion:
    """Return the rigid motion of the skin that displaces a given place by a given vector, for each place.

    Many rigid motions displace the place p by the vector D (`displacement_m`). The result is the motion for which the
    elastic energy of the base is smallest. A rigid motion displaces the point X by u(X) = f + theta z x X, where f is a
    translation, theta is the angle of a small rotation, and z is the unit vector along z. The condition u(p) = D
    results in f = (I + q q^T / rho^2)^-1 D and theta = q.f / rho^2, where q = z x p. The length rho is given by
    rho^2 = (a^2 + b^2) / 12, which is the mean of r^2 over a skin with the sides a and b.
    """
    q_m = np.stack([-places_m[:, 1], places_m[:, 0]], axis=1)
    spin_rad = (q_m * displacement_m).sum(axis=1) / (_rho2_m2(sides_m) + (q_m * q_m).sum(axis=1))
    return RigidMotion(displacement_m - q_m * spin_rad[:, None], spin_rad)


def apply(
    motion: RigidMotion,
    i: int,
    dipoles: Dipoles,
    centre_m: Float[np.ndarray, "2"] = CENTRE_M,
) -> Dipoles:
    """Return dipoles after the rigid motion with the index `i`.

    The positions are rotated about `centre_m` and then translated. The moments are rotated.
    """
    positions_m, moments_A_m2 = (part.T.copy() for part in dipoles)
    apply_in_place(motion, i, (positions_m.T, moments_A_m2.T), centre_m)
    return positions_m.T, moments_A_m2.T


def apply_in_place(
    motion: RigidMotion,
    i: int,
    dipoles: Dipoles,
    centre_m: Float[np.ndarray, "2"] = CENTRE_M,
) -> None:
    """Do the same as `apply`, but overwrite the arrays of the dipoles, which is faster for thousands of dipoles."""
    positions_m, moments_A_m2 = dipoles
    cos, sin = float(np.cos(motion.spin_rad[i])), float(np.sin(motion.spin_rad[i]))
    (x_m, y_m), (centre_x_m, centre_y_m) = motion.move_m[i], centre_m
    # A point X moves to R (X - centre) + centre + move, where R is the rotation matrix. The following vector is the
    # part of this sum that does not depend on X.
    move_m = x_m + (1 - cos) * centre_x_m + sin * centre_y_m, y_m + (1 - cos) * centre_y_m - sin * centre_x_m
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
    depth_m: Float[np.ndarray, " n"],
    *,
    modulus_Pa: float,
    thickness_m: float,
    tip_radius_m: float,
    stiffening: float,
    base: layer.Base = "bonded",
) -> Float[np.ndarray, " n"]:
    """Return the normal force in N at each depth: the force of an elastic layer times `stiffening_factor`."""
    elastic_N = layer.force(
        depth_m, thickness_m=thickness_m, tip_radius_m=tip_radius_m, modulus_Pa=modulus_Pa, base=base
    )
    return elastic_N * stiffening_factor(depth_m, thickness_m, stiffening)


def stiffening_factor(
    depth_m: Float[np.ndarray, " n"], thickness_m: float, stiffening: float
) -> Float[np.ndarray, " n"]:
    """Return the factor (1 - d/h)^-n by which a layer of the thickness h is stiffer at the depth d; n is `stiffening`.

    The same factor is used for the normal force and for the shear modulus.
    """
    return (1 - np.maximum(depth_m, 0.0) / thickness_m) ** -stiffening


def count_clipped(
    force_N: Float[np.ndarray, " n"], *, modulus_Pa: float, thickness_m: float, tip_radius_m: float, stiffening: float
) -> int:
    """Count the forces for which `depth_at` clips the depth, because they need a depth above its greatest depth."""
    _, curve_m2 = _curve(thickness_m=thickness_m, tip_radius_m=tip_radius_m, stiffening=stiffening)
    return int((np.cbrt((np.maximum(force_N, 0.0) / modulus_Pa) ** 2) > curve_m2[-1]).sum())


def depth_at(
    force_N: Float[np.ndarray, " n"], *, modulus_Pa: float, thickness_m: float, tip_radius_m: float, stiffening: float
) -> Float[np.ndarray, " n"]:
    """Return the depth in m at which the normal force has the given value, for each force.

    The result is at most `DEEPEST` thicknesses, and slightly less than the tip radius. Depths for larger forces are
    clipped. `count_clipped` returns the number of clipped depths.
    """
    if not modulus_Pa > 0:
        raise ParamsError("layer", "modulus", "above 0 Pa", f"{modulus_Pa}", "Correct modulus_kPa of the skin.")
    curve_m, curve_m2 = _curve(thickness_m=thickness_m, tip_radius_m=tip_radius_m, stiffening=stiffening)
    relative_m2 = np.maximum(force_N, 0.0) / modulus_Pa  # a negative force is treated as 0
    return np.interp(np.cbrt(relative_m2**2), curve_m2, curve_m)


@lru_cache(maxsize=64)
def _curve(
    *, thickness_m: float, tip_radius_m: float, stiffening: float
) -> tuple[Float[np.ndarray, " c"], Float[np.ndarray, " c"]]:
    # Return equally spaced depths in m, and (F / E)^(2/3) at each depth, where F is the force and E is Young's modulus.
    deepest_m = min(DEEPEST * thickness_m, 0.999 * tip_radius_m)
    curve_m = np.linspace(0, deepest_m, CURVE_N)
    known_m2 = force_at(
        curve_m, modulus_Pa=1.0, thickness_m=thickness_m, tip_radius_m=tip_radius_m, stiffening=stiffening
    )
    return curve_m, np.cbrt(known_m2**2)


def _rho2_m2(sides_m: tuple[float, float]) -> float:
    return (sides_m[0] ** 2 + sides_m[1] ** 2) / 12

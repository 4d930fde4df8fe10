"""Rigid sliding of a finite skin on its base, and the normal force as a function of depth. SI units.

The base is modelled as evenly distributed, isotropic springs that hold the whole skin. Therefore, the rigid motion of
the skin follows from the displacement of the material under the tip (for a press) or from the tangential force (for a
drag). Friction between tip and skin limits the motion, so that there is no motion without normal force
(`limit_by_friction`).

The normal force is that of the slipping elastic layer (`layer`) times (1 - d/h)^(-3/2), with depth d and thickness h,
because the layer stiffens as it becomes thinner. For a skin of 2 mm, this factor is 1.2 at a depth of 0.2 mm and 4.0 at
1.2 mm. The factor and the displacement due to a press are empirical. They were fitted to two recorded boards (scene
lab), whose data the elastic layer alone does not describe.
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

STIFFENING = 1.5  # exponent, from the two recorded boards; values from 1.25 to 2 fit their data equally well
DEEPEST = 0.72  # greatest depth of `depth_at`, as a fraction of the thickness
CENTRE_M = np.zeros(2)
CURVE_N = 2000  # number of points of the inverse force curve, which is linear in force^(2/3) between points (Hertz)


class HoldDesign(Strict):
    """Section `skin.hold`: how the base holds a skin that slides on it, and how a press displaces the skin."""

    give_um: tuple[float, float]  # displacement of robot arm and skin along x and y due to a press
    away_um_mm: Annotated[float, Field(ge=0, le=100)]  # displacement towards the centre, per distance from the centre
    lets_go_mm2: Annotated[float, Field(gt=0, le=1e6)]  # force / Young's modulus above which `away_um_mm` has no effect
    springs_N_mm: Annotated[float, Field(gt=0, le=1e6)]  # lateral stiffness of the base: screws, clips, friction
    friction: Annotated[float, Field(gt=0, le=10)]  # coefficient between tip and skin

    def in_si(self) -> "Hold":
        """Convert to SI units."""
        return Hold(
            give_m=(self.give_um[0] * micro, self.give_um[1] * micro),
            away=self.away_um_mm * micro / milli,
            lets_go_m2=self.lets_go_mm2 * milli**2,
            springs_N_per_m=self.springs_N_mm * kilo,
            friction=self.friction,
        )


@dataclass(frozen=True)
class Hold:
    """`HoldDesign` in SI units."""

    give_m: tuple[float, float]
    away: float
    lets_go_m2: float
    springs_N_per_m: float
    friction: float

    @property
    def grip_N_per_m(self) -> float:
        """Normal force per displacement that is needed to move the skin by friction: k / mu; infinite if mu is 0."""
        return self.springs_N_per_m / self.friction if self.friction > 0 else np.inf


@dataclass(frozen=True)
class RigidMotion:
    """Rigid motion of a skin for n indentations: a rotation about the skin's centre, then a translation."""

    move_m: Float[np.ndarray, "n 2"]
    spin_rad: Float[np.ndarray, " n"]

    def scaled(self, share: Float[np.ndarray, " n"]) -> "RigidMotion":
        """Return each motion multiplied by a factor."""
        return RigidMotion(self.move_m * share[:, None], self.spin_rad * share)


def press_displacement_m(
    places_m: Float[np.ndarray, "n 2"], load: Float[np.ndarray, " n"], *, give_m: tuple[float, float], away: float
) -> Float[np.ndarray, "n 2"]:
    """Return the displacement of the material under a tip that does not slip: give - away (1 - load) p.

    p is the place relative to the skin's centre. The term with `away` displaces the material towards the centre. `load`
    is the force divided by the force at which this term vanishes. A light press causes only a fraction of this
    displacement (see `limit_by_friction`).
    """
    return np.array(give_m) - away * (1 - load)[:, None] * places_m


def limit_by_friction(motion: RigidMotion, force_N: Float[np.ndarray, " n"], grip_N_per_m: float) -> RigidMotion:
    """Reduce rigid motions to those that Coulomb friction can cause at these normal forces F.

    A displacement u of the skin needs the lateral force k |u|, where k is the stiffness of the base's springs, but
    friction exerts at most mu F. The motion is therefore multiplied by 1 - exp(-mu F / (k |u|)). With this factor, the
    lateral force is always below mu F, and the motion is complete for a strong press. `grip_N_per_m` is k / mu.
    """
    with np.errstate(invalid="ignore"):  # inf * 0 is NaN, if both motion and friction are 0
        needed_N = grip_N_per_m * np.hypot(*motion.move_m.T)
    moves = needed_N > 0
    with np.errstate(over="ignore"):  # the quotient is infinite if the motion is so small that any force suffices
        share = np.where(moves, -np.expm1(-force_N / np.where(moves, needed_N, 1.0)), 0.0)
    return motion.scaled(share)


def compliance_m_per_N(
    places_m: Float[np.ndarray, "n 2"], sides_m: tuple[float, float], springs_N_per_m: float
) -> Float[np.ndarray, "n 2 2"]:
    """Return the displacement of the skin at each place per lateral force at the same place.

    The compliance matrix is (I + q q^T / rho^2) / k, with q and rho as in `rigid_motion` and k = `springs_N_per_m`.
    """
    q_m = np.stack([-places_m[:, 1], places_m[:, 0]], axis=1)
    rotational = q_m[:, :, None] * q_m[:, None, :] / _rho2_m2(sides_m)
    return (np.eye(2) + rotational) / springs_N_per_m


def rigid_motion(
    places_m: Float[np.ndarray, "n 2"], displacement_m: Float[np.ndarray, "n 2"], sides_m: tuple[float, float]
) -> RigidMotion:
    """For each place, return the rigid motion with the least elastic energy of the base that displaces the place by D.

    D is `displacement_m`. A rigid motion displaces the point X by u(X) = f + theta z x X, where z is the unit vector
    along z. The condition is u(p) = D at the place p. The solution is f = (I + q q^T / rho^2)^-1 D and theta = q.f /
    rho^2, where q = z x p. The length rho is given by rho^2 = (a^2 + b^2) / 12, the mean of r^2 over a skin with sides
    a and b.
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
    """Return dipoles after motion `i`: rotate positions (about `centre_m`) and moments, then translate positions."""
    positions_m, moments_A_m2 = (part.T.copy() for part in dipoles)
    apply_in_place(motion, i, (positions_m.T, moments_A_m2.T), centre_m)
    return positions_m.T, moments_A_m2.T


def apply_in_place(
    motion: RigidMotion,
    i: int,
    dipoles: Dipoles,
    centre_m: Float[np.ndarray, "2"] = CENTRE_M,
) -> None:
    """Apply motion `i` as in `apply`, but overwrite the arrays, which is faster for thousands of dipoles."""
    positions_m, moments_A_m2 = dipoles
    cos, sin = float(np.cos(motion.spin_rad[i])), float(np.sin(motion.spin_rad[i]))
    (x_m, y_m), (centre_x_m, centre_y_m) = motion.move_m[i], centre_m
    # A point X moves to R (X - centre) + centre + move, with the rotation matrix R.
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
    depth_m: Float[np.ndarray, " n"], *, modulus_Pa: float, thickness_m: float, tip_radius_m: float
) -> Float[np.ndarray, " n"]:
    """Return the normal force in N at each depth: the force of the slipping elastic layer times `stiffening`."""
    elastic_N = layer.force(
        depth_m, thickness_m=thickness_m, tip_radius_m=tip_radius_m, modulus_Pa=modulus_Pa, base="slipping"
    )
    return elastic_N * stiffening(depth_m, thickness_m)


def stiffening(depth_m: Float[np.ndarray, " n"], thickness_m: float) -> Float[np.ndarray, " n"]:
    """Return the factor (1 - d/h)^(-3/2) by which a layer stiffens at depth d, for normal forces and for shear."""
    return (1 - np.maximum(depth_m, 0.0) / thickness_m) ** -STIFFENING


def count_clipped(
    force_N: Float[np.ndarray, " n"], *, modulus_Pa: float, thickness_m: float, tip_radius_m: float
) -> int:
    """Count the forces that are larger than the force at the greatest depth of `depth_at`."""
    deepest_m = np.array([_deepest_m(thickness_m, tip_radius_m)])
    deepest_N = force_at(deepest_m, modulus_Pa=modulus_Pa, thickness_m=thickness_m, tip_radius_m=tip_radius_m)
    return int((force_N > deepest_N).sum())


def depth_at(
    force_N: Float[np.ndarray, " n"], *, modulus_Pa: float, thickness_m: float, tip_radius_m: float
) -> Float[np.ndarray, " n"]:
    """Return the depth in m for each normal force, clipped to `DEEPEST` thicknesses (see `count_clipped`)."""
    if not modulus_Pa > 0:
        raise ParamsError("layer", "modulus", "above 0 Pa", f"{modulus_Pa}", "Check its unit.")
    curve_m, curve_m2 = _curve(thickness_m, tip_radius_m)
    relative_m2 = np.maximum(force_N, 0.0) / modulus_Pa  # a negative force is treated as 0
    return np.interp(np.cbrt(relative_m2**2), curve_m2, curve_m)


def _deepest_m(thickness_m: float, tip_radius_m: float) -> float:
    """Return the greatest depth of `depth_at`: `DEEPEST` thicknesses, or slightly less than the tip radius."""
    return min(DEEPEST * thickness_m, 0.999 * tip_radius_m)


@lru_cache(maxsize=64)
def _curve(thickness_m: float, tip_radius_m: float) -> tuple[Float[np.ndarray, " c"], Float[np.ndarray, " c"]]:
    # Return depths in m, and (F / E)^(2/3) at these depths.
    curve_m = np.linspace(0, _deepest_m(thickness_m, tip_radius_m), CURVE_N)
    known_m2 = force_at(curve_m, modulus_Pa=1.0, thickness_m=thickness_m, tip_radius_m=tip_radius_m)
    return curve_m, np.cbrt(known_m2**2)


def _rho2_m2(sides_m: tuple[float, float]) -> float:
    return (sides_m[0] ** 2 + sides_m[1] ** 2) / 12

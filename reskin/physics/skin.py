"""Magnetised skins: their design, random skins, and the field change and the force due to indentations.

All values are in SI units. The random generator of each skin is seeded by the name of the skin. If a simulation is
extended by one skin, the other skins therefore stay the same.

An indentation is given by x, y and depth in the coordinate system of the board. The place (x, y) is the true place of
the tip. The depth is the commanded depth, which differs from the true depth by a constant error for each skin
(`Skin.depth_zero_m`).
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float
from pydantic import Field, model_validator
from scipy.constants import kilo, milli

from reskin.config import Strict
from reskin.display import one_line
from reskin.errors import ParamsError
from reskin.physics import deformation, layer, magnet, slide
from reskin.physics.board import Board, Spreads
from reskin.physics.magnet import DEFAULT_QUADRATURE, SKIN_SIDES_M, Dipoles, Quadrature, change_of_field, place_nodes
from reskin.seeds import rng_for

FILLER_WAVES_N = 64  # number of random plane waves in the local variation of the magnetisation (see `_filler`)


class SkinDesign(Strict):
    """Section `skin` of the settings: the design of all skins of a scene, and the tip that presses them."""

    polarity: magnet.Polarity
    # Whether the magnetisation is reversed. For a checkerboard skin, this is the same as a rotation by 90 degrees.
    flipped: bool
    base: layer.Base  # whether the skin is bonded to its base or slips on it
    # How a finite skin slides on its base. If this is None, the skin is an infinite layer that does not slide.
    hold: slide.HoldDesign | None
    saturation_T: Annotated[float, Field(ge=0, le=1)]  # volume fraction times remanence of the powder
    half_field_T: Annotated[float, Field(gt=0, le=10)]  # field that magnetises the powder to half of saturation_T
    thickness_mm: Annotated[float, Field(gt=0, le=20)]
    modulus_kPa: Annotated[float, Field(ge=0, le=1e6)]
    stiffening: Annotated[float, Field(ge=0, le=5)]  # exponent of `slide.stiffening_factor`; 0 is linear elastic
    tip_radius_mm: Annotated[float, Field(gt=0, le=50)]

    @model_validator(mode="after")
    def _check_hold(self) -> "SkinDesign":
        if self.hold is not None and self.base == "bonded":
            raise ValueError("hold must be null for a bonded skin; it applies only to base: slipping")
        return self


@dataclass(frozen=True)
class Skin:
    """One skin on its board, without contact.

    The magnetisation of the skin is represented by s dipoles. All positions are in the coordinate system of the board.
    """

    name: str
    nodes_m: Float[np.ndarray, "s 3"]  # positions of the dipoles
    moments_A_m2: Float[np.ndarray, "s 3"]
    seat_m: Float[np.ndarray, " 2"]  # x and y of the skin's centre
    sides_m: tuple[float, float]
    thickness_m: float
    modulus_Pa: float
    stiffening: float
    tip_radius_m: float
    depth_zero_m: float  # true depth minus commanded depth
    base: layer.Base
    hold: slide.Hold | None = None

    __repr__ = one_line


def draw_skin(
    design: SkinDesign,
    spreads: Spreads,
    *,
    seed: int,
    name: str,
    rule: Quadrature = DEFAULT_QUADRATURE,
    sides_m: tuple[float, float] = SKIN_SIDES_M,
) -> Skin:
    """Draw a skin on its board at random, with a generator that is seeded by `seed` and `name`.

    The quadrature rule affects only how the skin is divided into cells, but not the random numbers. Therefore, skins
    that differ only in `rule` approximate the same continuous skin. The magnetising array has as many cubes as are
    needed to cover a skin with the given sides.
    """
    rng = rng_for(seed, "skin", name)
    amplitude, thickness, modulus = np.exp(
        np.array([spreads.skin_amplitude, spreads.skin_thickness, spreads.skin_modulus]) * rng.standard_normal(3)
    )
    seat_m = spreads.skin_seat_mm * milli * rng.standard_normal(2)
    depth_zero_mm = spreads.skin_depth_zero_mm * rng.standard_normal()
    rotation_rad = np.deg2rad(spreads.skin_rotation_deg) * rng.standard_normal()
    thickness_m = float(design.thickness_mm * milli * thickness)
    rest = place_nodes(thickness_m, rule, sides_m=sides_m)
    cubes_n = (magnet.cubes_along(sides_m[0]), magnet.cubes_along(sides_m[1]))
    b_T = magnet.array_field(rest.nodes_m, thickness_m, design.polarity, cubes_n=cubes_n)
    j_T = magnet.magnetise(b_T, saturation_T=amplitude * design.saturation_T, half_field_T=design.half_field_T)
    strength = _filler(rest.nodes_m[:, :2], spreads, rng) * (-1 if design.flipped else 1)
    at_rest = rest.nodes_m, magnet.moments(j_T * strength[:, None], rest.volumes_m3)
    seated = slide.RigidMotion(seat_m[None], np.array([rotation_rad]))
    nodes_m, moments_A_m2 = slide.apply(seated, 0, at_rest)
    hold = None if design.hold is None else _draw_hold(design.hold, spreads, rng)
    modulus_Pa = float(design.modulus_kPa * kilo * modulus)
    return Skin(
        name=name,
        nodes_m=nodes_m,
        moments_A_m2=moments_A_m2,
        seat_m=seat_m,
        sides_m=sides_m,
        thickness_m=thickness_m,
        modulus_Pa=modulus_Pa,
        stiffening=design.stiffening,
        tip_radius_m=design.tip_radius_mm * milli,
        depth_zero_m=float(depth_zero_mm * milli),
        base=design.base,
        hold=hold,
    )


def _draw_hold(nominal: slide.HoldDesign, spreads: Spreads, rng: np.random.Generator) -> slide.Hold:
    give_x_um, give_y_um = nominal.give_um + spreads.skin_give_um * rng.standard_normal(2)
    away_um_mm = nominal.away_um_mm + spreads.skin_away_um_mm * rng.standard_normal()
    # The check of the settings is for nominal skins. On a single skin, the displacement may be away from the centre.
    drawn = {"give_um": (float(give_x_um), float(give_y_um)), "away_um_mm": float(away_um_mm)}
    return nominal.model_copy(update=drawn).in_si()


def changes_of_field(
    board: Board, skin: Skin, indentations_m: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "n k 3"]]:
    """Return the no-load field in T at the chips, and the field change in T for each indentation (x, y, depth).

    If the true depth of an indentation is 0 or less, the tip does not touch the skin, and the field change is exactly
    zero.

    Raises
    ------
    ParamsError
        If an indentation is outside the skin or too deep.
    """
    # The no-load field is computed for one chip at a time to limit the use of memory, because for a large skin on many
    # chips, there are millions of pairs of a node and a chip.
    rest_T = np.concatenate([magnet.field(skin.nodes_m, skin.moments_A_m2, chip_m[None]) for chip_m in board.chips_m])
    changes_T = np.zeros((len(indentations_m), *board.chips_m.shape))
    for indentation_i, before, after in moved_dipoles(skin, indentations_m):
        changes_T[indentation_i] = change_of_field(before, after, board.chips_m)
    return rest_T, changes_T


def moved_dipoles(
    skin: Skin, indentations_m: Float[np.ndarray, "n 3"], slid: Float[np.ndarray, " n"] | None = None
) -> Iterator[tuple[int, Dipoles, Dipoles]]:
    """Yield the dipoles that each indentation moves; skip indentations that do not touch the skin.

    Parameters
    ----------
    skin : the skin
    indentations_m : x, y and depth of each indentation
    slid : factor by which the rigid motion of the skin is multiplied for each indentation; 1 by default

    Yields
    ------
    The index of the indentation, the moved dipoles before the indentation, and the same dipoles during the indentation.
    The caller may displace these dipoles further before it calls `change_of_field`.
    """
    true_m = indentations_m + np.array([0.0, 0.0, skin.depth_zero_m])
    _check_on_skin(true_m, skin)
    contacts = np.flatnonzero(~(true_m[:, 2] <= 0))  # includes NaN depths, for which `tabulate` raises an error
    if not contacts.size:
        return
    rest = deformation.group_by_height(skin.nodes_m, skin.moments_A_m2, skin.thickness_m)
    deepest_m = float(np.max(true_m[:, 2]))
    table = deformation.tabulate(skin.thickness_m, skin.tip_radius_m, deepest_m, heights=rest.heights, base=skin.base)
    slides = None if skin.hold is None else press_motion(skin, skin.hold, true_m[contacts])
    if slides is not None and slid is not None:
        slides = slides.scaled(slid[contacts])
    for i, indentation_i in enumerate(contacts):
        moved = deformation.move_dipoles(table, rest, true_m[indentation_i])
        if slides is not None:
            slide.apply_in_place(slides, i, moved.after, skin.seat_m)
        yield int(indentation_i), moved.before, moved.after


def press_motion(skin: Skin, hold: slide.Hold, true_m: Float[np.ndarray, "n 3"]) -> slide.RigidMotion:
    """Return the rigid motion of the skin on its base due to each press, which is given by x, y and the true depth.

    The motion is first computed as if the tip did not slip on the skin. It is then limited to the motion that the
    friction between tip and skin can cause. Both depend on the force of the press.
    """
    places_m = true_m[:, :2] - skin.seat_m
    force_N = _forces_at(skin, true_m[:, 2])
    load = np.minimum(force_N / hold.lets_go_N, 1.0)
    displacement_m = slide.press_displacement_m(places_m, load, give_m=hold.give_m, away=hold.away)
    whole = slide.rigid_motion(places_m, displacement_m, skin.sides_m)
    return slide.limit_by_friction(whole, force_N, hold.grip_N_per_m)


def count_beyond_verified(skin: Skin, depth_m: Float[np.ndarray, " n"]) -> int:
    """Count the commanded depths beyond the range in which the published solution was verified.

    See `layer.VERIFIED_DEPTH`.
    """
    return int((depth_m + skin.depth_zero_m >= layer.VERIFIED_DEPTH * skin.thickness_m).sum())


def forces(skin: Skin, depth_m: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Return the normal force in N between tip and skin at each commanded depth; a force is never negative.

    The force is that of a layer that is bonded to its base, or slips on it if the skin has `base: slipping` but no
    `hold`, times `slide.stiffening_factor`. The material of a skin with `hold` moves as in a slipping layer; its force
    assumes that the friction under the tip holds the base.
    """
    return _forces_at(skin, depth_m + skin.depth_zero_m)


def _forces_at(skin: Skin, true_m: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    return slide.force_at(
        true_m,
        modulus_Pa=skin.modulus_Pa,
        thickness_m=skin.thickness_m,
        tip_radius_m=skin.tip_radius_m,
        stiffening=skin.stiffening,
        base=skin.base if skin.hold is None else "bonded",
    )


def shear_moduli_Pa(skin: Skin, depth_m: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Return the shear modulus in Pa of the layer under the tip at each commanded depth.

    The shear modulus of an incompressible material is E / 3, where E is Young's modulus. The result includes the
    stiffening of the layer (see `slide.stiffening_factor`).
    """
    factor = slide.stiffening_factor(depth_m + skin.depth_zero_m, skin.thickness_m, skin.stiffening)
    return skin.modulus_Pa / 3 * factor


def _check_on_skin(indentations_m: Float[np.ndarray, "n 3"], skin: Skin) -> None:
    # The model of the deformation assumes an infinite layer. For a press beyond the skin's edge, it would therefore
    # return a result that is wrong but looks plausible.
    half_m = np.array(skin.sides_m) / 2
    outside = ~(np.abs(indentations_m[:, :2] - skin.seat_m) <= half_m).all(axis=1)
    if outside.any():
        x_mm, y_mm = indentations_m[np.argmax(outside), :2] / milli
        rule = "on the skin, within {:.4g} and {:.4g} mm of its centre along x and y".format(*half_m / milli)
        remedy = "Choose a place on the skin, or reduce skin_seat_mm, the random offset of the skin."
        raise ParamsError(f"skin {skin.name}", "poke", rule, f"({x_mm:.3g}, {y_mm:.3g}) mm", remedy)


def _filler(xy_m: Float[np.ndarray, "s 2"], spreads: Spreads, rng: np.random.Generator) -> Float[np.ndarray, " s"]:
    # Return the local variation of the magnetisation: a random factor at each place, which varies smoothly. It is the
    # exponential of a sum of random plane waves. The waves do not depend on the places, so that the factor at a place
    # is the same for all quadrature rules.
    waves = rng.standard_normal((FILLER_WAVES_N, 2)) / (spreads.skin_filler_length_mm * milli)
    phases = rng.uniform(0, 2 * np.pi, FILLER_WAVES_N)
    uneven = np.sqrt(2 / FILLER_WAVES_N) * np.cos(xy_m @ waves.T + phases).sum(axis=1)
    return np.exp(spreads.skin_filler * uneven)

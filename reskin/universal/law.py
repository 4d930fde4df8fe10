"""The law of a skin: a physical simulation that gives the field change of a press at any place with any force.

The simulation has parameters, such as the gap between skin and chips, which differ between skins. Units are uT, mm and
N, unless a name states another one.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Annotated

import numpy as np
from jaxtyping import Bool, Float
from pydantic import Field
from scipy.constants import kilo, mega, micro, milli
from scipy.spatial.transform import Rotation

from reskin.config import Strict
from reskin.physics import deformation, magnet, slide
from reskin.physics.magnet import Quadrature, change_of_field, place_nodes
from reskin.physics.skin import SkinDesign

MARGIN_MM = 0.4  # width of a margin around the area of presses; places in the margin count as inside the area
# The paper's grid is an octagon about the centre. |x| and |y| are at most `HALF_MM`, and |x| + |y| is at most
# `CORNER_MM`.
HALF_MM, CORNER_MM = 8.0, 12.0

Length = Annotated[float, Field(gt=0, le=200)]


class Area(Strict):
    """The area in which a skin is pressed: a rectangle or an octagon around the board's centre.

    `half_x_mm` and `half_y_mm` are the largest |x| and |y|. If `octagon` is set, the corners of the rectangle are cut
    off so that the area has the proportions of the paper's grid: |x| / half_x_mm + |y| / half_y_mm is at most 1.5.
    """

    half_x_mm: Length
    half_y_mm: Length
    octagon: bool

    @property
    def half_mm(self) -> Float[np.ndarray, "2"]:
        """Largest |x| and largest |y| of the area, without the margin around it."""
        return np.array([self.half_x_mm, self.half_y_mm])


def inside(place_mm: Float[np.ndarray, "n 2"], area: Area) -> Bool[np.ndarray, " n"]:
    """Return whether each place is within an area or in the margin around it.

    Places are relative to the board's centre.
    """
    x_mm, y_mm = np.abs(place_mm).T
    within = (x_mm <= area.half_x_mm + MARGIN_MM) & (y_mm <= area.half_y_mm + MARGIN_MM)
    if not area.octagon:
        return within
    scaled_mm = x_mm * (HALF_MM / area.half_x_mm) + y_mm * (HALF_MM / area.half_y_mm)
    return within & (scaled_mm <= CORNER_MM + 1.5 * MARGIN_MM)


# The field of a skin is an integral over its volume, which is computed with a quadrature rule. This is the same rule as
# in scene `quick`: the cheapest rule whose error is below 2 % of the field change (experiment `accuracy_and_cost`).
RULE = Quadrature(cell_m=0.8e-3, layers_n=5)
# A cheaper rule, with which the skins for training networks are simulated. Its error is smaller than the error of the
# law, which is the difference between the law and real skins.
COARSE = Quadrature(cell_m=1.0e-3, layers_n=4)


@dataclass(frozen=True)
class Law:
    """Parameters of one skin on its board.

    The first seven parameters differ between the boards of a rig. The others are the same for all of its boards.
    """

    seat_x_mm: float  # the skin's centre relative to the board's centre
    seat_y_mm: float
    rotation_deg: float  # rotation of the skin about z
    # Distance from the chips to the skin. A fit determines well only a combination of gap and amplitude, because a
    # larger gap and a larger amplitude have opposite effects.
    gap_mm: float
    amplitude: float  # magnetisation of the skin relative to the nominal magnetisation
    label_x_mm: float  # true place of the tip minus the place that its label states, along the board's axes
    label_y_mm: float
    modulus_MPa: float  # Young's modulus of the skin
    # A press displaces the skin towards the centre of the skin, by this number of um per mm of distance between the
    # press and the centre. This displacement and the following one are called the slide of the skin.
    away_um_mm: float
    # Under a press, the rig gives way. This displaces the skin by this vector, which is the same at all places.
    give_x_um: float
    give_y_um: float
    # The following parameters are neither in `TEN` nor in `SEVEN`.
    # The displacement `away_um_mm` decreases with the force of the press, and vanishes at this force. The value was
    # chosen on both boards of scene lab.
    lets_go_N: float = 8.0
    # Exponent by which the force grows as the layer becomes thinner (`slide.stiffening_factor`): mean of the fits to
    # both boards of scene lab with forces up to 9.5 N, weighted by their uncertainties (docs/synthetic-skin.md).
    stiffening: float = 1.2
    # Lateral stiffness (7 N/mm) divided by the friction coefficient (0.8), both from nominal.yaml, key skin.hold. It
    # limits the slide under a light press, because friction can then cause only a part of the displacement.
    grip_N_mm: float = 8.75
    tilt_x_deg: float = 0.0  # tilt of the skin relative to the board
    tilt_y_deg: float = 0.0
    label_rotation_deg: float = 0.0  # rotation of the labels' axes about the board's centre


@dataclass(frozen=True)
class Setup:
    """What all boards of a scene share: nominal skin, positions of the chips, tip and area of presses."""

    design: SkinDesign
    chips_mm: Float[np.ndarray, "k 2"]
    skin_mm: tuple[float, float]
    skin_flipped: bool  # whether all fields have the opposite sign, as if a checkerboard skin were turned by 90°
    tip_radius_mm: float
    rule: Quadrature
    coarse_rule: Quadrature
    area: Area

    @property
    def sides_m(self) -> tuple[float, float]:
        return self.skin_mm[0] * milli, self.skin_mm[1] * milli

    @property
    def thickness_m(self) -> float:
        return self.design.thickness_mm * milli

    @cached_property
    def rest(self) -> deformation.RestingDipoles:
        """Dipoles that represent the magnetised skin without deformation. The centre of the skin is at the origin."""
        nodes = place_nodes(self.thickness_m, self.rule, sides_m=self.sides_m)
        cubes_n = (magnet.cubes_along(self.sides_m[0]), magnet.cubes_along(self.sides_m[1]))
        b_T = magnet.array_field(nodes.nodes_m, self.thickness_m, self.design.polarity, cubes_n=cubes_n)
        j_T = magnet.magnetise(b_T, saturation_T=self.design.saturation_T, half_field_T=self.design.half_field_T)
        sign = -1 if self.skin_flipped else 1
        return deformation.group_by_height(
            nodes.nodes_m, sign * magnet.moments(j_T, nodes.volumes_m3), self.thickness_m
        )

    def table(self) -> deformation.DeformationMap:
        """Tabulate the deformation of a skin that slips on its base.

        The table covers all depths up to `slide.DEEPEST` times the thickness.
        """
        deepest_m = slide.DEEPEST * self.thickness_m
        heights = self.rest.heights
        return deformation.tabulate(
            self.thickness_m, self.tip_radius_mm * milli, deepest_m, heights=heights, base="slipping"
        )

    def chips_under(self, law: Law) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "3 3"]]:
        """Return the chips' positions in m in the skin's frame, and the rotation matrix from skin to board."""
        angles_deg = [law.rotation_deg, law.tilt_y_deg, law.tilt_x_deg]
        turn = Rotation.from_euler("zyx", angles_deg, degrees=True).as_matrix()
        seat_mm = (law.seat_x_mm, law.seat_y_mm)
        chips_mm = np.column_stack([self.chips_mm - seat_mm, np.full(len(self.chips_mm), -law.gap_mm)])
        return chips_mm @ turn * milli, turn


def at_rest_uT(law: Law, setup: Setup, rest: deformation.RestingDipoles | None = None) -> Float[np.ndarray, "k 3"]:
    """Return the field of the untouched skin at the chips, along the board's axes.

    `rest` has the same meaning as in `simulate_uT`.
    """
    chips_m, turn = setup.chips_under(law)
    rest = rest or setup.rest
    field_T = magnet.field(rest.nodes_m, rest.moments_A_m2, chips_m)
    return law.amplitude * field_T @ turn.T / micro


def simulate_uT(
    law: Law,
    setup: Setup,
    place_mm: Float[np.ndarray, "n 2"],
    force_N: Float[np.ndarray, " n"],
    rest: deformation.RestingDipoles | None = None,
) -> Float[np.ndarray, "n k 3"]:
    """Return the field changes that presses cause at the chips, along the board's axes.

    `place_mm` and `force_N` are the labels of the presses. The offset and the rotation of the labels, which are
    parameters of the law, convert labelled places to true places. If `rest` is given, its dipoles replace the dipoles
    of the setup, for example to simulate a skin with uneven filler. They must be at the same nodes.
    """
    chips_m, turn = setup.chips_under(law)
    offset_mm = (law.label_x_mm - law.seat_x_mm, law.label_y_mm - law.seat_y_mm)
    labels = Rotation.from_euler("z", law.label_rotation_deg, degrees=True).as_matrix()[:2, :2]
    places_m = (place_mm @ labels.T + offset_mm) @ turn[:2, :2] * milli
    depths_m = slide.depth_at(force_N, **_layer(law, setup))
    give_m, away = (law.give_x_um * micro, law.give_y_um * micro), law.away_um_mm * micro / milli
    displacement_m = slide.press_displacement_m(places_m, force_N / law.lets_go_N, give_m=give_m, away=away)
    whole = slide.rigid_motion(places_m, displacement_m, setup.sides_m)
    slides = slide.limit_by_friction(whole, force_N, law.grip_N_mm * kilo)
    table, rest = setup.table(), rest or setup.rest
    changes_T = np.empty((len(places_m), *chips_m.shape))
    for press_i, (place_m, depth_m) in enumerate(zip(places_m, depths_m, strict=True)):
        moved = deformation.move_dipoles(table, rest, np.append(place_m, depth_m))
        slide.apply_in_place(slides, press_i, moved.after)
        changes_T[press_i] = change_of_field(moved.before, moved.after, chips_m)
    return law.amplitude * changes_T @ turn.T / micro


def beyond_n(law: Law, setup: Setup, force_N: Float[np.ndarray, " n"]) -> int:
    """Count the presses whose force is too large to be simulated with a law."""
    return slide.count_clipped(force_N, **_layer(law, setup))


def _layer(law: Law, setup: Setup) -> dict[str, float]:
    return {
        "modulus_Pa": law.modulus_MPa * mega, "thickness_m": setup.thickness_m,
        "tip_radius_m": setup.tip_radius_mm * milli, "stiffening": law.stiffening,
    }  # fmt: skip

"""The law of a skin: a simulation with eleven fitted parameters that gives the field change for any place and force.

This module also fits the law to the presses of one board. Units: uT, mm, N.
"""

from dataclasses import asdict, dataclass
from functools import cache, cached_property

import numpy as np
from jaxtyping import Bool, Float
from scipy.constants import kilo, mega, micro, milli
from scipy.linalg import block_diag
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from reskin.physics import deformation, layer, magnet, slide
from reskin.physics.magnet import Quadrature, change_of_field, place_nodes
from reskin.physics.skin import SkinDesign
from reskin.universal.presses import RecordedPresses, magnitudes_uT

MARGIN_MM = 0.4  # width of the margin around the area of presses
HALF_MM, CORNER_MM = 8.0, 12.0  # largest |x| or |y| and largest |x| + |y| of the paper's grid


@dataclass(frozen=True)
class Area:
    """The places that are pressed: a rectangle around the board's centre, without its corners if `octagon` is set.

    The octagon has the proportions of the paper's grid: |x| / half_x_mm + |y| / half_y_mm is at most 1.5.
    """

    half_x_mm: float = HALF_MM
    half_y_mm: float = HALF_MM
    octagon: bool = True

    @property
    def half_mm(self) -> Float[np.ndarray, "2"]:
        """Largest |x| and |y| without the margin."""
        return np.array([self.half_x_mm, self.half_y_mm])


PAPER_AREA = Area()


def inside(place_mm: Float[np.ndarray, "n 2"], area: Area = PAPER_AREA) -> Bool[np.ndarray, " n"]:
    """Return which places (relative to the board's centre) are within an area, including a margin around it."""
    x_mm, y_mm = np.abs(place_mm).T
    within = (x_mm <= area.half_x_mm + MARGIN_MM) & (y_mm <= area.half_y_mm + MARGIN_MM)
    if not area.octagon:
        return within
    scaled_mm = x_mm * (HALF_MM / area.half_x_mm) + y_mm * (HALF_MM / area.half_y_mm)
    return within & (scaled_mm <= CORNER_MM + 1.5 * MARGIN_MM)


# Quadrature rule for the skin's field, the same as in scene `quick`: the cheapest rule whose error is below 2 % of the
# field change (measured by experiment `runtime`).
RULE = Quadrature(cell_m=0.8e-3, layers_n=5)
COARSE = Quadrature(cell_m=1.0e-3, layers_n=4)  # for training networks; its error is smaller than that of the law


@dataclass(frozen=True)
class Law:
    """Parameters of one skin on its board. The first seven differ between boards; the others are the same for a rig."""

    seat_x_mm: float  # the skin's centre relative to the board's centre
    seat_y_mm: float
    rotation_deg: float  # rotation of the skin about z
    gap_mm: float  # distance from the chips to the skin; a fit determines only a combination of gap and amplitude well
    amplitude: float  # magnetisation relative to nominal
    label_x_mm: float  # true place of the tip minus its label, along the board's axes
    label_y_mm: float
    modulus_MPa: float
    away_um_mm: float  # slide of the skin under a press: um towards the centre per mm of distance from the centre
    give_x_um: float  # displacement of the rig and the skin under a press (compliance of the rig)
    give_y_um: float
    # The following parameters are not fitted.
    lets_go_N: float = 8.0  # force at which the slide `away_um_mm` vanishes; chosen on both boards of scene lab
    grip_N_mm: float = 8.75  # lateral stiffness (7 N/mm) / friction coefficient (0.8), from nominal.yaml: skin.hold
    tilt_x_deg: float = 0.0  # tilt of the skin relative to the board
    tilt_y_deg: float = 0.0
    label_rotation_deg: float = 0.0  # rotation of the labels' axes about the board's centre


@dataclass(frozen=True)
class Setup:
    """Data that all laws of a scene share: the nominal skin design, the chips' positions, the tip, and the area.

    start_law: the law at which fits start, and the mean of the fits' priors; by default `START`.
    """

    design: SkinDesign
    chips_mm: Float[np.ndarray, "k 2"]
    gap_mm: float
    skin_mm: tuple[float, float]
    skin_flipped: bool  # whether all fields have the opposite sign, as if a checkerboard skin is rotated by 90 degrees
    tip_radius_mm: float
    rule: Quadrature = RULE
    coarse_rule: Quadrature = COARSE
    area: Area = PAPER_AREA
    start_law: Law | None = None

    @property
    def start(self) -> Law:
        return self.start_law or START

    @property
    def sides_m(self) -> tuple[float, float]:
        return self.skin_mm[0] * milli, self.skin_mm[1] * milli

    @property
    def thickness_m(self) -> float:
        return self.design.thickness_mm * milli

    @cached_property
    def rest(self) -> deformation.RestingDipoles:
        """Dipoles of the magnetised, undeformed skin; the skin's centre is at the origin."""
        nodes = place_nodes(self.thickness_m, self.rule, sides_m=self.sides_m)
        cubes_n = (magnet.cubes_along(self.sides_m[0]), magnet.cubes_along(self.sides_m[1]))
        b_T = magnet.array_field(nodes.nodes_m, self.thickness_m, self.design.polarity, cubes_n=cubes_n)
        j_T = magnet.magnetise(b_T, saturation_T=self.design.saturation_T, half_field_T=self.design.half_field_T)
        sign = -1 if self.skin_flipped else 1
        return deformation.group_by_height(
            nodes.nodes_m, sign * magnet.moments(j_T, nodes.volumes_m3), self.thickness_m
        )

    def table(self, tip_radius_mm: float) -> deformation.DeformationMap:
        """Tabulate the deformation of a skin that slips on its base, for depths up to the deepest press in `slide`."""
        deepest_m = slide.DEEPEST * self.thickness_m
        heights = self.rest.heights
        return deformation.tabulate(
            self.thickness_m, tip_radius_mm * milli, deepest_m, heights=heights, base="slipping"
        )

    def chips_under(self, law: Law) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "3 3"]]:
        """Return the chips' positions in m in the skin's frame, and the rotation matrix from skin to board."""
        angles_deg = [law.rotation_deg, law.tilt_y_deg, law.tilt_x_deg]
        turn = Rotation.from_euler("zyx", angles_deg, degrees=True).as_matrix()
        seat_mm = (law.seat_x_mm, law.seat_y_mm)
        chips_mm = np.column_stack([self.chips_mm - seat_mm, np.full(len(self.chips_mm), -law.gap_mm)])
        return chips_mm @ turn * milli, turn


def at_rest_uT(law: Law, setup: Setup, rest: deformation.RestingDipoles | None = None) -> Float[np.ndarray, "k 3"]:
    """Return the field of the untouched skin at the chips, in the board's axes (`rest`: see `simulate_uT`)."""
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
    """Return the field changes at the chips, in the board's axes, for presses with these labelled places and forces.

    The law's label offset and rotation convert labelled places to true ones. `rest` replaces the setup's dipoles (at
    the same nodes), for example for a skin with uneven filler.
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
    table = setup.table(setup.tip_radius_mm)
    change_T = _changes_T(rest or setup.rest, table, chips_m, places_m, depths_m, slides)
    return law.amplitude * change_T @ turn.T / micro


def nominal_uT(
    setup: Setup, place_mm: Float[np.ndarray, "n 2"], force_N: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "n k 3"]:
    """Return the field changes of the nominal skin, which does not slide, for forces according to `physics.layer`."""
    depths_m = np.interp(force_N, *_nominal_curve(setup))
    chips_m = np.column_stack([setup.chips_mm, np.full(len(setup.chips_mm), -setup.gap_mm)]) * milli
    still = slide.RigidMotion(np.zeros(place_mm.shape), np.zeros(len(place_mm)))
    table = setup.table(setup.design.tip_radius_mm)
    return _changes_T(setup.rest, table, chips_m, place_mm * milli, depths_m, still) / micro


def beyond_n(law: Law | None, setup: Setup, force_N: Float[np.ndarray, " n"]) -> int:
    """Count presses with a force above the range of a law, or of the nominal skin if `law` is None."""
    if law is None:
        curve_N, _ = _nominal_curve(setup)
        return int((force_N > curve_N[-1]).sum())
    return slide.count_clipped(force_N, **_layer(law, setup))


def _layer(law: Law, setup: Setup) -> dict[str, float]:
    return {
        "modulus_Pa": law.modulus_MPa * mega, "thickness_m": setup.thickness_m,
        "tip_radius_m": setup.tip_radius_mm * milli,
    }  # fmt: skip


def _nominal_curve(setup: Setup) -> tuple[Float[np.ndarray, " c"], Float[np.ndarray, " c"]]:
    """Return the nominal skin's forces and depths, up to the greatest depth for which fields are tabulated."""
    curve_m = np.linspace(0, slide.DEEPEST * setup.thickness_m, slide.CURVE_N)
    curve_N = layer.force(
        curve_m, thickness_m=setup.thickness_m, tip_radius_m=setup.design.tip_radius_mm * milli,
        modulus_Pa=setup.design.modulus_kPa * kilo, base="slipping",
    )  # fmt: skip
    return curve_N, curve_m


def _changes_T(
    rest: deformation.RestingDipoles, table: deformation.DeformationMap, chips_m: np.ndarray,
    places_m: np.ndarray, depths_m: np.ndarray,
    slides: slide.RigidMotion,
) -> Float[np.ndarray, "n k 3"]:  # fmt: skip
    changes_T = np.empty((len(places_m), *chips_m.shape))
    for press_i, (place_m, depth_m) in enumerate(zip(places_m, depths_m, strict=True)):
        moved = deformation.move_dipoles(table, rest, np.append(place_m, depth_m))
        slide.apply_in_place(slides, press_i, moved.after)
        changes_T[press_i] = change_of_field(moved.before, moved.after, chips_m)
    return changes_T


def with_parameters(law: Law, names: tuple[str, ...], values: Float[np.ndarray, " p"]) -> Law:
    """Return the law with the named parameters replaced by these values."""
    return Law(**(asdict(law) | dict(zip(names, map(float, values), strict=True))))


# Assumed values for fits. START: start values, which are also the means of the priors. PRIOR: standard deviations of
# the priors. STEP: scales of the parameters.
START = Law(0.0, 0.0, 0.0, 1.5, 1.5, 0.0, 0.0, 0.2, 5.0, 0.0, 0.0)
PRIOR = Law(1.0, 1.0, 3.0, 0.4, 0.5, 1.0, 1.0, 0.25, 10.0, 60.0, 60.0)
STEP = Law(0.3, 0.3, 1.0, 0.2, 0.2, 0.4, 0.4, 0.07, 4.0, 20.0, 20.0)
OF_BOARD = ("seat_x_mm", "seat_y_mm", "gap_mm", "amplitude", "label_x_mm", "label_y_mm")
TEN = (*OF_BOARD, "modulus_MPa", "away_um_mm", "give_x_um", "give_y_um")
# Parameters that may differ between boards. If only these are fitted, the other parameters come from a fit to another
# board.
SEVEN = (*OF_BOARD, "rotation_deg")
PRIOR_WEIGHT = 0.25  # chosen on both boards of scene lab; with 0.5, one of four fits explains only 79.6 % of |dB|^2
# Weight of the residuals that compare the growth of |dB| with force. Each group of presses has one such residual: the
# group's mean error of log|dB|, minus the mean over all groups.
GROWTH_WEIGHT = 10.0
OFFSET_uT = 200.0  # standard deviation of the no-load field due to chips' offsets (spreads.chip_offset_uT)
# Maximum number of least-squares steps. The fits of scene lab need 5. A tenfold smaller ftol changes the cosine between
# simulated and recorded field changes by 0.0001.
EVALUATIONS_MAX_N = 10


@dataclass(frozen=True)
class AlignedPresses:
    """Presses on a board, with places in the board's frame and fields along the board's axes."""

    recorded: RecordedPresses
    place_mm: Float[np.ndarray, "n 2"]
    db_uT: Float[np.ndarray, "n k 3"]
    rest_uT: Float[np.ndarray, "k 3"]


def fit(presses: AlignedPresses, setup: Setup, names: tuple[str, ...], start: Law | None = None) -> Law:
    """Fit the named parameters by least squares; other parameters are those of `start` (default: `setup.start`)."""
    start = start or setup.start
    magnitude_uT = magnitudes_uT(presses.db_uT)
    counts = np.bincount(presses.recorded.group_i)
    centre, prior, step = (np.array([getattr(law, name) for name in names]) for law in (setup.start, PRIOR, STEP))

    def residuals(values: Float[np.ndarray, " p"]) -> Float[np.ndarray, " r"]:
        law = with_parameters(start, names, values)
        simulated_uT = simulate_uT(law, setup, presses.place_mm, presses.recorded.force_N)
        changes = (simulated_uT - presses.db_uT) / magnitude_uT[:, None, None]
        ratio = np.log(magnitudes_uT(simulated_uT) / magnitude_uT)
        by_group = np.bincount(presses.recorded.group_i, ratio) / counts
        rest = (at_rest_uT(law, setup) - presses.rest_uT) / OFFSET_uT
        priors = PRIOR_WEIGHT * (values - centre) / prior
        return np.concatenate([changes.ravel(), rest.ravel(), priors, GROWTH_WEIGHT * (by_group - by_group.mean())])

    first = np.array([getattr(start, name) for name in names])
    # Simulated fields have kinks at the tabulated depths. With a smaller diff_step, kinks would distort derivatives.
    result = least_squares(
        residuals, first, x_scale=step, diff_step=1e-3, ftol=1e-3, max_nfev=EVALUATIONS_MAX_N, bounds=_limits(names)
    )
    return with_parameters(start, names, result.x)


def _limits(names: tuple[str, ...]) -> tuple[list[float], list[float]]:
    # The skin must be above its chips, be magnetised, and have some stiffness.
    least = {"gap_mm": 0.3, "amplitude": 0.05, "modulus_MPa": 0.01}
    return [least.get(name, -np.inf) for name in names], [np.inf] * len(names)


# Positions and rotations of the chips on the paper's board.
CHIPS_MM = ((0.0, 0.0), (-7.0, 0.0), (0.0, -7.0), (7.0, 0.0), (0.0, 7.0))
TURNS_DEG = (0.0, 180.0, 270.0, 90.0, 0.0)


def to_board(b_uT: Float[np.ndarray, "f ch"], turns_deg: tuple[float, ...] = TURNS_DEG) -> Float[np.ndarray, "f ch"]:
    """Rotate readings from the axes of chips with these rotations to the board's axes."""
    return b_uT @ _turn(turns_deg)


def to_chips(b_uT: Float[np.ndarray, "f ch"], turns_deg: tuple[float, ...] = TURNS_DEG) -> Float[np.ndarray, "f ch"]:
    """Rotate readings from the board's axes to the axes of chips with these rotations."""
    return b_uT @ _turn(turns_deg).T


@cache
def _turn(turns_deg: tuple[float, ...]) -> Float[np.ndarray, "ch ch"]:
    of_chips = Rotation.from_euler("z", np.array(turns_deg)[:, None], degrees=True).as_matrix()
    return np.array(block_diag(*of_chips)).T

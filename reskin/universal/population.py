"""Simulated skins with random properties, and presses on each skin, for the training of networks.

The law (`reskin.universal.law`) is a simulation of a skin. The parameters of each skin are drawn around those of a
central law. Each skin also has its own thickness, tip, filler and chips, and slides in two ways, because the slide of a
real skin differs between days. The law does not describe real skins exactly, but its errors are not drawn here:
`reskin.universal.episodes` draws new errors in each training step, so that a skin never has the same field changes
twice.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np
from jaxtyping import Float, Float32
from scipy.spatial.transform import Rotation

from reskin.physics.deformation import RestingDipoles
from reskin.universal.law import (
    HALF_MM,
    Area,
    Law,
    Setup,
    at_rest_uT,
    inside,
    simulate_uT,
)

PLACES_N = 65  # number of places on the paper's grid
PRESSES_N = 2 * PLACES_N  # number of presses on each skin
# Distance between neighbouring places of the grid, and standard deviation along each axis with which presses deviate at
# random from the places of the grid.
PITCH_MM, JITTER_MM = 2.0, 0.05
ANYWHERE_SHARE = 0.5  # fraction of the second half of the presses that are anywhere on the skin, not on the grid

# Central parameters of the paper's skin. The form of the law, gap, amplitude, `away_um_mm` and `lets_go_N` come from
# the two recorded boards of scene lab. Many other pairs of gap and amplitude fit a board about equally well. The
# modulus belongs to the stiffening of `Law`; simulated scenes have another pair (nominal.yaml: 330 kPa, no stiffening).
# See `Law` for the meaning of each parameter.
NOMINAL = Law(0.0, 0.0, 0.0, 1.6, 1.5, 0.0, 0.0, 0.19, 7.0, 0.0, 0.0)
# Standard deviations of the parameters over skins; those of the parameters in LOGARITHMIC are of their logarithm. All
# are assumed, and larger than the differences between the two recorded boards.
NOMINAL_SPREADS = {
    "seat_x_mm": 0.4, "seat_y_mm": 0.4, "rotation_deg": 1.0, "gap_mm": 0.45, "amplitude": 0.3, "label_x_mm": 0.5,
    "label_y_mm": 0.5, "modulus_MPa": 0.4, "stiffening": 0.5, "away_um_mm": 2.5, "give_x_um": 40.0, "give_y_um": 40.0,
    "lets_go_N": 2.4, "tilt_x_deg": 0.7, "tilt_y_deg": 0.7, "label_rotation_deg": 0.5,
}  # fmt: skip
LOGARITHMIC = ("amplitude", "modulus_MPa")
# Parameters of the slide, which are drawn again for the second session of a skin: equal presses two days apart have
# cosines from 0.05 to 0.98 in the recordings of scene lab.
SLIDE = ("away_um_mm", "give_x_um", "give_y_um", "lets_go_N")

# Boards and skins differ in the parameters of the law, and also in the properties that the following constants
# describe. The values of these constants and the spreads of the parameters are assumed. Thickness and tip radius are
# relative to the thickness and the tip radius of the setup.
THICKNESSES = {0.9: 0.07, 0.95: 0.24, 1.0: 0.38, 1.05: 0.24, 1.1: 0.07}  # relative thickness: its probability
TIPS = {0.875: 0.25, 1.0: 0.5, 1.25: 0.25}  # relative tip radius: its probability
# Increase of the logarithm of the amplitude per mm of gap. In fits to the boards of scene lab, a larger gap comes with
# a larger amplitude, because the effects of both compensate each other.
LOG_AMPLITUDE_PER_MM = 0.95
# The magnetisation of the filler varies from place to place. Its logarithm is a sum of cosine waves with this standard
# deviation, this length scale, and this number of waves.
FILLER_SD, FILLER_MM, FILLER_WAVES_N = 0.15, 3.0, 64
# Standard deviations over chips, in this order: of the relative gain of an axis, of the cross-talk between axes, of the
# rotation of the chip about each axis, and of the offset of an axis.
GAIN_SD, CROSS_SD, CHIP_TURN_DEG, CHIP_OFFSET_uT = 0.025, 0.01, 2.0, 200.0
# Smallest values of drawn parameters. With the smallest gap, no chip is inside the skin. With the smallest value of
# `away_um_mm`, a press never displaces the skin away from its centre. With the smallest value of `lets_go_N`, this
# displacement does not vanish already at a very small force.
LEAST = {"gap_mm": 0.8, "away_um_mm": 0.0, "lets_go_N": 2.0}


@dataclass(frozen=True)
class Forces:
    """Distribution of the forces of presses.

    A fraction `light_share` of the presses is light: the logarithms of their forces are uniformly distributed between
    those of `light_N` and `least_N`. The logarithms of the other forces are uniformly distributed between those of
    `least_N` and `largest_N`.
    """

    least_N: float = 0.5
    largest_N: float = 10.0
    light_N: float = 0.05
    light_share: float = 0.0

    def draw(self, n: int, rng: np.random.Generator) -> Float[np.ndarray, " n"]:
        """Draw the forces of `n` presses."""
        force_N = np.exp(rng.uniform(np.log(self.least_N), np.log(self.largest_N), n))
        if self.light_share == 0:
            return force_N
        light_N = np.exp(rng.uniform(np.log(self.light_N), np.log(self.least_N), n))
        return np.where(rng.random(n) < self.light_share, light_N, force_N)


@dataclass(frozen=True)
class Population:
    """Simulated skins, and the same presses on each skin in two sessions, in which the skin slides differently.

    Places and fields are along the axes of the board. The first `PLACES_N` presses of each skin are on the grid, one at
    each place.
    """

    db_uT: Float32[np.ndarray, "s 2 m ch"]
    rest_uT: Float32[np.ndarray, "s ch"]
    place_mm: Float32[np.ndarray, "s m 2"]
    force_N: Float32[np.ndarray, "s m"]

    def __len__(self) -> int:
        return len(self.rest_uT)


def draw_population(
    centre: Law, spreads: Mapping[str, float], setup: Setup, skins_n: int, rng: np.random.Generator,
    forces: Forces,
) -> Population:  # fmt: skip
    """Simulate skins with parameters around those of a central law, and 130 presses on each skin in two sessions.

    The simulation takes 80 ms per skin.
    """
    own_mm = setup.design.thickness_mm
    setups = {
        (thickness, tip): replace(
            setup, design=setup.design.model_copy(update={"thickness_mm": thickness * own_mm}),
            tip_radius_mm=tip * setup.tip_radius_mm, rule=setup.coarse_rule,
        )
        for thickness in THICKNESSES
        for tip in TIPS
    }  # fmt: skip
    parts = []
    # Each skin has its own generator, so that the first skins do not depend on the number of skins.
    for skin_rng in rng.spawn(skins_n):
        law = draw_law(centre, spreads, skin_rng)
        thickness, tip = (float(skin_rng.choice(list(sizes), p=list(sizes.values()))) for sizes in (THICKNESSES, TIPS))
        slide = asdict(draw_law(centre, {name: spreads[name] for name in SLIDE if name in spreads}, skin_rng))
        laws = law, replace(law, **{name: slide[name] for name in SLIDE})
        parts.append(draw_skin(laws, setups[thickness, tip], skin_rng, forces))
    return Population(*(np.array(part, np.float32) for part in zip(*parts, strict=True)))


def draw_law(centre: Law, spreads: Mapping[str, float], rng: np.random.Generator) -> Law:
    """Draw the parameters of a skin around those of a central law.

    The amplitude is correlated with the gap (see `LOG_AMPLITUDE_PER_MM`).
    """
    law = centre
    for name, spread in spreads.items():
        law = perturb(law, name, spread * rng.standard_normal())
        if name in LEAST:
            law = replace(law, **{name: max(getattr(law, name), LEAST[name])})
    return perturb(law, "amplitude", LOG_AMPLITUDE_PER_MM * (law.gap_mm - centre.gap_mm))


def perturb(centre: Law, name: str, by: float) -> Law:
    """Add `by` to one parameter of a law, or to its logarithm if it is in `LOGARITHMIC`."""
    value = getattr(centre, name)
    return replace(centre, **{name: float(value * np.exp(by) if name in LOGARITHMIC else value + by)})


def draw_skin(
    laws: Sequence[Law], setup: Setup, rng: np.random.Generator, forces: Forces
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Simulate one skin on imperfect chips; `laws` are the laws of its sessions.

    Returns the field changes of its presses in each session, its no-load field, and the places and forces of the
    presses.
    """
    place_mm, force_N = draw_places(rng, setup.area), forces.draw(PRESSES_N, rng)
    filled = fill(setup.rest, rng)
    db_uT = np.stack([simulate_uT(law, setup, place_mm, force_N, filled) for law in laws])
    rest_uT = at_rest_uT(laws[0], setup, filled)
    chips_n = len(rest_uT)
    gain = draw_gains(chips_n, rng)
    rest_uT = np.einsum("kij,kj->ki", gain, rest_uT) + CHIP_OFFSET_uT * rng.standard_normal((chips_n, 3))
    db_uT = np.einsum("kij,snkj->snki", gain, db_uT)
    return db_uT.reshape(*db_uT.shape[:2], -1), rest_uT.ravel(), place_mm, force_N


def draw_places(rng: np.random.Generator, area: Area) -> Float[np.ndarray, "m 2"]:
    """Draw the places of the presses on one skin, in mm from the board's centre.

    The result begins with all places of the grid. It continues with about half of these places again and with places
    anywhere in the area.
    """
    grid_mm = grid(area)
    anywhere_n = int(PLACES_N * ANYWHERE_SHARE)
    repeated_mm = grid_mm[rng.permutation(PLACES_N)[anywhere_n:]]
    near_mm = np.concatenate([grid_mm, repeated_mm])
    near_mm = near_mm + JITTER_MM * rng.standard_normal(near_mm.shape)
    limit_mm = np.abs(grid_mm).max(axis=0) + 0.3
    # 85 % or more of these places are in the area, so 8 times the needed number are more than enough.
    anywhere_mm = rng.uniform(-limit_mm, limit_mm, (8 * anywhere_n, 2))
    return np.concatenate([near_mm, anywhere_mm[inside(anywhere_mm, area)][:anywhere_n]])


def grid(area: Area) -> Float[np.ndarray, "65 2"]:
    """Return the places of the paper's grid, scaled to the size of an area, in mm from the centre of the area.

    The grid has 9 x 9 places without the four places in each corner.
    """
    step = np.arange(-4, 5)
    steps = np.stack(np.meshgrid(step, step), axis=-1).reshape(-1, 2)
    return area.half_mm / HALF_MM * PITCH_MM * steps[np.abs(steps).min(axis=1) <= 2].astype(float)


def fill(rest: RestingDipoles, rng: np.random.Generator) -> RestingDipoles:
    """Make the filler of a skin uneven.

    The magnetic moments are multiplied by a random factor, which has a log-normal distribution and varies smoothly with
    x and y.
    """
    waves_per_m = rng.standard_normal((2, FILLER_WAVES_N)) / (FILLER_MM * 1e-3)
    phase = rng.uniform(0, 2 * np.pi, FILLER_WAVES_N)
    waves = np.cos(rest.nodes_m[:, :2] @ waves_per_m + phase).sum(axis=1) * np.sqrt(2 / FILLER_WAVES_N)
    return replace(rest, moments_A_m2=np.asfortranarray(rest.moments_A_m2 * np.exp(FILLER_SD * waves)[:, None]))


def draw_gains(chips_n: int, rng: np.random.Generator) -> Float[np.ndarray, "k 3 3"]:
    """Draw the response matrix of each chip, which converts the true field to the field that the chip measures.

    It contains random gains of the axes, cross-talk between axes, and a rotation of the chip on its board.
    """
    gain = np.exp(GAIN_SD * rng.standard_normal((chips_n, 3)))[:, :, None] * np.eye(3)
    gain = gain + CROSS_SD * rng.standard_normal((chips_n, 3, 3))
    return gain @ Rotation.from_rotvec(CHIP_TURN_DEG * rng.standard_normal((chips_n, 3)), degrees=True).as_matrix()

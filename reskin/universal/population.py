"""Simulated skins with random properties, and presses on each skin, for the training of networks.

The law (`reskin.universal.law`) is a simulation of a skin. The parameters of each skin are drawn around those of a
central law. Each skin also has its own thickness, tip, filler and chips. The law does not describe real skins exactly,
but its errors are not drawn here: `reskin.universal.batches` draws new errors in each training step, so that a skin
never has the same field changes twice.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Float32
from scipy.spatial.transform import Rotation

from reskin.physics.deformation import RestingDipoles
from reskin.universal.law import HALF_MM, PAPER_AREA, Area, Law, Setup, at_rest_uT, inside, simulate_uT
from reskin.universal.map import LOGARITHMIC, perturb

PLACES_N = 65  # number of places on the paper's grid; a network is conditioned on at most this number of presses
PRESSES_N = 2 * PLACES_N  # number of presses on each skin: the first half is for conditioning, the second for training
# Distance between neighbouring places of the grid, and standard deviation along each axis with which presses deviate at
# random from the places of the grid.
PITCH_MM, JITTER_MM = 2.0, 0.05
ANYWHERE_SHARE = 0.5  # fraction of the presses for training that are anywhere on the skin; the others are on the grid

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
    `least_N` and `largest_N`. If `weight_N` is given, each skin has one additional press at the centre with this force.
    """

    least_N: float = 0.5
    largest_N: float = 10.0
    weight_N: float | None = None
    light_N: float = 0.05
    light_share: float = 0.0

    def draw(self, n: int, rng: np.random.Generator) -> Float[np.ndarray, " n"]:
        """Draw the forces of `n` presses."""
        force_N = np.exp(rng.uniform(np.log(self.least_N), np.log(self.largest_N), n))
        if self.light_share == 0:
            return force_N
        light_N = np.exp(rng.uniform(np.log(self.light_N), np.log(self.least_N), n))
        return np.where(rng.random(n) < self.light_share, light_N, force_N)


DEFAULT_FORCES = Forces(light_share=0.2)


@dataclass(frozen=True)
class Population:
    """Simulated skins, and the presses on each skin. Places and fields are along the axes of the board.

    The first `PLACES_N` presses of each skin are on the grid, one at each place.
    """

    db_uT: Float32[np.ndarray, "s m ch"]
    rest_uT: Float32[np.ndarray, "s ch"]
    place_mm: Float32[np.ndarray, "s m 2"]
    force_N: Float32[np.ndarray, "s m"]

    def __len__(self) -> int:
        return len(self.rest_uT)


def draw_population(
    centre: Law, spreads: Mapping[str, float], setup: Setup, skins: int | slice, rng: np.random.Generator,
    forces: Forces = DEFAULT_FORCES,
) -> Population:  # fmt: skip
    """Simulate skins with parameters around those of a central law, and 130 presses on each skin.

    The simulation takes 40 ms per skin. `skins` is the number of skins, or a slice. With a slice, only the selected
    skins of a longer sequence of skins are simulated.
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
    parts, selected = [], skins if isinstance(skins, slice) else slice(skins)
    # Each skin has its own generator, so that the first skins do not depend on the number of skins.
    for skin_rng in rng.spawn(selected.stop)[selected]:
        law = draw_law(centre, spreads, skin_rng)
        thickness, tip = (float(skin_rng.choice(list(sizes), p=list(sizes.values()))) for sizes in (THICKNESSES, TIPS))
        parts.append(draw_skin(law, setups[thickness, tip], skin_rng, forces))
    return Population(*(np.array(part, np.float32) for part in zip(*parts, strict=True)))


def draw_law(centre: Law, spreads: Mapping[str, float], rng: np.random.Generator) -> Law:
    """Draw the parameters of a skin around those of a central law.

    The amplitude is correlated with the gap (see `LOG_AMPLITUDE_PER_MM`).
    """
    law = centre
    for name, spread in spreads.items():
        law = perturb(law, name, spread * rng.standard_normal())
        if name in LEAST and name not in LOGARITHMIC:
            law = replace(law, **{name: max(getattr(law, name), LEAST[name])})
    return perturb(law, "amplitude", LOG_AMPLITUDE_PER_MM * (law.gap_mm - centre.gap_mm))


def draw_skin(
    law: Law, setup: Setup, rng: np.random.Generator, forces: Forces = DEFAULT_FORCES
) -> tuple[Float[np.ndarray, "m ch"], Float[np.ndarray, " ch"], Float[np.ndarray, "m 2"], Float[np.ndarray, " m"]]:
    """Simulate one skin on imperfect chips.

    Returns the field changes of its presses, its no-load field, and the places and forces of the presses.
    """
    place_mm = draw_places(rng, setup.area)
    force_N = forces.draw(PRESSES_N, rng)
    if forces.weight_N is not None:
        place_mm, force_N = np.vstack([place_mm, np.zeros(2)]), np.append(force_N, forces.weight_N)
    filled = fill(setup.rest, rng)
    db_uT, rest_uT = simulate_uT(law, setup, place_mm, force_N, filled), at_rest_uT(law, setup, filled)
    chips_n = len(rest_uT)
    gain = draw_gains(chips_n, rng)
    rest_uT = np.einsum("kij,kj->ki", gain, rest_uT) + CHIP_OFFSET_uT * rng.standard_normal((chips_n, 3))
    db_uT = np.einsum("kij,nkj->nki", gain, db_uT)
    return db_uT.reshape(len(place_mm), -1), rest_uT.ravel(), place_mm, force_N


def draw_places(rng: np.random.Generator, area: Area = PAPER_AREA) -> Float[np.ndarray, "m 2"]:
    """Draw the places of the presses on one skin, in mm from the board's centre.

    The result begins with all places of the grid, for conditioning. It continues with about half of these places again
    and with places anywhere in the area, for training.
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


def grid(area: Area = PAPER_AREA) -> Float[np.ndarray, "65 2"]:
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

"""Draw simulated skins with parameters around those of a central law: fields, places and forces of presses on each.

Each skin has its own parameters, thickness, tip, filler and chips. Errors of the law are not drawn here but at every
training step, so that the same skin never occurs twice.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Float32
from scipy.spatial.transform import Rotation

from reskin.physics.deformation import RestingDipoles
from reskin.physics.magnet import Quadrature
from reskin.universal.law import Law, Setup, at_rest_uT, inside, simulate_uT
from reskin.universal.map import LOGARITHMIC, perturb

COARSE = Quadrature(cell_m=1.0e-3, layers_n=4)  # coarser than for a fit, because the law itself has larger errors
PLACES_N = 65  # places of the paper's grid; a network is conditioned on at most as many presses
PRESSES_N = 2 * PLACES_N  # presses per skin: those for conditioning, and as many that the network is trained on
PITCH_MM, JITTER_MM = 2.0, 0.05  # pitch of that grid; standard deviation of a press about its place
ANYWHERE = 0.5  # share of the presses for training that are anywhere on the skin; the others are on the grid

# Differences between boards and skins in addition to the law's parameters. Assumed, like the spreads of the parameters.
THICKNESSES_MM = {1.8: 0.07, 1.9: 0.24, 2.0: 0.38, 2.1: 0.24, 2.2: 0.07}  # mm: probability
TIPS_MM = {1.75: 0.25, 2.0: 0.5, 2.5: 0.25}  # radius, mm: probability
STRONGER_PER_MM = 0.95  # log amplitude per mm of gap, because the two trade off in a fit
# Standard deviation of the log magnetisation, its length scale, and the number of cosines that it is made from.
FILLER_SD, FILLER_MM, FILLER_WAVES_N = 0.15, 3.0, 64
GAIN_SD, CROSS_SD, CHIP_TURN_DEG, CHIP_OFFSET_uT = 0.025, 0.01, 2.0, 200.0
# Least values: chips are not inside the skin, and a skin is not pulled inwards.
LEAST = {"gap_mm": 0.8, "away_um_mm": 0.0, "lets_go_N": 2.0}


@dataclass(frozen=True)
class Forces:
    """Forces of presses: log-uniform from `least_N` to `largest_N`, or for `light_share` from `light_N` to `least_N`.

    weight_N: force of an additional press at the centre, if any.
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


PLAIN = Forces(light_share=0.2)


@dataclass(frozen=True)
class Population:
    """Simulated skins with presses, in the board's frame and axes; the first `PLACES_N` presses are on the grid."""

    db_uT: Float32[np.ndarray, "s m ch"]
    rest_uT: Float32[np.ndarray, "s ch"]
    place_mm: Float32[np.ndarray, "s m 2"]
    force_N: Float32[np.ndarray, "s m"]

    def __len__(self) -> int:
        return len(self.rest_uT)


def draw_population(
    centre: Law, spreads: Mapping[str, float], setup: Setup, skins: int | slice, rng: np.random.Generator,
    forces: Forces = PLAIN,
) -> Population:  # fmt: skip
    """Simulate the first `skins` skins around a central law, or a slice, with 130 presses each (40 ms per skin)."""
    setups = {
        (thickness_mm, tip_mm): replace(
            setup, design=setup.design.model_copy(update={"thickness_mm": thickness_mm}), tip_radius_mm=tip_mm,
            rule=COARSE,
        )
        for thickness_mm in THICKNESSES_MM
        for tip_mm in TIPS_MM
    }  # fmt: skip
    drawn, taken = [], skins if isinstance(skins, slice) else slice(skins)
    for one in rng.spawn(taken.stop)[taken]:  # the first skins stay the same if more are drawn
        law = draw_law(centre, spreads, one)
        thickness_mm, tip_mm = (float(one.choice(list(of), p=list(of.values()))) for of in (THICKNESSES_MM, TIPS_MM))
        drawn.append(draw_skin(law, setups[thickness_mm, tip_mm], one, forces))
    return Population(*(np.array(part, np.float32) for part in zip(*drawn, strict=True)))


def draw_law(centre: Law, spreads: Mapping[str, float], rng: np.random.Generator) -> Law:
    """Draw a skin's parameters around those of a central law; the amplitude also depends on the gap."""
    law = centre
    for name, spread in spreads.items():
        law = perturb(law, name, spread * rng.standard_normal())
        if name in LEAST and name not in LOGARITHMIC:
            law = replace(law, **{name: max(getattr(law, name), LEAST[name])})
    return perturb(law, "amplitude", STRONGER_PER_MM * (law.gap_mm - centre.gap_mm))


def draw_skin(
    law: Law, setup: Setup, rng: np.random.Generator, forces: Forces = PLAIN
) -> tuple[Float[np.ndarray, "m ch"], Float[np.ndarray, " ch"], Float[np.ndarray, "m 2"], Float[np.ndarray, " m"]]:
    """Simulate one skin on imperfect chips: field changes, no-load field, places and forces."""
    place_mm = draw_places(rng)
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


def draw_places(rng: np.random.Generator) -> Float[np.ndarray, "m 2"]:
    """Draw places of presses, in mm from the board's centre: all grid places, then some of them and some anywhere."""
    grid_mm = grid()
    anywhere_n = int(PLACES_N * ANYWHERE)
    again_mm = grid_mm[rng.permutation(PLACES_N)[anywhere_n:]]
    near_mm = np.concatenate([grid_mm, again_mm])
    near_mm = near_mm + JITTER_MM * rng.standard_normal(near_mm.shape)
    reach_mm = np.abs(grid_mm).max() + 0.3
    anywhere_mm = rng.uniform(-reach_mm, reach_mm, (8 * anywhere_n, 2))  # about 85 % of them are inside
    return np.concatenate([near_mm, anywhere_mm[inside(anywhere_mm)][:anywhere_n]])


def grid() -> Float[np.ndarray, "65 2"]:
    """Return the paper's grid in mm from its centre: 9 x 9 places without the corners."""
    step = np.arange(-4, 5)
    steps = np.stack(np.meshgrid(step, step), axis=-1).reshape(-1, 2)
    return PITCH_MM * steps[np.abs(steps).min(axis=1) <= 2].astype(float)


def fill(rest: RestingDipoles, rng: np.random.Generator) -> RestingDipoles:
    """Make a skin's filler uneven: multiply its moments by a log-normal factor that is smooth over x and y."""
    waves_per_m = rng.standard_normal((2, FILLER_WAVES_N)) / (FILLER_MM * 1e-3)
    phase = rng.uniform(0, 2 * np.pi, FILLER_WAVES_N)
    waves = np.cos(rest.nodes_m[:, :2] @ waves_per_m + phase).sum(axis=1) * np.sqrt(2 / FILLER_WAVES_N)
    return replace(rest, moments_A_m2=np.asfortranarray(rest.moments_A_m2 * np.exp(FILLER_SD * waves)[:, None]))


def draw_gains(chips_n: int, rng: np.random.Generator) -> Float[np.ndarray, "k 3 3"]:
    """Draw the response of chips to a field: gains of the axes, cross-talk, and rotation of the chip on its board."""
    gain = np.exp(GAIN_SD * rng.standard_normal((chips_n, 3)))[:, :, None] * np.eye(3)
    gain = gain + CROSS_SD * rng.standard_normal((chips_n, 3, 3))
    return gain @ Rotation.from_rotvec(CHIP_TURN_DEG * rng.standard_normal((chips_n, 3)), degrees=True).as_matrix()

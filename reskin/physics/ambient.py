"""Fields from outside the skin. In: strengths, directions, a ball of iron, observers, all SI. Out: tesla at observers.

A ball answers a uniform field with one dipole, and dipoles nearby with an image of each. Refuses to know chips, boards
and skins: what magnetises the ball is given, and does not feel it.
"""

import numpy as np
from jaxtyping import Float
from scipy.constants import micro, mu_0

from reskin.physics import magnet
from reskin.physics.magnet import MU0_4PI

# The earth's field, some place of middle latitude (25-65 uT over the globe, IGRF): x is north here, z is up.
EARTH_SIZE_T = 50 * micro
EARTH_DIP_DEG = 66.0
EARTH_T = EARTH_SIZE_T * np.array([np.cos(np.radians(EARTH_DIP_DEG)), 0.0, -np.sin(np.radians(EARTH_DIP_DEG))])
IRON_MU_R = 1000.0  # soft iron; a ball's moment differs by 0.3 % from that of endless permeability


def directions(n: int, rng: np.random.Generator) -> Float[np.ndarray, "n 3"]:
    """Draw directions, uniformly over the sphere."""
    drawn = rng.standard_normal((n, 3))
    return drawn / np.linalg.norm(drawn, axis=1, keepdims=True)


def ball_moment(radius_m: float, b_T: Float[np.ndarray, "3"], mu_r: float = IRON_MU_R) -> Float[np.ndarray, "3"]:
    """Give the moment that a uniform field induces in a ball: (4 pi a^3 / mu0) (mu_r - 1) / (mu_r + 2) B, in A m^2."""
    return 4 * np.pi * radius_m**3 / mu_0 * (mu_r - 1) / (mu_r + 2) * b_T


def ball_field(
    observers_m: Float[np.ndarray, "o 3"],
    b_T: Float[np.ndarray, "3"],
    *,
    centre_m: Float[np.ndarray, "3"],
    radius_m: float,
    mu_r: float = IRON_MU_R,
) -> Float[np.ndarray, "o 3"]:
    """Give what a ball in the field `b_T` adds at observers outside it, in tesla."""
    return magnet.field(centre_m[None], ball_moment(radius_m, b_T, mu_r)[None], observers_m)


def ball_images(
    observers_m: Float[np.ndarray, "o 3"],
    dipoles: tuple[Float[np.ndarray, "s 3"], Float[np.ndarray, "s 3"]],
    *,
    centre_m: Float[np.ndarray, "3"],
    radius_m: float,
) -> Float[np.ndarray, "o 3"]:
    """Give what a ball of endless permeability adds, in tesla, for dipoles (in m, A m^2) that lie outside it.

    As a conducting, uncharged ball does in electrostatics (Jackson, chapter 2): for each dipole an image dipole and a
    pole at the inverse point, and at the centre a pole against that. Close to a skin, one dipole at the centre would
    fall far short of it.
    """
    away_m = dipoles[0] - centre_m
    distance_m = np.linalg.norm(away_m, axis=1, keepdims=True)
    outward, ratio = away_m / distance_m, radius_m / distance_m
    radial_A_m2 = (dipoles[1] * outward).sum(axis=1, keepdims=True)
    places_m = centre_m + radius_m * ratio * outward
    image_T = magnet.field(places_m, ratio**3 * (2 * radial_A_m2 * outward - dipoles[1]), observers_m)
    poles_A_m = (ratio * radial_A_m2 / distance_m)[:, 0]
    return (
        image_T
        + _poles_field(places_m, poles_A_m, observers_m)
        - _poles_field(centre_m[None], poles_A_m.sum(keepdims=True), observers_m)
    )


def _poles_field(
    places_m: Float[np.ndarray, "s 3"], poles_A_m: Float[np.ndarray, " s"], observers_m: Float[np.ndarray, "o 3"]
) -> Float[np.ndarray, "o 3"]:
    separation_m = observers_m[:, None] - places_m
    over_r3 = poles_A_m / np.linalg.norm(separation_m, axis=2) ** 3
    return MU0_4PI * (over_r3[:, :, None] * separation_m).sum(axis=1)

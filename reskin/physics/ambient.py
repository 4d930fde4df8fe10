"""Ambient fields: the earth's field and the field of an iron ball. SI units.

In a uniform field, an iron ball produces the field of one dipole. Near magnetic dipoles, such as those of a skin, it
produces the field of image dipoles and image poles. The effect of the ball on the magnetisation of these dipoles is
neglected.
"""

import numpy as np
from jaxtyping import Float
from scipy.constants import micro, mu_0

from reskin.physics import magnet
from reskin.physics.magnet import MU0_4PI, Dipoles

# The earth's field at a middle latitude; its magnitude is between 25 and 65 uT over the globe (IGRF). x is north, z is
# up.
EARTH_SIZE_T = 50 * micro
EARTH_DIP_DEG = 66.0
EARTH_T = EARTH_SIZE_T * np.array([np.cos(np.radians(EARTH_DIP_DEG)), 0.0, -np.sin(np.radians(EARTH_DIP_DEG))])
# Relative permeability of soft iron. With this value, the moment of a ball is 0.3 % smaller than with infinite
# permeability.
IRON_MU_R = 1000.0


def random_directions(n: int, rng: np.random.Generator) -> Float[np.ndarray, "n 3"]:
    """Draw n unit vectors whose directions are uniformly distributed."""
    vectors = rng.standard_normal((n, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def ball_moment(radius_m: float, b_T: Float[np.ndarray, "3"], mu_r: float = IRON_MU_R) -> Float[np.ndarray, "3"]:
    """Return the moment in A m^2 of a ball in a uniform field.

    For a ball of radius a in the field B, the moment is (4 pi a^3 / mu0) (mu_r - 1) / (mu_r + 2) B.
    """
    return 4 * np.pi * radius_m**3 / mu_0 * (mu_r - 1) / (mu_r + 2) * b_T


def ball_field(
    observers_m: Float[np.ndarray, "o 3"],
    b_T: Float[np.ndarray, "3"],
    *,
    centre_m: Float[np.ndarray, "3"],
    radius_m: float,
    mu_r: float = IRON_MU_R,
) -> Float[np.ndarray, "o 3"]:
    """Return the field in T that a ball adds to the uniform field `b_T`, at points outside the ball."""
    return magnet.field(centre_m[None], ball_moment(radius_m, b_T, mu_r)[None], observers_m)


def ball_images(
    observers_m: Float[np.ndarray, "o 3"],
    dipoles: Dipoles,
    *,
    centre_m: Float[np.ndarray, "3"],
    radius_m: float,
) -> Float[np.ndarray, "o 3"]:
    """Return the field in T that a ball of infinite permeability adds to the field of dipoles outside the ball.

    Each dipole has an image dipole and a magnetic pole at its inverse point in the ball, and an opposite pole at the
    ball's centre. This is the solution for a conducting, uncharged sphere in electrostatics (Jackson, chapter 2). Close
    to a skin, the field of a single dipole at the ball's centre would be much too small.
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

"""External fields at a board that a robot moves, such as the fields of the earth, of magnets and of other skins.

When the robot moves, the external field at the chips changes, and this change is not known. This module models the
change since the no-load reading as the field of a single magnetic dipole. The distance of the dipole from the board's
centre is fixed, but the direction from the board to the dipole and the moment of the dipole are random. The field of
such a dipole is nearly uniform over the board. The larger the distance, the less the field varies from chip to chip.
"""

import numpy as np
from jaxtyping import Float

# Distance of the dipole from the board's centre. It was chosen from two results. For recordings of a moving
# hand whose fingers have skins (data/leaphand), a distance of 40 mm has the largest likelihood. On simulated skins with
# sources that are farther away, estimates are more accurate with a larger distance.
DISTANCE_MM = 50.0
# Smallest distance of the dipole, as a multiple of the distance from the board's centre to the farthest chip. The value
# is assumed.
CHIP_RATIO = 3.0
# Smallest standard deviation of the noise in `suppressor`. It is needed because the measured noise is 0 if all readings
# at the start of a log are equal.
NOISE_MIN_uT = 0.1
DIRECTIONS_N = 150  # number of directions of the dipole over which the covariance is averaged


def covariance(
    chips_mm: Float[np.ndarray, "k 2"], sd_uT: float, distance_mm: float = DISTANCE_MM
) -> Float[np.ndarray, "ch ch"]:
    """Return the covariance matrix of the external field at all chips, along the board's axes.

    Parameters
    ----------
    chips_mm : positions of the chips relative to the board's centre
    sd_uT : standard deviation of each component of the external field at the board's centre
    distance_mm : distance of the dipole from the board's centre. For a large board, it is increased to `CHIP_RATIO`
        times the distance from the centre to the farthest chip.
    """
    distance_mm = max(distance_mm, CHIP_RATIO * float(np.linalg.norm(chips_mm, axis=1).max()))
    at_mm = np.column_stack([chips_mm, np.zeros(len(chips_mm))])
    dipoles_mm = distance_mm * _directions(DIRECTIONS_N)
    fields, at_centre = (_per_moment(places_mm, dipoles_mm) for places_mm in (at_mm, np.zeros((1, 3))))
    return 3 * sd_uT**2 / (at_centre**2).sum() * fields @ fields.T


def suppressor(external_cov: Float[np.ndarray, "ch ch"], noise_uT: float) -> Float[np.ndarray, "ch ch"]:
    """Return a symmetric matrix that removes most of the external field from a reading.

    Multiplied by this matrix, the sum of an external field and noise has the same standard deviation in every
    direction, namely that of the noise. The part of a reading that no external field can explain is unchanged.

    Parameters
    ----------
    external_cov : covariance of the external field, from `covariance`
    noise_uT : standard deviation of the noise of a channel
    """
    noise_uT = max(noise_uT, NOISE_MIN_uT)
    variances, axes = np.linalg.eigh(external_cov)
    return (axes * (noise_uT / np.sqrt(np.maximum(variances, 0) + noise_uT**2))) @ axes.T


def _per_moment(at_mm: Float[np.ndarray, "o 3"], dipoles_mm: Float[np.ndarray, "s 3"]) -> Float[np.ndarray, "o3 s3"]:
    """Return the field at each point for a moment of 1 along each axis of each dipole, in an arbitrary unit."""
    off_mm = at_mm[:, None] - dipoles_mm
    distance_mm = np.linalg.norm(off_mm, axis=2)[..., None, None]
    tensor = 3 * off_mm[..., None] * off_mm[..., None, :] / distance_mm**5 - np.eye(3) / distance_mm**3
    return tensor.transpose(0, 2, 1, 3).reshape(3 * len(at_mm), -1)


def _directions(n: int) -> Float[np.ndarray, "n 3"]:
    """Return n unit vectors that are evenly spread over the sphere.

    The vectors are on a spiral from pole to pole. The angle between successive vectors about the z axis is the golden
    angle.
    """
    i = np.arange(n) + 0.5
    z, angle = 1 - 2 * i / n, np.pi * (1 + 5**0.5) * i
    radius = np.sqrt(1 - z**2)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), z])

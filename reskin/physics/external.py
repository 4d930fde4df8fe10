"""External fields over a board that a robot moves: the earth's field, magnets, and other skins.

The change of an external field since the no-load reading is unknown. Its prior is the field of one magnetic dipole, at
a known distance from the board's centre, in an unknown direction and with an unknown moment. Such fields are nearly
uniform over the board; how much they vary depends on the distance.
"""

import numpy as np
from jaxtyping import Float

# Distance of the dipole from the board's centre, chosen on recordings and on simulated skins. For recordings of a
# moving hand whose fingers have skins (data/leaphand), 40 mm has the largest likelihood. On simulated skins, estimates
# are more accurate with a larger distance if the sources are farther away.
DISTANCE_MM = 50.0
CHIP_RATIO = 3.0  # smallest distance of the dipole, in units of the distance of the farthest chip; assumed
NOISE_MIN_uT = 0.1  # smallest noise for `suppressor`; the measured noise is 0 if a log begins with equal readings
DIRECTIONS_N = 150  # directions of the dipole over which the covariance is averaged


def covariance(
    chips_mm: Float[np.ndarray, "k 2"], sd_uT: float, distance_mm: float = DISTANCE_MM
) -> Float[np.ndarray, "ch ch"]:
    """Return the covariance of readings in an unknown external field, along the board's axes.

    chips_mm: positions of the chips relative to the board's centre. sd_uT: standard deviation of each component of the
    field at the board's centre. On large boards, the dipole is farther away than `distance_mm`: `CHIP_RATIO` times the
    distance from the centre to the farthest chip.
    """
    distance_mm = max(distance_mm, CHIP_RATIO * float(np.linalg.norm(chips_mm, axis=1).max()))
    at_mm = np.column_stack([chips_mm, np.zeros(len(chips_mm))])
    dipoles_mm = distance_mm * _directions(DIRECTIONS_N)
    fields, at_centre = (_per_moment(places_mm, dipoles_mm) for places_mm in (at_mm, np.zeros((1, 3))))
    return 3 * sd_uT**2 / (at_centre**2).sum() * fields @ fields.T


def suppressor(external_cov: Float[np.ndarray, "ch ch"], noise_uT: float) -> Float[np.ndarray, "ch ch"]:
    """Return a symmetric matrix that shrinks external fields in a reading to the size of the noise.

    The matrix whitens the sum of external field and noise, and is multiplied by the standard deviation of the noise.
    The part of a reading that no external field can explain is unchanged.
    """
    noise_uT = max(noise_uT, NOISE_MIN_uT)
    variances, axes = np.linalg.eigh(external_cov)
    return (axes * (noise_uT / np.sqrt(np.maximum(variances, 0) + noise_uT**2))) @ axes.T


def _per_moment(at_mm: Float[np.ndarray, "o 3"], dipoles_mm: Float[np.ndarray, "s 3"]) -> Float[np.ndarray, "o3 s3"]:
    """Return the field at points per unit of each component of each dipole's moment (arbitrary unit)."""
    off_mm = at_mm[:, None] - dipoles_mm
    distance_mm = np.linalg.norm(off_mm, axis=2)[..., None, None]
    tensor = 3 * off_mm[..., None] * off_mm[..., None, :] / distance_mm**5 - np.eye(3) / distance_mm**3
    return tensor.transpose(0, 2, 1, 3).reshape(3 * len(at_mm), -1)


def _directions(n: int) -> Float[np.ndarray, "n 3"]:
    """Return n unit vectors that are evenly spread over the sphere, on a spiral with golden-angle steps."""
    i = np.arange(n) + 0.5
    z, angle = 1 - 2 * i / n, np.pi * (1 + 5**0.5) * i
    radius = np.sqrt(1 - z**2)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), z])

"""External fields over a board: the earth's field, magnets and other skins, while a robot moves the board.

Their sources are far away compared with the board, so the field is described by its value at the board's centre and by
its gradient. Without currents in the board, the gradient is symmetric. Chips are in one plane, so the derivatives with
respect to z have no effect, except those that are equal to others by this symmetry.
"""

import numpy as np
from jaxtyping import Float

# Standard deviation of the gradient's elements per mm, relative to that of the field: a magnet about 7 cm away, whose
# field decreases as distance^-3, has such gradients. Recording `fullnocontact1` of a moving hand has 0.039 per mm.
GRADIENT_PER_MM = 0.04
UNIFORM_N = 3  # the first columns of `basis` are the uniform field


def basis(chips_mm: Float[np.ndarray, "k 2"]) -> Float[np.ndarray, "ch 8"]:
    """Return the readings of all chips, along the board's axes, for a unit of each component of an external field.

    The columns are Bx, By, Bz at the centre, then the gradient's elements xx, yy, xy, xz and yz (per mm).
    """
    columns = np.zeros((len(chips_mm), 3, 8))
    columns[:, :, :UNIFORM_N] = np.eye(3)
    x_mm, y_mm = chips_mm.T
    columns[:, 0, 3], columns[:, 1, 4] = x_mm, y_mm
    columns[:, 0, 5], columns[:, 1, 5] = y_mm, x_mm
    columns[:, 2, 6], columns[:, 2, 7] = x_mm, y_mm
    return columns.reshape(-1, 8)


def covariance(chips_mm: Float[np.ndarray, "k 2"], sd_uT: float) -> Float[np.ndarray, "ch ch"]:
    """Return the covariance of readings in an unknown external field, along the board's axes.

    sd_uT: standard deviation of each of the three components of the field at the board's centre.
    """
    components = basis(chips_mm) * (sd_uT * np.where(np.arange(8) < UNIFORM_N, 1.0, GRADIENT_PER_MM))
    return components @ components.T


def suppressor(
    chips_mm: Float[np.ndarray, "k 2"], turn: Float[np.ndarray, "k 3 3"], sd_uT: float, noise_uT: float
) -> Float[np.ndarray, "ch ch"]:
    """Return a symmetric matrix that shrinks external fields in readings (along the chips' axes) to the noise.

    It is the whitening matrix of external field and noise, times the standard deviation of the noise. The part of a
    reading that no external field explains is unchanged; with `sd_uT` = 0, everything is. `turn` rotates the axes of
    each chip to those of the board.
    """
    chips_n = len(chips_mm)
    cov = covariance(chips_mm, sd_uT).reshape(chips_n, 3, chips_n, 3)
    cov = np.einsum("aji,ajbk,bkl->aibl", turn, cov, turn).reshape(3 * chips_n, 3 * chips_n)
    variances, axes = np.linalg.eigh(cov)
    return (axes * (noise_uT / np.sqrt(np.maximum(variances, 0) + noise_uT**2))) @ axes.T

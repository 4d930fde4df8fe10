"""Where a poke may have been and under which force: tables -> every hypothesis with its mean and slopes, and factors.

All that does not change while a skin is learnt is computed here, once. Refuses to know readings.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Float32

from pipeline.twin.gaussians import Linear, side_by_side
from pipeline.twin.places import inside
from pipeline.twin.residual import Residual
from pipeline.twin.tables import Tables

LAW_ERROR = 0.35  # of |dB|: rms of how far the law is off, all channels together, before it has learnt
NOISE_uT = 4.5  # of one reading, a channel


@dataclass(frozen=True)
class Gains:
    """What an unlabelled poke tells of a skin's numbers, by the hypothesis it is believed to be."""

    information: Float32[np.ndarray, "h tt"]
    aim: Float32[np.ndarray, "h ch t"]  # times how far it is off, channel by channel


@dataclass(frozen=True)
class Hypotheses:
    """Places of a lattice under some forces; forces run within places. In single precision what readings meet."""

    place_mm: Float[np.ndarray, "p 2"]
    log_N: Float[np.ndarray, " q"]
    mean_uT: Float32[np.ndarray, "h ch"]
    slope_uT: Float32[np.ndarray, "h ch t"]
    missed: Float32[np.ndarray, "h ch"]
    error_cov: Float[np.ndarray, "ch ch"]

    @property
    def at(self) -> tuple[Float[np.ndarray, "h 2"], Float[np.ndarray, " h"]]:
        """Give the place and the logarithm of the force of each hypothesis."""
        return np.repeat(self.place_mm, len(self.log_N), axis=0), np.tile(self.log_N, len(self.place_mm))

    @cached_property
    def linear(self) -> Linear:
        """Lay means and slopes out as they are made ready for readings."""
        return side_by_side(self.mean_uT, self.slope_uT)

    @cached_property
    def gains(self) -> Gains:
        """Weigh what a poke tells of the numbers by how far the law may be off before it has learnt."""
        slope_uT, h = self.slope_uT.astype(float), len(self.mean_uT)
        length2_uT2 = (self.mean_uT.astype(float) ** 2).sum(axis=1)
        cov = with_noise(length2_uT2[:, None, None] * self.error_cov)
        aim = np.linalg.solve(cov, slope_uT)
        information = (aim.transpose(0, 2, 1) @ slope_uT).reshape(h, -1)
        return Gains(information.astype(np.float32), aim.astype(np.float32))

    @cached_property
    def expected_uT(self) -> Float32[np.ndarray, "h ch"]:
        """Give what is expected before anything is learnt, with what the law misses on known boards."""
        return self.mean_uT + np.linalg.norm(self.mean_uT, axis=1, keepdims=True) * self.missed


def lattice(tables: Tables, residual: Residual) -> Hypotheses:
    """Lay out the tables' places that can be pressed."""
    place_mm = np.stack(np.meshgrid(tables.axis_mm, tables.axis_mm, indexing="ij"), axis=-1).reshape(-1, 2)
    taken = inside(place_mm)
    log_N, channels_n = np.log(tables.force_N), len(tables.rest_uT)
    mean_uT = tables.mean_uT.reshape(len(place_mm), len(log_N), -1)[taken].reshape(-1, channels_n)
    slope_uT = tables.slope_uT.reshape(len(place_mm), len(log_N), -1)[taken].reshape(*mean_uT.shape, -1)
    taken_mm = place_mm[taken]
    missed = residual.at(np.repeat(taken_mm, len(log_N), axis=0), np.tile(log_N, len(taken_mm)))
    mean_uT, slope_uT, missed = (part.astype(np.float32) for part in (mean_uT, slope_uT, missed))
    return Hypotheses(taken_mm, log_N, mean_uT, slope_uT, missed, LAW_ERROR**2 * residual.share)


def with_noise(cov_uT2: Float[np.ndarray, "h ch ch"]) -> Float[np.ndarray, "h ch ch"]:
    """Add a reading's noise to covariances."""
    return cov_uT2 + NOISE_uT**2 * np.eye(cov_uT2.shape[1])

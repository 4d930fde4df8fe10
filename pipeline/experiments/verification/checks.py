"""A row of the verification table, and the error measures that its checks use.

The other modules of this package run checks on any inputs: the experiment uses those of a scene, tests use random ones.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from reskin.physics.board import Spreads


@dataclass(frozen=True)
class Check:
    """A property of `subject` compared with a reference: measured error, tolerance and the reason for the tolerance."""

    subject: str
    law: str
    against: str
    error: float
    unit: str  # "1" for a relative error
    tolerance: float
    reason: str

    @property
    def holds(self) -> bool:
        """Whether the error is within its tolerance; False for NaN."""
        return bool(self.error <= self.tolerance)


def max_error(found: Float[np.ndarray, "*any"], truth: Float[np.ndarray, "*any"] | float) -> float:
    """Return the largest absolute error."""
    return float(np.abs(found - truth).max())


def relative_error(found: Float[np.ndarray, "*any"], truth: Float[np.ndarray, "*any"]) -> float:
    """Return the largest relative error."""
    return float(np.abs(found / truth - 1).max())


def scaled_error(found: Float[np.ndarray, "*any"], truth: Float[np.ndarray, "*any"]) -> float:
    """Return the ratio of the largest absolute error to the largest absolute true value."""
    return float(np.abs(found - truth).max() / np.abs(truth).max())


def norm_error(found: Float[np.ndarray, "*any"], truth: Float[np.ndarray, "*any"]) -> float:
    """Return the ratio of the Euclidean norm of the errors to that of the true values."""
    return float(np.linalg.norm(found - truth) / np.linalg.norm(truth))


def no_spread(spreads: Spreads) -> Spreads:
    """Return spreads of zero: boards and skins as designed, for checks of symmetry."""
    length = "skin_filler_length_mm"
    return spreads.model_copy(update={name: 0.0 for name in Spreads.model_fields if name != length})

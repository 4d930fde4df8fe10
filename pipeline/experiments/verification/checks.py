"""One row of the verification table: a law of the product, its error against a reference, and what that may be.

Laws (the modules beside this one) return it for any inputs: the stage tabulates those of a scene, tests draw others.
Refuses to know what is checked.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from reskin.physics.board import Spreads


@dataclass(frozen=True)
class Check:
    """A law of `subject` against a reference: the measured error, what it may be, and why so much."""

    subject: str
    law: str
    against: str
    error: float
    unit: str  # "1" for an error relative to the size of the reference
    tolerance: float
    reason: str

    @property
    def holds(self) -> bool:
        """Tell whether the error is within its tolerance; NaN is not."""
        return bool(self.error <= self.tolerance)


def farthest(found: Float[np.ndarray, "*any"], truth: Float[np.ndarray, "*any"] | float) -> float:
    """Give the largest deviation, in the unit of both."""
    return float(np.abs(found - truth).max())


def relative(found: Float[np.ndarray, "*any"], truth: Float[np.ndarray, "*any"]) -> float:
    """Give the largest deviation, each relative to its own truth."""
    return float(np.abs(found / truth - 1).max())


def worst(found: Float[np.ndarray, "*any"], truth: Float[np.ndarray, "*any"]) -> float:
    """Give the largest deviation, relative to the largest size of the truth."""
    return float(np.abs(found - truth).max() / np.abs(truth).max())


def apart(found: Float[np.ndarray, "*any"], truth: Float[np.ndarray, "*any"]) -> float:
    """Give the deviation of all values together (root of the sum of squares), relative to the truth's."""
    return float(np.linalg.norm(found - truth) / np.linalg.norm(truth))


def no_spread(spreads: Spreads) -> Spreads:
    """Take away all that differs between boards and between skins: the designs themselves, for laws of symmetry."""
    length = "skin_filler_length_mm"
    return spreads.model_copy(update={name: 0.0 for name in Spreads.model_fields if name != length})

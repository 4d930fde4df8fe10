"""Class `Check`, whose instances are the rows of the verification experiment's table, and measures of error.

The other modules of this package define checks as functions of their inputs. The experiment calls these functions with
the inputs of a scene, and the tests call them with random inputs.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from reskin.physics.board import Spreads


@dataclass(frozen=True)
class Check:
    """The result of one check, which compares a property of the simulator with a reference.

    - subject: the part of the simulator that is checked.
    - law: the property of this part that is checked.
    - against: the reference.
    - error: the difference from the reference, in `unit` ("1" for a relative error).
    - tolerance: the largest accepted error.
    - reason: why the tolerance is this large.
    """

    subject: str
    law: str
    against: str
    error: float
    unit: str
    tolerance: float
    reason: str

    @property
    def holds(self) -> bool:
        """Whether the error is within its tolerance; False for NaN."""
        return bool(self.error <= self.tolerance)


def max_error(found: Float[np.ndarray, "*any"], truth: Float[np.ndarray, "*any"] | float) -> float:
    """Return the largest absolute error over all elements."""
    return float(np.abs(found - truth).max())


def relative_error(found: Float[np.ndarray, "*any"], truth: Float[np.ndarray, "*any"]) -> float:
    """Return the largest relative error over all elements."""
    return float(np.abs(found / truth - 1).max())


def scaled_error(found: Float[np.ndarray, "*any"], truth: Float[np.ndarray, "*any"]) -> float:
    """Return largest absolute error / largest absolute true value."""
    return float(np.abs(found - truth).max() / np.abs(truth).max())


def norm_error(found: Float[np.ndarray, "*any"], truth: Float[np.ndarray, "*any"]) -> float:
    """Return Euclidean norm of the errors / Euclidean norm of the true values."""
    return float(np.linalg.norm(found - truth) / np.linalg.norm(truth))


def no_spread(spreads: Spreads) -> Spreads:
    """Return manufacturing spreads of zero, with which every drawn board and skin equals its design."""
    length = "skin_filler_length_mm"
    return spreads.model_copy(update={name: 0.0 for name in Spreads.model_fields if name != length})

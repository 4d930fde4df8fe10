"""How the chips of the paper's board lie and are turned: readings along chips' axes <-> along the board's.

Turned as recorded boards have them. Refuses to know skins.
"""

from functools import cache

import numpy as np
from jaxtyping import Float
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

CHIPS_MM = ((0.0, 0.0), (-7.0, 0.0), (0.0, -7.0), (7.0, 0.0), (0.0, 7.0))
TURNS_DEG = (0.0, 180.0, 270.0, 90.0, 0.0)


def to_board(b_uT: Float[np.ndarray, "f ch"]) -> Float[np.ndarray, "f ch"]:
    """Turn readings from the chips' axes to the board's."""
    return b_uT @ _turn()


def to_chips(b_uT: Float[np.ndarray, "f ch"]) -> Float[np.ndarray, "f ch"]:
    """Turn readings from the board's axes to the chips'."""
    return b_uT @ _turn().T


@cache
def _turn() -> Float[np.ndarray, "ch ch"]:
    of_chips = Rotation.from_euler("z", np.array(TURNS_DEG)[:, None], degrees=True).as_matrix()
    return np.array(block_diag(*of_chips)).T

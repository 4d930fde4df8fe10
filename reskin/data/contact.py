"""Detection of contact from the size of the field change.

A reading counts as contact if its field change is well above the noise of readings without contact.
"""

import numpy as np
from jaxtyping import Float, Float64

# Let dB be the field change of a reading, and m the median of |dB| over readings without contact. A reading counts as
# contact if |dB| exceeds m by more than this factor times the noise. The noise is the rms of dB over all channels of
# the readings without contact.
CONTACT_SDS = 6.0


def magnitudes_uT(
    db_uT: Float[np.ndarray, "f ch"], suppressor: Float64[np.ndarray, "ch ch"] | None
) -> Float[np.ndarray, " f"]:
    """Return the magnitude |dB| of each field change, for the detection of contact.

    If a matrix `suppressor` is given, the field changes are first multiplied by it. This shrinks external fields, which
    could otherwise be mistaken for contacts.
    """
    return np.linalg.norm(db_uT if suppressor is None else db_uT @ suppressor, axis=1)


def noise_uT(db_uT: Float[np.ndarray, "f ch"]) -> float:
    """Return the noise, which is the rms of field changes without contact over all readings and channels."""
    return float(np.sqrt((db_uT.astype(np.float64) ** 2).mean()))


def contact_threshold_uT(db_uT: Float[np.ndarray, "f ch"], suppressor: Float64[np.ndarray, "ch ch"] | None) -> float:
    """Compute the threshold for contact: a reading whose |dB| is above this value counts as contact.

    `db_uT` contains the field changes of readings without contact.
    """
    return float(np.median(magnitudes_uT(db_uT, suppressor)) + CONTACT_SDS * noise_uT(db_uT))

"""Detection of contact: a reading is in contact if its field change is well above the noise."""

import numpy as np
from jaxtyping import Float, Float64

# Let dB be the field change of a reading, and m the median of |dB| over readings without contact. A reading is in
# contact if |dB| exceeds m by more than this factor times the noise. The noise is the rms of dB over all channels of
# the readings without contact.
CONTACT_SDS = 6.0


def magnitudes_uT(
    db_uT: Float[np.ndarray, "f ch"], suppressor: Float64[np.ndarray, "ch ch"] | None
) -> Float[np.ndarray, " f"]:
    """Return |dB| of each reading, for the detection of contact; the matrix `suppressor` removes external fields."""
    return np.linalg.norm(db_uT if suppressor is None else db_uT @ suppressor, axis=1)


def noise_uT(db_uT: Float[np.ndarray, "f ch"]) -> float:
    """Return the noise: the rms, over all readings and channels, of field changes without contact."""
    return float(np.sqrt((db_uT.astype(np.float64) ** 2).mean()))


def contact_threshold_uT(db_uT: Float[np.ndarray, "f ch"], suppressor: Float64[np.ndarray, "ch ch"] | None) -> float:
    """Compute the magnitude above which a reading is in contact, from the field changes of readings without contact."""
    return float(np.median(magnitudes_uT(db_uT, suppressor)) + CONTACT_SDS * noise_uT(db_uT))

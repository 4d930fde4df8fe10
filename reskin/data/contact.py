"""Detection of contact: a reading is in contact if its field change is well above the noise."""

import numpy as np
from jaxtyping import Float, Float64

# A reading is in contact if |dB| exceeds its median over readings without contact by more than this multiple of the
# noise, which is the rms of dB over all channels of these readings.
CONTACT_SDS = 6.0


def magnitudes_uT(
    db_uT: Float[np.ndarray, "f ch"], suppressor: Float64[np.ndarray, "ch ch"] | None
) -> Float[np.ndarray, " f"]:
    """Return |dB| of each reading, to detect contact; the suppressor removes external fields."""
    return np.linalg.norm(db_uT if suppressor is None else db_uT @ suppressor, axis=1)


def noise_uT(db_uT: Float[np.ndarray, "f ch"]) -> float:
    """Return the noise: the rms over all channels of field changes without contact."""
    return float(np.sqrt((db_uT.astype(np.float64) ** 2).mean()))


def contact_threshold_uT(db_uT: Float[np.ndarray, "f ch"], suppressor: Float64[np.ndarray, "ch ch"] | None) -> float:
    """Return the magnitude above which a reading is in contact, from the field changes of readings without contact."""
    return float(np.median(magnitudes_uT(db_uT, suppressor)) + CONTACT_SDS * noise_uT(db_uT))

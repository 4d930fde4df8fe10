"""What a method sees of a change of field. In: dB in uT. Out: dB itself, or its shape and the log of its length.

A view is a fixed function of one row, so it cannot leak. Refuses to know skins, folds, scalers and networks.
"""

from collections.abc import Callable, Mapping

import numpy as np
from jaxtyping import Float32

# Assumed: a shorter |dB| is taken as this long. It cannot be told from none, as one channel's noise alone is 3 uT
# (FACTS 3), all fifteen's together some 15 uT. Its log is 0, so that no change at all is zeros throughout.
DB_FLOOR_uT = 1.0


def raw(db_uT: Float32[np.ndarray, "f ch"]) -> Float32[np.ndarray, "f ch"]:
    """Show the change of field as it is."""
    return db_uT


def shape(db_uT: Float32[np.ndarray, "f ch"]) -> Float32[np.ndarray, "f c"]:
    """Show dB / |dB|, which a magnet's strength leaves alone, and append the natural log of |dB| / uT."""
    length_uT = np.linalg.norm(db_uT.astype(np.float64), axis=1, keepdims=True)  # [f 1]
    floored_uT = np.maximum(length_uT, DB_FLOOR_uT)
    return np.hstack([db_uT / floored_uT, np.log(floored_uT)]).astype(np.float32)


VIEW: Mapping[str, Callable[[Float32[np.ndarray, "f ch"]], Float32[np.ndarray, "f c"]]] = {"raw": raw, "shape": shape}

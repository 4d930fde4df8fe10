"""Are these microtesla and newtons? In: the fields and forces of a recording. Out: nothing, or `CaptureError`.

A file does not say its units, but a magnetometer has a full scale and a soft skin has a strength.
Refuses to convert: a wrong unit is told to the user, never guessed away.
"""

import numpy as np
from jaxtyping import Float

from pipeline.errors import CaptureError, complain

# MLX90393 data sheet, table 17: 16 bits of the coarsest step, 9.680 uT (z, GAIN_SEL 0, RES 3).
FULL_SCALE_uT = 32768 * 9.680
# The earth's field alone is 25-65 uT, and a magnetised skin adds hundreds; in mT or G they would read below this.
WEAKEST_uT = 10.0
# Forces on skins a few mm thick; a touch of 1 N read as grams would be 102.
FORCE_MAX_N = 100.0


def check_fields(b_uT: Float[np.ndarray, "f ch"], where: str, *, first_line_n: int) -> None:
    """Raise if fields are beyond the chip's full scale, or so weak that they must be in another unit."""
    b_max_uT = np.abs(b_uT).max(axis=1)
    if b_max_uT.max() > FULL_SCALE_uT:
        place = f"line {first_line_n + int(b_max_uT.argmax())}"
        rule = f"below the full scale of {FULL_SCALE_uT:.0f} uT"
        got = f"{b_max_uT.max():.6g} in {place}"
        raise CaptureError(complain(where, "field", rule, got, "Are the columns in order, and in uT?"))
    if b_max_uT.max() < WEAKEST_uT:
        got = f"{b_max_uT.max():.4g} at most"
        raise CaptureError(complain(where, "field", f"{WEAKEST_uT:g} uT somewhere", got, "Convert mT or G to uT."))


def check_forces(force_N: Float[np.ndarray, " f"], where: str, *, first_line_n: int) -> None:
    """Raise if a force is more than these skins bear, as forces in grams are; NaN is no force and passes."""
    too_strong = np.flatnonzero(np.abs(force_N) > FORCE_MAX_N)
    if len(too_strong):
        got = f"{force_N[too_strong[0]]:.6g} in line {first_line_n + int(too_strong[0])}"
        raise CaptureError(complain(where, "force", f"below {FORCE_MAX_N:g} N", got, "Convert grams to N."))

"""Convert field changes to the inputs of models, and convert targets to and from scaled outputs.

The inputs of a network are computed in two steps. First, a view is computed from the field change. A view is a fixed
function, such as `shape`. Then, a scaler shifts and scales the view. The scaler also converts targets in mm and N to
the scaled units in which a network is trained, and converts the network's outputs back. A scaler is fitted to training
rows only, so that it contains no information about test rows.
"""

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass

import numpy as np
from jaxtyping import Float32

# Lower limit that is assumed for |dB|, the norm of the field change, so that its logarithm is finite. Noise
# alone has a larger norm: for 15 channels with a noise of 3 uT each, the norm is about 12 uT (3 times the square root
# of 15). The logarithm of the limit, in uT, is 0. Therefore, all inputs are 0 if the field change is 0.
DB_FLOOR_uT = 1.0
# Lower limit of the scales. It avoids a division by zero for channels that are constant in the training rows.
SCALE_FLOOR = np.float32(1e-6)
# For the released network's scale, field changes are divided by this number times their standard deviation. The inputs
# of the network that the paper's authors released have about the resulting size.
RELEASED_INPUT_SDS = np.float32(5.0)
RELEASED_PLACE_MM, RELEASED_FORCE_N = 16.0, 3.0


def raw(db_uT: Float32[np.ndarray, "f ch"]) -> Float32[np.ndarray, "f ch"]:
    return db_uT


def shape(db_uT: Float32[np.ndarray, "f ch"]) -> Float32[np.ndarray, "f c"]:
    """Return the direction of the field change, dB / |dB|, and as a last column the natural logarithm of |dB| in uT.

    The direction does not depend on the strength of the magnets.
    """
    length_uT = np.linalg.norm(db_uT.astype(np.float64), axis=1, keepdims=True)  # [f 1]
    floored_uT = np.maximum(length_uT, DB_FLOOR_uT)
    return np.hstack([db_uT / floored_uT, np.log(floored_uT)]).astype(np.float32)


VIEW: Mapping[str, Callable[[Float32[np.ndarray, "f ch"]], Float32[np.ndarray, "f c"]]] = {"raw": raw, "shape": shape}


@dataclass(frozen=True)
class Scaler:
    """The shifts and scales of the inputs and outputs of a network.

    The inputs of the network are (view - input_shift) / input_scale. The predicted x_mm, y_mm and F_N are
    outputs * target_scale + target_shift.
    """

    input_shift: Float32[np.ndarray, " ch"]
    input_scale: Float32[np.ndarray, " ch"]
    target_shift: Float32[np.ndarray, " t"]
    target_scale: Float32[np.ndarray, " t"]

    def encode(self, db_uT: Float32[np.ndarray, "f ch"]) -> Float32[np.ndarray, "f ch"]:
        return (db_uT - self.input_shift) / self.input_scale

    def encode_target(self, target: Float32[np.ndarray, "f t"]) -> Float32[np.ndarray, "f t"]:
        """Convert targets (x in mm, y in mm, forces in N) to scaled targets."""
        return (target - self.target_shift) / self.target_scale

    def decode(self, scaled: Float32[np.ndarray, "f t"]) -> Float32[np.ndarray, "f t"]:
        """Convert the outputs of a network to targets (x in mm, y in mm, forces in N)."""
        return scaled * self.target_scale + self.target_shift

    def arrays(self) -> dict[str, np.ndarray]:
        return asdict(self)

    @classmethod
    def of_arrays(cls, arrays: Mapping[str, np.ndarray]) -> "Scaler":
        return cls(**{name: arrays[name] for name in cls.__dataclass_fields__})


def fit_standard(db_uT: Float32[np.ndarray, "f ch"], target: Float32[np.ndarray, "f t"]) -> Scaler:
    """Fit a scaler after which each input and each target has mean 0 and standard deviation 1 over these rows."""
    known = ~np.isnan(target).all(axis=0)
    shift, scale = np.zeros(target.shape[1], np.float32), np.ones(target.shape[1], np.float32)
    shift[known] = np.nanmean(target[:, known], axis=0, dtype=np.float64)
    scale[known] = np.nanstd(target[:, known], axis=0, dtype=np.float64)
    return Scaler(
        input_shift=db_uT.mean(axis=0, dtype=np.float64).astype(np.float32),
        input_scale=_floored(db_uT.std(axis=0, dtype=np.float64)),
        target_shift=shift,
        target_scale=_floored(scale),
    )


def fit_released(db_uT: Float32[np.ndarray, "f ch"], target: Float32[np.ndarray, "f t"]) -> Scaler:
    """Fit a scaler that scales as the network does that the paper's authors released.

    Each input is divided by 5 times its standard deviation, x and y are divided by 16 mm, and forces by 3 N. Means are
    not subtracted.
    """
    return Scaler(
        input_shift=np.zeros(db_uT.shape[1], np.float32),
        input_scale=_floored(RELEASED_INPUT_SDS * db_uT.std(axis=0, dtype=np.float64)),
        target_shift=np.zeros(target.shape[1], np.float32),
        target_scale=np.array([RELEASED_PLACE_MM] * 2 + [RELEASED_FORCE_N] * (target.shape[1] - 2), np.float32),
    )


FIT: Mapping[str, Callable[[np.ndarray, np.ndarray], Scaler]] = {"standard": fit_standard, "released": fit_released}


def _floored(scale: np.ndarray) -> Float32[np.ndarray, " c"]:
    return np.maximum(scale, SCALE_FLOOR).astype(np.float32)

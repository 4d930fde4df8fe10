"""Convert field changes to the inputs of models, and targets to scaled outputs.

A view is a fixed function of the field change of a row. A scaler converts a view to a network's scaled inputs, and
converts between targets in physical units and scaled outputs. It is fitted only to training rows, so that it contains
no information about test rows.
"""

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass

import numpy as np
from jaxtyping import Float32

# Assumed lower limit of |dB|, the norm of the field change. It is below the noise of the norm (3 uT per channel, about
# 15 uT for 15 channels). The logarithm of this limit is 0, so all inputs are 0 if the field change is 0.
DB_FLOOR_uT = 1.0
# Lower limit of scales, which avoids a division by zero for channels that are constant in training.
SCALE_FLOOR = np.float32(1e-6)
RELEASED_INPUT_SDS = np.float32(5.0)  # about the scale of the inputs in the network that the authors released
RELEASED_PLACE_MM, RELEASED_FORCE_N = 16.0, 3.0


def raw(db_uT: Float32[np.ndarray, "f ch"]) -> Float32[np.ndarray, "f ch"]:
    return db_uT


def shape(db_uT: Float32[np.ndarray, "f ch"]) -> Float32[np.ndarray, "f c"]:
    """Return dB / |dB|, which is independent of the strength of the magnets, and the natural logarithm of |dB| / uT."""
    length_uT = np.linalg.norm(db_uT.astype(np.float64), axis=1, keepdims=True)  # [f 1]
    floored_uT = np.maximum(length_uT, DB_FLOOR_uT)
    return np.hstack([db_uT / floored_uT, np.log(floored_uT)]).astype(np.float32)


VIEW: Mapping[str, Callable[[Float32[np.ndarray, "f ch"]], Float32[np.ndarray, "f c"]]] = {"raw": raw, "shape": shape}


@dataclass(frozen=True)
class Scaler:
    """Scaling of a network's inputs and outputs.

    inputs = (view - input_shift) / input_scale, and (x_mm, y_mm, F_N) = outputs * target_scale + target_shift.
    """

    input_shift: Float32[np.ndarray, " ch"]
    input_scale: Float32[np.ndarray, " ch"]
    target_shift: Float32[np.ndarray, " t"]
    target_scale: Float32[np.ndarray, " t"]

    def encode(self, db_uT: Float32[np.ndarray, "f ch"]) -> Float32[np.ndarray, "f ch"]:
        return (db_uT - self.input_shift) / self.input_scale

    def encode_target(self, target: Float32[np.ndarray, "f t"]) -> Float32[np.ndarray, "f t"]:
        """Convert places and forces (mm, mm, N) to scaled targets."""
        return (target - self.target_shift) / self.target_scale

    def decode(self, scaled: Float32[np.ndarray, "f t"]) -> Float32[np.ndarray, "f t"]:
        """Convert outputs of a network to places and forces (mm, mm, N)."""
        return scaled * self.target_scale + self.target_shift

    def arrays(self) -> dict[str, np.ndarray]:
        return asdict(self)

    @classmethod
    def of_arrays(cls, arrays: Mapping[str, np.ndarray]) -> "Scaler":
        return cls(**{name: arrays[name] for name in cls.__dataclass_fields__})


def fit_standard(db_uT: Float32[np.ndarray, "f ch"], target: Float32[np.ndarray, "f t"]) -> Scaler:
    """Fit a scaler that gives each channel and target a mean of 0 and a standard deviation of 1."""
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
    """Fit the scaling of the authors' released network: channels / (5 sd), x / 16 mm, y / 16 mm, F / 3 N.

    Means are not subtracted.
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

"""Simulation of the MLX90393 magnetometer: the times of its conversions, and the errors of its readings.

A conversion is one measurement of the field by the chip. The errors are noise, limited range and quantisation.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float, Float32, Int
from pydantic import Field
from scipy.constants import micro

from reskin.config import Strict
from reskin.physics.board import Board

# Factors by which the step between raw readings grows with the settings GAIN_SEL 0 to 7 (data sheet, table 17).
GAINS = (5.0, 4.0, 3.0, 2.5, 2.0, 5 / 3, 4 / 3, 1.0)
STEP_AT_GAIN_ONE_uT = (0.150, 0.150, 0.242)  # step between raw readings of x, y and z, for RES 0 (data sheet)
# The raw temperature reading is TEMPERATURE_ZERO_RAW at TEMPERATURE_ZERO_DEGC (data sheet).
TEMPERATURE_ZERO_DEGC, TEMPERATURE_ZERO_RAW, TEMPERATURE_STEPS_PER_DEGC = 25.0, 46244, 45.2
FIELD_MAX_T = 50e-3  # field at which a reading saturates, on any axis and at any gain (data sheet)


class ChipDesign(Strict):
    """Settings of the chips: the gain that the firmware selects, and the standard deviations of a reading's noise."""

    gain_sel: Annotated[int, Field(ge=0, le=7)]
    noise_xy_uT: Annotated[float, Field(ge=0, le=100)]
    noise_z_uT: Annotated[float, Field(ge=0, le=100)]
    noise_temperature_degC: Annotated[float, Field(ge=0, le=10)]


@dataclass(frozen=True)
class Overruns:
    """Numbers of values that are outside the range of the chips."""

    clipped_n: int  # fields above 50 mT, which are clipped
    wrapped_n: int  # readings that do not fit into an int16, so that they wrap around


def steps_uT(gain_sel: int) -> Float[np.ndarray, " 3"]:
    """Return the difference in uT between successive raw readings of x, y and z, for a gain setting."""
    return np.array(STEP_AT_GAIN_ONE_uT) * GAINS[gain_sel]


def read_field(
    b_T: Float[np.ndarray, "f k 3"], board: Board, *, design: ChipDesign, rng: np.random.Generator
) -> tuple[Float32[np.ndarray, "f ch"], Overruns]:
    """Simulate the readings of k chips in f frames, given the field at each chip and frame.

    The field is in the coordinate system of the board, and the readings are along the axes of each chip. The readings
    include the offsets and sensitivities of the chips, noise, clipping, quantisation, and the overflow of an int16.
    """
    to_chip = board.sensitivity @ board.turn.transpose(0, 2, 1)
    chip_T = np.einsum("kij,fkj->fki", to_chip, b_T)
    clipped_n = int(np.count_nonzero(np.abs(chip_T) > FIELD_MAX_T))
    b_uT = (chip_T.clip(-FIELD_MAX_T, FIELD_MAX_T) + board.offset_T) / micro
    noise_uT = np.array([design.noise_xy_uT, design.noise_xy_uT, design.noise_z_uT])
    b_uT += noise_uT * rng.standard_normal(b_uT.shape)
    step_uT = steps_uT(design.gain_sel)
    counts = np.rint(b_uT / step_uT).astype(np.int64)
    wrapped = (counts + 2**15) % 2**16 - 2**15
    read_uT = (wrapped * step_uT).astype(np.float32).reshape(len(b_T), -1)
    return read_uT, Overruns(clipped_n, int(np.count_nonzero(wrapped != counts)))


def read_temperature(
    temperature_degC: Float[np.ndarray, "f k"], design: ChipDesign, rng: np.random.Generator
) -> Float32[np.ndarray, "f k"]:
    """Simulate the temperature readings of the chips, which include noise and are quantised in steps of 1/45.2 degC."""
    noisy_degC = temperature_degC + design.noise_temperature_degC * rng.standard_normal(temperature_degC.shape)
    raw = np.rint(TEMPERATURE_ZERO_RAW + (noisy_degC - TEMPERATURE_ZERO_DEGC) * TEMPERATURE_STEPS_PER_DEGC)
    read_degC = TEMPERATURE_ZERO_DEGC + (raw - TEMPERATURE_ZERO_RAW) / TEMPERATURE_STEPS_PER_DEGC
    return read_degC.astype(np.float32)


CONVERSION_S = 1.84e-3  # time of one conversion of the MLX90393 at OSR 0 and DIG_FILT 2 (data sheet)
OSR_MAX, DIG_FILT_MAX = 3, 7
# Table 18 of the data sheet has the total time of a measurement. This total is longer than the sum of the times of the
# single conversions by START_AND_END_S.
START_AND_END_S = 232e-6


def conversion_s(osr: int, dig_filt: int) -> float:
    """Return the time in s that a chip needs to measure X, Y, Z and the temperature once.

    The time depends on the chip's settings OSR and DIG_FILT. The setting OSR2, which affects the temperature, is
    assumed to be 0. The data sheet has formulas for the time of one axis and for the time of the temperature. Tests
    compare the total time with table 18 of the data sheet.
    """
    axis_s = 67e-6 + 64e-6 * 2**osr * (2 + 2**dig_filt)
    temperature_s = 67e-6 + 192e-6
    return 3 * axis_s + temperature_s + START_AND_END_S


def last_conversions(
    frame_s: Float[np.ndarray, " f"], phase_s: Float[np.ndarray, " k"]
) -> tuple[Float[np.ndarray, "f k"], Int[np.ndarray, "f k"]]:
    """Find the last conversion of each chip before each frame.

    Each chip makes one conversion every `CONVERSION_S`, independently of the other chips and of the frames. A frame
    contains the last conversion of each chip. If a chip makes no conversion between two successive frames, both frames
    therefore contain the same conversion of this chip.

    Parameters
    ----------
    frame_s : time of each frame
    phase_s : time of each chip's first conversion

    Returns
    -------
    age_s : time from a chip's last conversion to the frame, for each frame and chip
    source_i : index of the first frame that contains the same conversion, for each frame and chip
    """
    conversion = np.floor((frame_s[:, None] - phase_s) / CONVERSION_S)
    age_s = frame_s[:, None] - phase_s - conversion * CONVERSION_S
    fresh = np.ones(conversion.shape, bool)
    fresh[1:] = conversion[1:] != conversion[:-1]
    frame_i = np.arange(len(frame_s))[:, None]
    return age_s, np.maximum.accumulate(np.where(fresh, frame_i, 0), axis=0)


def sample_at_conversion(
    value: Float[np.ndarray, "f k a"], age_s: Float[np.ndarray, "f k"], rate_hz: float
) -> Float[np.ndarray, "f k a"]:
    """Interpolate values to the times of the conversions, linearly between the frames.

    `value` has the values at the times of the frames. The last conversion of a chip was made `age_s` before the frame.
    """
    frames_n, chips_n = age_s.shape
    place = np.maximum(np.arange(frames_n)[:, None] - age_s * rate_hz, 0.0)
    before = np.minimum(place.astype(np.intp), max(frames_n - 2, 0))
    after = np.minimum(before + 1, frames_n - 1)
    share = (place - before)[:, :, None]
    chip = np.arange(chips_n)
    return (1 - share) * value[before, chip] + share * value[after, chip]

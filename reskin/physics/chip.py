"""The MLX90393 magnetometer: conversion time, noise, range and quantisation of its readings."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float, Float32, Int
from pydantic import Field
from scipy.constants import micro

from reskin.config import Strict
from reskin.physics.board import Board

GAINS = (5.0, 4.0, 3.0, 2.5, 2.0, 5 / 3, 4 / 3, 1.0)  # for GAIN_SEL 0 to 7 (data sheet, table 17)
STEP_AT_GAIN_ONE_uT = (0.150, 0.150, 0.242)  # for RES 0, on x, y and z (data sheet)
TEMPERATURE_ZERO_DEGC, TEMPERATURE_ZERO_RAW, TEMPERATURE_STEPS_PER_DEGC = 25.0, 46244, 45.2  # data sheet
FIELD_MAX_T = 50e-3  # saturation on any axis, at any gain (data sheet)


class ChipDesign(Strict):
    """Gain setting of the firmware, and standard deviations of the noise of one reading."""

    gain_sel: Annotated[int, Field(ge=0, le=7)]
    noise_xy_uT: Annotated[float, Field(ge=0, le=100)]
    noise_z_uT: Annotated[float, Field(ge=0, le=100)]
    noise_temperature_degC: Annotated[float, Field(ge=0, le=10)]


@dataclass(frozen=True)
class Overruns:
    """Numbers of values out of range: fields clipped at 50 mT, and readings that overflow int16 and wrap around."""

    clipped_n: int
    wrapped_n: int


def steps_uT(gain_sel: int) -> Float[np.ndarray, " 3"]:
    """Return the field step in uT between successive raw readings, on x, y and z."""
    return np.array(STEP_AT_GAIN_ONE_uT) * GAINS[gain_sel]


def read_field(
    b_T: Float[np.ndarray, "f k 3"], board: Board, *, design: ChipDesign, rng: np.random.Generator
) -> tuple[Float32[np.ndarray, "f ch"], Overruns]:
    """Return the readings of all chips along their own axes, for the field at each chip and frame.

    The readings include the chips' offsets and sensitivities, noise, clipping, quantisation and int16 overflow.
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
    """Return the chips' temperature readings, with noise and quantised in steps of 1/45.2 degC."""
    noisy_degC = temperature_degC + design.noise_temperature_degC * rng.standard_normal(temperature_degC.shape)
    raw = np.rint(TEMPERATURE_ZERO_RAW + (noisy_degC - TEMPERATURE_ZERO_DEGC) * TEMPERATURE_STEPS_PER_DEGC)
    read_degC = TEMPERATURE_ZERO_DEGC + (raw - TEMPERATURE_ZERO_RAW) / TEMPERATURE_STEPS_PER_DEGC
    return read_degC.astype(np.float32)


CONVERSION_S = 1.84e-3  # MLX90393 at OSR 0, DIG_FILT 2 (data sheet)
OSR_MAX, DIG_FILT_MAX = 3, 7
START_AND_END_S = 232e-6  # time that table 18 of the data sheet includes in addition to the conversions


def conversion_s(osr: int, dig_filt: int) -> float:
    """Return the time of one conversion of X, Y, Z and temperature at settings OSR and DIG_FILT, with OSR2 0.

    The data sheet states the time for one axis and the time for temperature. Tests compare the total time with table 18
    of the data sheet.
    """
    axis_s = 67e-6 + 64e-6 * 2**osr * (2 + 2**dig_filt)
    temperature_s = 67e-6 + 192e-6
    return 3 * axis_s + temperature_s + START_AND_END_S


def last_conversions(
    frame_s: Float[np.ndarray, " f"], phase_s: Float[np.ndarray, " k"]
) -> tuple[Float[np.ndarray, "f k"], Int[np.ndarray, "f k"]]:
    """Return the age in s of each chip's last conversion at each frame, and the first frame that has this conversion.

    `phase_s` is the time of each chip's first conversion; further conversions follow every `CONVERSION_S`.
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
    """Interpolate values linearly between frames, at each chip's last conversion (`age_s` before the frame)."""
    frames_n, chips_n = age_s.shape
    place = np.maximum(np.arange(frames_n)[:, None] - age_s * rate_hz, 0.0)
    before = np.minimum(place.astype(np.intp), max(frames_n - 2, 0))
    after = np.minimum(before + 1, frames_n - 1)
    share = (place - before)[:, :, None]
    chip = np.arange(chips_n)
    return (1 - share) * value[before, chip] + share * value[after, chip]

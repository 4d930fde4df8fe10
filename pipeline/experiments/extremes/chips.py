"""Chips in fields beyond their range. References are the data sheet and recorded noise."""

from functools import partial

import numpy as np
from jaxtyping import Float, Float32
from scipy.constants import micro

from pipeline.experiments.extremes.cases import Case, max_error, relative_error
from reskin.physics.board import Board
from reskin.physics.chip import ChipDesign, Overruns, read_field, read_temperature, steps_uT
from reskin.seeds import rng_for

SHEET_uT = (0.150, 0.150, 0.242)  # data sheet: field per count at gain 1 (x, y, z)
SHEET_GAINS = (5.0, 4.0, 3.0, 2.5, 2.0, 1.667, 1.333, 1.0)  # GAIN_SEL 0 to 7
# Ranges of the standard deviation of the noise in three recorded data sets (x and y, z)
RECORDED_NOISE_uT = ((3.0, 3.7), (4.5, 7.0))
STILL_FRAMES_N = 20_000
SATURATED_uT = 50e3


def quiet(gain_sel: int) -> ChipDesign:
    """Return a chip without noise."""
    return ChipDesign(gain_sel=gain_sel, noise_xy_uT=0.0, noise_z_uT=0.0, noise_temperature_degC=0.0)


def read_bare(
    b_uT: Float[np.ndarray, "f 3"], design: ChipDesign, rng: np.random.Generator
) -> tuple[Float32[np.ndarray, "f 3"], Overruns]:
    """Read fields with one chip that is not rotated, and that has a gain of one and no offset."""
    eye = np.eye(3)[None]
    board = Board("bare", np.zeros((1, 3)), eye, eye, np.zeros((1, 3)))
    return read_field((b_uT * micro)[:, None], board, design=design, rng=rng)


def conversion(b_uT: Float[np.ndarray, "f 3"], gain_sel: int) -> float:
    """Return the error of readings in counts; inf if clipped and wrapped values are not counted.

    A chip clips fields at 50 mT; a count beyond 16 bits wraps around.
    """
    read_uT, overruns = read_bare(b_uT, quiet(gain_sel), rng_for(0, "extremes", "chip"))
    counts = b_uT.clip(-SATURATED_uT, SATURATED_uT) / steps_uT(gain_sel)
    wrapped = counts - 2**16 * np.rint(counts / 2**16)
    beyond_n = (int((np.rint(counts) != np.rint(wrapped)).sum()), int((np.abs(b_uT) > SATURATED_uT).sum()))
    error = max_error(read_uT / steps_uT(gain_sel), wrapped)
    return error if beyond_n == (overruns.wrapped_n, overruns.clipped_n) else np.inf


def out_of_range_uT(seed: int) -> Float[np.ndarray, "f 3"]:
    """Return random fields up to 60 mT whose counts are not within a count of a limit."""
    b_uT = rng_for(seed, "extremes", "range").uniform(-60e3, 60e3, (2000, 3))
    counts = b_uT / steps_uT(7)
    return np.where(np.abs(np.abs(counts) % 2**16 - 2**15) < 1, 0.0, b_uT)


def noise_sd_uT(chip: ChipDesign, seed: int) -> Float[np.ndarray, "3"]:
    read_uT, _ = read_bare(np.zeros((STILL_FRAMES_N, 3)), chip, rng_for(seed, "extremes", "noise"))
    return read_uT.std(axis=0)


def noise(chip: ChipDesign, seed: int) -> float:
    design_uT = np.array([chip.noise_xy_uT, chip.noise_xy_uT, chip.noise_z_uT])
    return relative_error(noise_sd_uT(chip, seed), np.sqrt(design_uT**2 + steps_uT(chip.gain_sel) ** 2 / 12))


def beyond_recorded_noise_uT(chip: ChipDesign, seed: int) -> float:
    low_uT, high_uT = np.array([RECORDED_NOISE_uT[axis == 2] for axis in range(3)]).T
    sd_uT = noise_sd_uT(chip, seed)
    return float(np.maximum(low_uT - sd_uT, sd_uT - high_uT).clip(min=0).max())


def temperature(seed: int) -> float:
    rng = rng_for(seed, "extremes", "temperature")
    true_degC = rng.uniform(0, 60, (500, 5))
    raw = np.rint((true_degC - 25) * 45.2 + 46244)  # counts, by the inverse of the data sheet's formula
    return max_error(read_temperature(true_degC, quiet(7), rng), 25 + (raw - 46244) / 45.2)


_case = partial(Case, "chip")
CASES: tuple[Case, ...] = (
    _case("steps", "field per count, all gains", "data sheet, 0.150 uT (x, y) and 0.242 uT (z) times the gain",
         lambda _: relative_error(np.array([steps_uT(i) for i in range(8)]), np.outer(SHEET_GAINS, SHEET_uT)), 3e-4,
         "The gains 5/3 and 4/3 are published with three decimals."),
    _case("range", "readings of fields up to 60 mT at GAIN_SEL 7, whose range is 4.9 mT (x, y) and 7.9 mT (z)",
         "clipped at 50 mT, wrapped to 16 bits; both counted", lambda w: conversion(out_of_range_uT(w.seed), 7), 0.51,
         "Readings are rounded to whole counts.", unit="counts"),
    _case("noise", "noise of a board at rest", "standard deviation in the settings, and rounding to counts",
         lambda w: noise(w.simulation.chip, w.seed), 4 / np.sqrt(2 * STILL_FRAMES_N), "Four standard errors."),
    _case("recorded_noise", "noise of a board at rest, distance from the range of recorded noise",
         "3.0-3.7 uT in x and y, 4.5-7.0 uT in z", lambda w: beyond_recorded_noise_uT(w.simulation.chip, w.seed), 0.1,
         "The recorded values have two digits.", unit="uT"),
    _case("temperature", "temperature", "25 + (raw - 46244) / 45.2, data sheet", lambda w: temperature(w.seed),
         4e-6, "Rounding errors of float32 are largest at 60 degC.", unit="degC"),
)  # fmt: skip

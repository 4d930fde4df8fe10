"""Laws of the chip, against its data sheet and recorded boards. In: a chip's design. Out: checks.

The data sheet's numbers stand here a second time, so that a wrong one there cannot vouch for itself.
Refuses to know where the field comes from, and what becomes of readings.
"""

import numpy as np
from jaxtyping import Float, Float32
from scipy.constants import micro, milli

from pipeline.experiments.verification.checks import Check, farthest, relative
from reskin.physics.board import Board
from reskin.physics.chip import ChipDesign, Overruns, read_field, read_temperature, steps_uT
from reskin.seeds import rng_for

PUBLISHED_STEPS_uT = {7: (0.150, 0.150, 0.242), 6: (0.200, 0.200, 0.3227)}  # by GAIN_SEL; RES 0
PUBLISHED_GAINS = (5.0, 4.0, 3.0, 2.5, 2.0, 1.667, 1.333, 1.0)  # GAIN_SEL 0 to 7
RECORDED_NOISE_uT = ((3.0, 3.7), (4.5, 7.0))  # sd on x, y and on z, of three recorded data sets (PHYSICS 6)
STILL_FRAMES_N = 20_000


def check_electronics(chip: ChipDesign, seed: int) -> list[Check]:
    """Check the conversion, the wrap of int16, the temperature and the noise of a scene's chip."""
    return [*steps(), *conversion(chip.gain_sel, seed), *noise(chip, seed), temperature(seed)]


def quiet(gain_sel: int) -> ChipDesign:
    """Give a chip without noise."""
    return ChipDesign(gain_sel=gain_sel, noise_xy_uT=0.0, noise_z_uT=0.0, noise_temperature_degC=0.0)


def read_bare(
    b_T: Float[np.ndarray, "f 3"], design: ChipDesign, rng: np.random.Generator
) -> tuple[Float32[np.ndarray, "f 3"], Overruns]:
    """Read a field with one chip that is not turned, of gain one and without offset."""
    eye = np.eye(3)[None]
    return read_field(b_T[:, None], Board("bare", np.zeros((1, 3)), eye, eye, np.zeros((1, 3))), design=design, rng=rng)


def steps() -> list[Check]:
    sheet = np.array([[PUBLISHED_STEPS_uT[7][axis] * gain for axis in range(3)] for gain in PUBLISHED_GAINS])
    ours = np.array([steps_uT(gain_sel) for gain_sel in range(8)])
    published = max(farthest(ours[gain_sel], np.array(step)) for gain_sel, step in PUBLISHED_STEPS_uT.items())
    return [
        Check("chip", "uT a count, GAIN_SEL 6 and 7", "data sheet, as the firmware's authors publish it", published,
              "uT", 5e-5, "four published decimals"),
        Check("chip", "uT a count, all gains", "data sheet, 0.150 / 0.242 uT times the gain", relative(ours, sheet),
              "1", 3e-4, "three published decimals of 5/3 and 4/3"),
    ]  # fmt: skip


def conversion(gain_sel: int, seed: int) -> list[Check]:
    rng, step_uT = rng_for(seed, "verification", "chip"), steps_uT(gain_sel)
    field_uT = (rng.uniform(-1, 1, (2000, 3)) * 0.99 * 2**15 * step_uT).clip(-49e3, 49e3)
    inside_uT, _ = read_bare(field_uT * micro, quiet(gain_sel), rng)
    past_uT = rng.uniform(-50, 50, (2000, 3)) * milli / micro
    read_uT, _ = read_bare(past_uT * micro, quiet(7), rng)
    counts = np.rint(past_uT / PUBLISHED_STEPS_uT[7]).astype(np.int64)
    int16_uT = counts.astype("<i8").view("<i2")[:, ::4] * np.array(PUBLISHED_STEPS_uT[7])
    return [
        Check("chip", f"a reading is the field, GAIN_SEL {gain_sel}, 99 % of the range", "the field",
              float((np.abs(inside_uT - field_uT) / step_uT).max()), "counts", 0.51,
              "half a count, and the rounding of float32"),
        Check("chip", "past its range, GAIN_SEL 7, to 50 mT", "the lower 16 bits of the count",
              float((np.abs(read_uT - int16_uT) / PUBLISHED_STEPS_uT[7]).max()), "counts", 0.01, "rounding of float32"),
    ]  # fmt: skip


def noise(chip: ChipDesign, seed: int) -> list[Check]:
    read_uT, _ = read_bare(np.zeros((STILL_FRAMES_N, 3)), chip, rng_for(seed, "verification", "noise"))
    sd_uT = read_uT.std(axis=0)
    # The noise of the design, and the error of a count that is rounded.
    design_uT = np.array([chip.noise_xy_uT, chip.noise_xy_uT, chip.noise_z_uT])
    expected_uT = np.sqrt(design_uT**2 + steps_uT(chip.gain_sel) ** 2 / 12)
    low_uT, high_uT = np.array([RECORDED_NOISE_uT[axis == 2] for axis in range(3)]).T
    outside_uT = np.maximum(low_uT - sd_uT, sd_uT - high_uT).clip(min=0)
    return [
        Check("chip", "noise of a still board", "the design's sd, and a count's rounding", relative(sd_uT, expected_uT),
              "1", 4 / np.sqrt(2 * STILL_FRAMES_N), f"{STILL_FRAMES_N} frames: 4 times 1 / sqrt(2 n)"),
        Check("chip", "noise of a still board, how far outside the recorded", "sd 3.0-3.7 uT in x, y, 4.5-7.0 uT in z",
              float(outside_uT.max()), "uT", 0.1, "sampling, and the two digits of the recorded"),
    ]  # fmt: skip


def temperature(seed: int) -> Check:
    rng = rng_for(seed, "verification", "temperature")
    true_degC = rng.uniform(0, 60, (500, 5))
    raw = np.rint((true_degC - 25) * 45.2 + 46244)  # counts of the data sheet, back by its own formula
    error_degC = farthest(read_temperature(true_degC, quiet(7), rng), 25 + (raw - 46244) / 45.2)
    return Check("chip", "temperature", "25 + (raw - 46244) / 45.2, data sheet", error_degC, "degC", 4e-6,
                 "rounding of float32 near 60")  # fmt: skip

"""Fields at stops become frames as chips read them. In: contact response, timeline, board and chips. Out: readings.

Block by block: only one block of fields is held at a time. Refuses to know what made the fields.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Float64

from pipeline.physics import conversion, warmth
from pipeline.physics.board import Board
from pipeline.physics.sensor import ChipDesign, read_field, read_temperature
from pipeline.physics.warmth import ROOM_DEGC, Temperature
from pipeline.synthesis.contact import Response
from pipeline.synthesis.rig import Timeline

BLOCK_INDENTATIONS_N = 1000


@dataclass(frozen=True)
class Frames:
    """Readings in order of time, and how many values were out of the chips' range."""

    b_uT: Float32[np.ndarray, "f ch"]
    temperature_degC: Float32[np.ndarray, "f k"]
    clipped_n: int
    wrapped_n: int


@dataclass(frozen=True)
class Reader:
    """Chips that read one capture: each converts at its phase, and may be sensitive to temperature."""

    board: Board
    chip: ChipDesign
    rate_hz: float
    phase_s: Float64[np.ndarray, " k"]
    temperature: Temperature | None
    sensitivity_per_K: Float64[np.ndarray, " k"]


def switch_on(
    board: Board, chip: ChipDesign, *, rate_hz: float, temperature: Temperature | None, rng: np.random.Generator
) -> Reader:
    """Draw each chip's phase and sensitivity to temperature."""
    chips_n = len(board.chips_m)
    phase_s = conversion.CONVERSION_S * rng.random(chips_n)
    sd = 0.0 if temperature is None else temperature.chip_sensitivity_per_K
    return Reader(board, chip, rate_hz, phase_s, temperature, sd * rng.standard_normal(chips_n))


def read_frames(
    response: Response,
    timeline: Timeline,
    reader: Reader,
    *,
    noise: np.random.Generator,
    warmth_noise: np.random.Generator,
) -> Frames:
    """Read every frame of every indentation; the result does not depend on the size of blocks."""
    frame_s = (1 + np.arange(len(response.rest_T) * len(timeline))) / reader.rate_hz
    age_s, source_i = conversion.last_conversions(frame_s, reader.phase_s)
    b_uT, temperature_degC, overruns = [], [], []
    for first_i in range(0, len(response.rest_T), BLOCK_INDENTATIONS_N):
        seen_T, chips_degC = _field_at(response, timeline, reader, age_s, first_i)
        block_uT, overrun = read_field(seen_T, reader.board, design=reader.chip, rng=noise)
        b_uT.append(block_uT)
        overruns.append(overrun)
        temperature_degC.append(read_temperature(chips_degC, reader.chip, warmth_noise))
    # A conversion that two frames bring is the same reading twice, its noise included.
    chip_i = np.arange(len(reader.phase_s))
    repeated_uT = np.concatenate(b_uT).reshape(len(frame_s), -1, 3)[source_i, chip_i].reshape(len(frame_s), -1)
    return Frames(
        repeated_uT,
        np.concatenate(temperature_degC)[source_i, chip_i],
        sum(overrun.clipped_n for overrun in overruns),
        sum(overrun.wrapped_n for overrun in overruns),
    )


def _field_at(
    response: Response, timeline: Timeline, reader: Reader, age_s: Float[np.ndarray, "f k"], first_i: int
) -> tuple[Float[np.ndarray, "b k 3"], Float[np.ndarray, "b k"]]:
    # What is read in a block's first frames may have been converted in the indentation before.
    lead_n = len(timeline) if first_i else 0
    block = slice(first_i - (1 if first_i else 0), first_i + BLOCK_INDENTATIONS_N)
    b_T = response.rest_T[block, None] + timeline.share[:, None, None] * response.change_T[block, timeline.stop_i]
    frames_n, start = b_T.shape[0] * b_T.shape[1], block.start * len(timeline)
    b_T = b_T.reshape(frames_n, *b_T.shape[2:])
    warm_degC = np.full(frames_n, ROOM_DEGC)
    if reader.temperature is not None:
        warmer_K = warmth.warmer_K((1 + start + np.arange(frames_n)) / reader.rate_hz, reader.temperature)
        warm_degC += warmer_K
        gain = warmth.remanence(warmer_K)[:, None] * (1 + warmer_K[:, None] * reader.sensitivity_per_K)  # [f k]
        b_T *= gain[:, :, None]
    seen_T = conversion.seen_at(b_T, age_s[start : start + frames_n], reader.rate_hz)
    return seen_T[lead_n:], np.repeat(warm_degC[lead_n:, None], len(reader.phase_s), axis=1)

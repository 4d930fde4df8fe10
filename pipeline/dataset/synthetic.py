"""A capture of a skin that does not exist. In: parameters and names. Out: what a port and a probe would have written.

Simplified: a frame on the way down or up is a share of the full change of field, dwells are as short as their frames,
passes differ by noise alone. Refuses to know bytes (`capture.wire`) and files: a stage encodes and writes.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float32, Float64, Int64
from pydantic import Field
from scipy.constants import milli

from pipeline.capture.probe import ProbeLog
from pipeline.dataset.grid import CENTRE_MM, Protocol, protocol
from pipeline.physics.board import Board, BoardDesign, Spreads, draw_board
from pipeline.physics.sensor import ChipDesign, read_field, read_temperature
from pipeline.physics.skin import Skin, SkinDesign, changes_of_field, draw_skin, forces
from pipeline.seeds import rng_for
from pipeline.strict import Strict

ROOM_DEGC = 25.0
Count = Annotated[int, Field(ge=1, le=1000)]


class Recording(Strict):
    """How a capture is taken: protocol, rate, clocks and the probe's noise."""

    passes_n: Count
    depths_mm: Annotated[tuple[Annotated[float, Field(gt=0, le=10)], ...], Field(min_length=1)]
    noload_frames_n: Count
    moving_frames_n: Annotated[int, Field(ge=0, le=1000)]  # on the way down, and as many on the way up
    readings_n: Count
    rate_hz: Annotated[float, Field(gt=0, le=1e4)]
    chunk_frames_max_n: Count
    arrival_jitter_s: Annotated[float, Field(ge=0, le=1)]  # mean delay of a chunk, exponential
    probe_clock_offset_s: Annotated[float, Field(ge=0, le=1e6)]  # sd of the probe's clock minus the stream's
    probe_clock_rate_error: Annotated[float, Field(ge=0, le=0.01)]  # sd
    force_noise_N: Annotated[float, Field(ge=0, le=10)]


class Synthesis(Strict):
    """Section `simulate` of a scene: which skins there are, what they are like and how they are recorded."""

    boards_n: Count
    skins_per_board_n: Count
    recording: Recording
    skin: SkinDesign
    board: BoardDesign
    chip: ChipDesign
    spreads: Spreads


@dataclass(frozen=True)
class SyntheticCapture:
    """One capture before it is encoded: frames in order of time, chunks as they arrived, probe log, clock marks."""

    board: str
    skin: str
    b_uT: Float32[np.ndarray, "f ch"]
    temperature_degC: Float32[np.ndarray, "f k"]
    arrived_frames_n: Int64[np.ndarray, " c"]  # frames come in all; the first row is 0, at the start
    arrived_s: Float64[np.ndarray, " c"]  # on the stream's clock
    probe: ProbeLog
    marks: tuple[tuple[float, float], ...]  # (stream_s, probe_s) of the same event
    wrapped_n: int  # values past the chip's range


def roster(parameters: Synthesis) -> list[tuple[str, str]]:
    """Name every (board, skin); more boards or skins leave the others' names, and so their draws, as they are."""
    boards = [f"b{board_i}" for board_i in range(parameters.boards_n)]
    return [(board, f"{board}_s{skin_i}") for board in boards for skin_i in range(parameters.skins_per_board_n)]


def record_skin(parameters: Synthesis, board: str, *, skin: str, seed: int) -> SyntheticCapture:
    """Draw the board and the skin of these names, poke the skin through the whole protocol, and record it."""
    how = parameters.recording
    rng = rng_for(seed, "recording", board, skin)
    drawn_board = draw_board(parameters.board, parameters.spreads, seed=seed, name=board)
    drawn_skin = draw_skin(parameters.skin, parameters.spreads, seed=seed, name=skin)
    plan = protocol(how.depths_mm, how.passes_n)
    b_T = _field_at_frames(drawn_board, drawn_skin, plan, how)
    b_uT, wrapped_n = read_field(b_T, drawn_board, design=parameters.chip, rng=rng)
    room_degC = np.full(b_T.shape[:2], ROOM_DEGC)
    frame_s = (1 + np.arange(len(b_T))) / how.rate_hz
    arrived_frames_n, arrived_s = _chunks(frame_s, how, rng)
    offset_s = how.probe_clock_offset_s * rng.standard_normal()
    rate = 1 + how.probe_clock_rate_error * rng.standard_normal()
    return SyntheticCapture(
        board=board,
        skin=skin,
        b_uT=b_uT,
        temperature_degC=read_temperature(room_degC, parameters.chip, rng),
        arrived_frames_n=arrived_frames_n,
        arrived_s=arrived_s,
        probe=_probe_log(plan, forces(drawn_skin, plan.depth_mm * milli), how, clock=(offset_s, rate), rng=rng),
        marks=tuple((float(t_s), float(offset_s + rate * t_s)) for t_s in frame_s[[0, -1]]),
        wrapped_n=wrapped_n,
    )


def _shares(how: Recording) -> Float64[np.ndarray, " t"]:
    # How much of its full change of field each frame of one indentation sees: lifted, going down, dwelling, going up.
    ramp = np.arange(1, how.moving_frames_n + 1) / (how.moving_frames_n + 1)
    return np.concatenate([np.zeros(how.noload_frames_n), ramp, np.ones(how.readings_n), ramp[::-1]])


def _field_at_frames(board: Board, skin: Skin, plan: Protocol, how: Recording) -> Float64[np.ndarray, "f k 3"]:
    pokes_m = np.column_stack([plan.x_mm - CENTRE_MM, plan.y_mm - CENTRE_MM, plan.depth_mm]) * milli
    one_pass_m = pokes_m[plan.pass_i == 0]
    rest_T, changes_T = changes_of_field(board, skin, one_pass_m)
    each_T = changes_T[:, None] * _shares(how)[:, None, None]
    return rest_T + np.tile(each_T.reshape(-1, *rest_T.shape), (how.passes_n, 1, 1))


def _chunks(
    frame_s: Float64[np.ndarray, " f"], how: Recording, rng: np.random.Generator
) -> tuple[Int64[np.ndarray, " c"], Float64[np.ndarray, " c"]]:
    # USB hands over a few frames at once, never before the last of them and never out of order.
    frames_n = len(frame_s)
    sizes = rng.integers(1, how.chunk_frames_max_n + 1, size=frames_n)
    ends = np.cumsum(sizes)
    ends = np.append(ends[ends < frames_n], frames_n)
    arrival_s = frame_s[ends - 1] + how.arrival_jitter_s * rng.standard_exponential(len(ends))
    return np.append(0, ends), np.append(0.0, np.maximum.accumulate(arrival_s))


def _probe_log(
    plan: Protocol,
    force_N: Float64[np.ndarray, " n"],
    how: Recording,
    *,
    clock: tuple[float, float],
    rng: np.random.Generator,
) -> ProbeLog:
    # A dwell runs from half a frame before its first frame to half a frame after its last.
    offset_s, rate = clock
    contact_i = how.noload_frames_n + how.moving_frames_n
    start_i = plan.indentation[:, None] * len(_shares(how)) + np.array([0, contact_i])
    frames_n = np.array([how.noload_frames_n, how.readings_n])
    contact = np.tile([False, True], len(plan))
    noise_N = (how.force_noise_N * rng.standard_normal((3, 2 * len(plan)))).astype(np.float32)
    return ProbeLog(
        indentation=np.repeat(plan.indentation, 2),
        pass_i=np.repeat(plan.pass_i, 2),
        contact=contact,
        t_start_s=offset_s + rate * (start_i + 0.5).ravel() / how.rate_hz,
        t_end_s=offset_s + rate * (start_i + frames_n + 0.5).ravel() / how.rate_hz,
        x_mm=np.repeat(plan.x_mm, 2).astype(np.float32),
        y_mm=np.repeat(plan.y_mm, 2).astype(np.float32),
        depth_mm=(np.repeat(plan.depth_mm, 2) * contact).astype(np.float32),
        Fx_N=noise_N[0],
        Fy_N=noise_N[1],
        Fz_N=(np.repeat(force_N, 2) * contact).astype(np.float32) + noise_N[2],
    )

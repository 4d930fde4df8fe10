"""The simulated rig: a robot with a force sensor, and the readout of a board.

The simulation of the rig produces the frames that the board sends, and the probe log, which is the log of the robot and
the force sensor.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float, Float32, Float64, Int64
from pydantic import Field

from reskin.config import Strict
from reskin.physics import aging, chip
from reskin.physics.aging import ROOM_DEGC, Temperature
from reskin.physics.board import Board
from reskin.physics.chip import ChipDesign, read_field, read_temperature
from reskin.recordings.probe import ProbeLog
from reskin.simulation.contact import Response
from reskin.simulation.protocols import Plan, Protocol, Rate_hz, Walk

FrameCount = Annotated[int, Field(ge=1, le=1000)]
Spread = Annotated[float, Field(ge=0, le=1)]


class Rig(Strict):
    """Section `rig` of the settings.

    The settings are the numbers of frames in the phases of an indentation, the errors of the robot and the force
    sensor, and the timing of the port and the clocks. A dwell is a time in which the tip rests while readings are
    taken.
    """

    noload_frames_n: FrameCount  # frames in the dwell above the skin, before each indentation
    # frames while the tip moves down, and the same number of frames while it moves up
    moving_frames_n: Annotated[int, Field(ge=0, le=1000)]
    # frames between the end of a movement and the start of a dwell, while the tip rests but readings are not yet used
    settling_frames_n: Annotated[int, Field(ge=0, le=1000)]
    readings_n: FrameCount  # frames in the dwell at each stop
    rate_hz: Rate_hz
    robot_place_sd_mm: Spread  # standard deviation of the robot's error along x and along y, for each indentation
    robot_depth_sd_mm: Annotated[float, Field(ge=0, le=0.2)]  # standard deviation of the robot's error of the depth
    # Standard deviation of the difference between true place and label along x and along y. The difference is the same
    # for all indentations on a board.
    place_offset_sd_mm: Spread
    force_noise_N: Annotated[float, Field(ge=0, le=10)]  # standard deviation of the noise of the force sensor
    chunk_frames_max_n: FrameCount  # largest number of frames that arrive together at the port, as one chunk
    arrival_jitter_s: Annotated[float, Field(ge=0, le=1)]  # mean of the exponentially distributed delay of a chunk
    # standard deviation of the difference between the clock of the probe log and the clock of the stream of frames
    probe_clock_offset_s: Annotated[float, Field(ge=0, le=1e6)]
    # standard deviation of the relative difference between the rates of the two clocks
    probe_clock_rate_error: Annotated[float, Field(ge=0, le=0.01)]


@dataclass(frozen=True)
class Timeline:
    """The t frames of one indentation, which are the same for all indentations of a capture.

    The field in a frame is the no-load field plus a fraction of the field change at one stop.
    """

    stop_i: Int64[np.ndarray, " t"]  # index of this stop, for each frame
    share: Float64[np.ndarray, " t"]  # this fraction, for each frame: 0 above the skin, and 1 at the stop
    noload_i: int  # index of the first frame of the no-load dwell
    contact_i: Int64[np.ndarray, " p"]  # index of the first frame of the dwell at each stop

    def __len__(self) -> int:
        return len(self.stop_i)


def rig_for(rig: Rig, protocol: Protocol) -> Rig:
    """Return the settings of the rig with the changes that a protocol needs.

    If the protocol sets a frame rate, it replaces the frame rate of the rig. The protocol `walk` has one frame per
    stop and no robot, so the errors of the robot and the noise of the force are set to zero, and the probe log has the
    same clock as the stream.
    """
    changes: dict[str, float] = {} if protocol.rate_hz is None else {"rate_hz": protocol.rate_hz}
    if isinstance(protocol, Walk):
        changes |= {
            "moving_frames_n": 0,
            "settling_frames_n": 0,
            "readings_n": 1,
            "noload_frames_n": max(round(protocol.quiet_s * protocol.rate_hz), 1),
            "robot_place_sd_mm": 0.0,
            "place_offset_sd_mm": 0.0,
            "robot_depth_sd_mm": 0.0,
            "force_noise_N": 0.0,
            "probe_clock_offset_s": 0.0,
            "probe_clock_rate_error": 0.0,
        }
    return rig.model_copy(update=changes)


def timeline(rig: Rig, stops_n: int) -> Timeline:
    """Create the timeline of an indentation.

    First, the tip settles and dwells above the skin. Then it moves down, and settles and dwells at each stop. Finally,
    it moves up.
    """
    ramp = np.arange(1, rig.moving_frames_n + 1) / (rig.moving_frames_n + 1)
    lifted_n, dwell_n = rig.settling_frames_n + rig.noload_frames_n, rig.settling_frames_n + rig.readings_n
    share = np.concatenate([np.zeros(lifted_n), ramp, np.ones(stops_n * dwell_n), ramp[::-1]])
    before_i = lifted_n + rig.moving_frames_n
    stop_i = np.clip((np.arange(len(share)) - before_i) // dwell_n, 0, stops_n - 1)
    contact_i = before_i + dwell_n * np.arange(stops_n) + rig.settling_frames_n
    return Timeline(stop_i, share, rig.settling_frames_n, contact_i)


def actual_positions(plan: Plan, rig: Rig, rng: np.random.Generator) -> Float64[np.ndarray, "n p 3"]:
    """Return the true positions (x, y and depth in mm) of the tip: the planned positions plus the robot's error.

    The error is the same for all stops of an indentation. A plan without labels describes presses by hand, in which no
    robot makes errors. Its planned positions are therefore the true positions.
    """
    planned_mm = np.stack([plan.x_mm, plan.y_mm, plan.depth_mm], axis=2)
    if not plan.labelled:
        return planned_mm
    sd_mm = np.array([rig.robot_place_sd_mm, rig.robot_place_sd_mm, rig.robot_depth_sd_mm])
    return planned_mm + sd_mm * rng.standard_normal((len(plan), 1, 3))


def draw_arrivals(
    frame_s: Float64[np.ndarray, " f"], rig: Rig, rng: np.random.Generator
) -> tuple[Int64[np.ndarray, " c"], Float64[np.ndarray, " c"]]:
    """Divide the frames at random into chunks, and draw the arrival time of each chunk.

    Returns
    -------
    frames_n : number of frames up to the end of each chunk; starts with 0
    arrived_s : arrival time in s of each chunk; starts with 0
    """
    frames_n = len(frame_s)
    sizes = rng.integers(1, rig.chunk_frames_max_n + 1, size=frames_n)
    ends = np.cumsum(sizes)
    ends = np.append(ends[ends < frames_n], frames_n)
    arrival_s = frame_s[ends - 1] + rig.arrival_jitter_s * rng.standard_exponential(len(ends))
    return np.append(0, ends), np.append(0.0, np.maximum.accumulate(arrival_s))


def draw_clock(rig: Rig, rng: np.random.Generator) -> tuple[float, float]:
    """Draw the offset in s and the rate of the clock of the probe log, relative to the clock of the stream."""
    offset_s, error = rng.standard_normal(2) * (rig.probe_clock_offset_s, rig.probe_clock_rate_error)
    return float(offset_s), float(1 + error)


def probe_log(plan: Plan, read_N: Float[np.ndarray, "n d 3"], rig: Rig, clock: tuple[float, float]) -> ProbeLog:
    """Create the probe log, which is the log of the robot and the force sensor.

    For each indentation, the log has one dwell above the skin and one dwell for each of the p stops, so the number of
    dwells is d = 1 + p. Stops above the skin are not logged. A dwell lasts from half a frame before its first frame to
    half a frame after its last frame.

    Parameters
    ----------
    plan : the planned positions, which are the labels
    read_N : force reading in each dwell
    rig : settings of the rig
    clock : offset and rate of the clock of the probe log, from `draw_clock`
    """
    stops_n = plan.x_mm.shape[1]
    frames = timeline(rig, stops_n)
    offset_s, rate = clock
    first_i = np.append(frames.noload_i, frames.contact_i)
    long_n = np.append(rig.noload_frames_n, np.full(stops_n, rig.readings_n))
    start_i = np.arange(len(plan))[:, None] * len(frames) + first_i
    contact = np.tile(np.arange(1 + stops_n) > 0, len(plan))
    unknown = 0.0 if plan.labelled else np.nan
    depth_mm = np.hstack([np.zeros((len(plan), 1)), plan.depth_mm + unknown])
    places_mm = (np.hstack([stops_mm[:, :1], stops_mm]) + unknown for stops_mm in (plan.x_mm, plan.y_mm))
    force_N = (read_N + unknown).reshape(-1, 3)
    labels = [label.astype(np.float32).ravel() for label in (*places_mm, depth_mm, *force_N.T)]
    dwells = (
        np.repeat(np.arange(len(plan), dtype=np.int32), 1 + stops_n),
        np.repeat(plan.pass_i, 1 + stops_n),
        contact,
        offset_s + rate * (start_i + 0.5).ravel() / rig.rate_hz,
        offset_s + rate * (start_i + long_n + 0.5).ravel() / rig.rate_hz,
        *labels,
    )
    logged = np.hstack([np.ones((len(plan), 1), bool), ~(plan.depth_mm < 0)]).ravel()
    return ProbeLog(*(column[logged] for column in dwells))


# Largest magnitude of each component of the force that the sensor can measure: x, y and z of the ATI Nano17 with the
# calibration SI-25-0.25 (data sheet).
FORCE_RANGE_N = (25.0, 25.0, 35.0)


def read_force(
    force_N: Float[np.ndarray, "n 3"], *, noise_N: float, rng: np.random.Generator
) -> tuple[Float32[np.ndarray, "n 3"], int]:
    """Simulate readings of the force sensor, which have noise and are clipped to the sensor's range.

    Returns
    -------
    read_N : the readings
    clipped_n : number of values that were clipped
    """
    noisy_N = force_N + noise_N * rng.standard_normal(force_N.shape)
    read_N = noisy_N.clip(-np.array(FORCE_RANGE_N), FORCE_RANGE_N)
    return read_N.astype(np.float32), int(np.count_nonzero(read_N != noisy_N))


BLOCK_INDENTATIONS_N = 1000  # number of indentations that are computed at once; limits the use of memory


@dataclass(frozen=True)
class SimulatedFrames:
    """The readings of all chips in f frames, in order of time."""

    b_uT: Float32[np.ndarray, "f ch"]
    temperature_degC: Float32[np.ndarray, "f k"]
    clipped_n: int  # number of clipped fields (see `chip.Overruns`)
    wrapped_n: int  # number of readings that overflowed an int16


@dataclass(frozen=True)
class Readout:
    """The properties of the readout of a board with k chips, which stay the same during one capture."""

    board: Board
    design: ChipDesign
    rate_hz: float  # frame rate
    phase_s: Float64[np.ndarray, " k"]  # time of each chip's first conversion
    temperature: Temperature | None  # None if the temperature is constant
    sensitivity_per_K: Float64[np.ndarray, " k"]  # relative change of each chip's sensitivity per kelvin


def start_readout(
    board: Board, design: ChipDesign, *, rate_hz: float, temperature: Temperature | None, rng: np.random.Generator
) -> Readout:
    """Draw the properties of the chips that differ from capture to capture.

    These are the time of each chip's first conversion, and the change of its sensitivity with the temperature.
    """
    chips_n = len(board.chips_m)
    phase_s = chip.CONVERSION_S * rng.random(chips_n)
    sd = 0.0 if temperature is None else temperature.chip_sensitivity_per_K
    return Readout(board, design, rate_hz, phase_s, temperature, sd * rng.standard_normal(chips_n))


def read_frames(
    response: Response,
    timeline: Timeline,
    readout: Readout,
    *,
    noise: np.random.Generator,
    warmth_noise: np.random.Generator,
) -> SimulatedFrames:
    """Simulate the chips' readings in all frames of all indentations.

    To limit the use of memory, the frames are computed in blocks of indentations. The size of the blocks does not
    affect the result.
    """
    frame_s = (1 + np.arange(len(response.rest_T) * len(timeline))) / readout.rate_hz
    age_s, source_i = chip.last_conversions(frame_s, readout.phase_s)
    b_uT, temperature_degC, overruns = [], [], []
    for first_i in range(0, len(response.rest_T), BLOCK_INDENTATIONS_N):
        chip_T, chip_degC = _field_at(response, timeline, readout, age_s, first_i)
        block_uT, overrun = read_field(chip_T, readout.board, design=readout.design, rng=noise)
        b_uT.append(block_uT)
        overruns.append(overrun)
        temperature_degC.append(read_temperature(chip_degC, readout.design, warmth_noise))
    # If several frames contain the same conversion of a chip, they have exactly the same reading, including the noise.
    chip_i = np.arange(len(readout.phase_s))
    repeated_uT = np.concatenate(b_uT).reshape(len(frame_s), -1, 3)[source_i, chip_i].reshape(len(frame_s), -1)
    return SimulatedFrames(
        repeated_uT,
        np.concatenate(temperature_degC)[source_i, chip_i],
        sum(overrun.clipped_n for overrun in overruns),
        sum(overrun.wrapped_n for overrun in overruns),
    )


def _field_at(
    response: Response, timeline: Timeline, readout: Readout, age_s: Float[np.ndarray, "f k"], first_i: int
) -> tuple[Float[np.ndarray, "b k 3"], Float[np.ndarray, "b k"]]:
    # Return the field in T and the temperature in degC at the conversion of each chip, for the block of indentations
    # that starts with the index `first_i`. The first frames of the block may contain conversions that the chips made
    # during the indentation before the block. Therefore, the field of this indentation is computed too.
    lead_n = len(timeline) if first_i else 0
    block = slice(first_i - (1 if first_i else 0), first_i + BLOCK_INDENTATIONS_N)
    b_T = response.rest_T[block, None] + timeline.share[:, None, None] * response.change_T[block, timeline.stop_i]
    frames_n, start = b_T.shape[0] * b_T.shape[1], block.start * len(timeline)
    b_T = b_T.reshape(frames_n, *b_T.shape[2:])
    warm_degC = np.full(frames_n, ROOM_DEGC)
    if readout.temperature is not None:
        rise_K = aging.temperature_rise_K((1 + start + np.arange(frames_n)) / readout.rate_hz, readout.temperature)
        warm_degC += rise_K
        gain = aging.relative_remanence(rise_K)[:, None] * (1 + rise_K[:, None] * readout.sensitivity_per_K)  # [f k]
        b_T *= gain[:, :, None]
    chip_T = chip.sample_at_conversion(b_T, age_s[start : start + frames_n], readout.rate_hz)
    return chip_T[lead_n:], np.repeat(warm_degC[lead_n:, None], len(readout.phase_s), axis=1)

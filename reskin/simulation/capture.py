"""A capture of a skin that does not exist. In: settings and names. Out: the files that a port and a probe leave.

From there on only the word `simulated` in its header tells it from a recorded one. Refuses to know folders.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int64
from scipy.constants import milli

from reskin.board import wire
from reskin.board.wire import Frames
from reskin.physics.board import draw_board
from reskin.physics.chip import steps_uT
from reskin.physics.skin import Skin, draw_skin
from reskin.recordings import clocks, probe
from reskin.recordings.clocks import Arrivals
from reskin.recordings.header import ARRIVALS_FILE, LOG_FILE, PROBE_FILE, STREAM_FILE, Clock, Firmware, Header, Wire
from reskin.recordings.probe import ProbeLog
from reskin.recordings.readers import sd_card
from reskin.seeds import rng_for
from reskin.simulation.contact import Response, respond
from reskin.simulation.protocols import Plan, Walk, depths_under
from reskin.simulation.rig import (
    Rig,
    chunks,
    draw_clock,
    misplace,
    probe_log,
    read_force,
    read_frames,
    set_up,
    switch_on,
    timeline,
)
from reskin.simulation.settings import MAIN, Synthesis

WIRE: Wire = "binary"
# Each has a random generator named after it, so that one more term leaves all other draws as they are.
PARTS = ("plan", "robot", "drift", "chips", "noise", "warmth", "port", "probe")


@dataclass(frozen=True)
class SyntheticCapture:
    """One capture before it is encoded: frames in order of time, chunks as they arrived, probe log, clock marks."""

    name: str
    board: str
    skin: str
    b_uT: Float32[np.ndarray, "f ch"]
    temperature_degC: Float32[np.ndarray, "f k"]
    arrived_frames_n: Int64[np.ndarray, " c"]  # frames come in all; the first row is 0, at the start
    arrived_s: Float64[np.ndarray, " c"]  # on the stream's clock
    probe: ProbeLog
    marks: tuple[tuple[float, float], ...]  # (stream_s, probe_s) of the same event
    protocol: str  # in words
    overruns: dict[str, int]  # what went past a range, counted
    card_rate_hz: float | None  # of frames that went to an SD card; None: they came through a port


def roster(synthesis: Synthesis, protocol: str) -> list[tuple[str, str]]:
    """Name (board, skin) of every capture of a protocol; more of either leave the others' names and draws alone."""
    settings = synthesis.protocols[protocol]
    kind = synthesis.boards[settings.boards]
    boards = [f"{kind.letter}{board_i}" for board_i in range(kind.boards_n)]
    skins = [(board, f"{board}_s{skin_i}") for skin_i in range(kind.skins_per_board_n) for board in boards]
    return sorted(skins[: settings.skins_n])


def record(synthesis: Synthesis, protocol: str, *, board: str, skin: str, seed: int) -> SyntheticCapture:
    """Draw the board and the skin of these names, take the skin through the protocol, and record it."""
    settings, chip, spreads = synthesis.protocols[protocol], synthesis.chip, synthesis.spreads
    rig, terms = set_up(synthesis.rig, settings), synthesis.terms.only(settings.terms)
    kind = synthesis.boards[settings.boards]
    rngs = {part: rng_for(seed, "recording", protocol, board, skin, part) for part in PARTS}
    drawn_board = draw_board(kind.design, spreads, seed=seed, name=board)
    rule = kind.quadrature.in_si()
    drawn_skin = draw_skin(synthesis.skin, spreads, seed=seed, name=skin, rule=rule, sides_m=kind.skin_m)
    plan = settings.plan(rngs["plan"], kind.skin_mm)
    tip_m = _tip(plan, rig, drawn_skin, rngs["robot"])
    if plan.labelled:
        tip_m[..., :2] += rig.place_offset_sd_mm * milli * rng_for(seed, "rig", board).standard_normal(2)
    response = respond(drawn_board, drawn_skin, tip_m, tilt=plan.tilt, terms=terms, rng=rngs["drift"])
    reader = switch_on(drawn_board, chip, rate_hz=rig.rate_hz, temperature=terms.temperature, rng=rngs["chips"])
    line = timeline(rig, plan.x_mm.shape[1])
    frames = read_frames(response, line, reader, noise=rngs["noise"], warmth_noise=rngs["warmth"])
    frame_s = (1 + np.arange(len(frames.b_uT))) / rig.rate_hz
    arrived_frames_n, arrived_s = chunks(frame_s, rig, rngs["port"])
    offset_s, rate = clock = draw_clock(rig, rngs["port"])
    read_N, past_range_n = _force_readings(response, rig, rngs["probe"])
    return SyntheticCapture(
        name=skin if protocol == MAIN else f"{skin}-{protocol}",
        board=board,
        skin=skin,
        b_uT=frames.b_uT,
        temperature_degC=frames.temperature_degC,
        arrived_frames_n=arrived_frames_n,
        arrived_s=arrived_s,
        probe=probe_log(plan, read_N, rig, clock),
        marks=tuple((float(t_s), float(offset_s + rate * t_s)) for t_s in frame_s[[0, -1]]),
        protocol=plan.description,
        overruns={
            "field held at 50 mT": frames.clipped_n,
            "field past int16": frames.wrapped_n,
            "force past the sensor": past_range_n,
            "stops past 0.6 of the thickness": response.beyond_verified_n,
        },
        card_rate_hz=rig.rate_hz if isinstance(settings, Walk) else None,
    )


def to_files(capture: SyntheticCapture, synthesis: Synthesis) -> tuple[Header, dict[str, bytes]]:
    """Write a synthetic capture as the files of a native one, or an SD card's; the files' hashes are still to come."""
    on_card = capture.card_rate_hz is not None
    frames_n, chips_n = capture.temperature_degC.shape
    xy_uT, _, z_uT = steps_uT(synthesis.chip.gain_sel).tolist()
    header = Header(
        format="reskin-capture/1", capture=capture.name, board=capture.board, skin=capture.skin, source="simulated",
        layout="sd-card" if on_card else "native", wire=None if on_card else WIRE,
        chips_n=chips_n, unit_b="uT", unit_force="N", unit_place="mm",
        firmware=Firmware(gain_sel=synthesis.chip.gain_sel, lsb_xy_uT=xy_uT, lsb_z_uT=z_uT),
        clock=Clock(kind="recording" if on_card else "arrivals", rate_hz=None, marks=capture.marks),
        protocol=capture.protocol,
        contacts_before_n=0, options={}, files={},
        note=", ".join(f"{what}: {n}" for what, n in capture.overruns.items()),
    )  # fmt: skip
    probe_file = {PROBE_FILE: probe.render(capture.probe).encode()}
    if capture.card_rate_hz is not None:
        frame_s = (1 + np.arange(frames_n)) / capture.card_rate_hz
        log = sd_card.render(frame_s, capture.b_uT, capture.temperature_degC)
        return header, probe_file | {LOG_FILE: log.encode()}
    untimed = Frames(capture.b_uT, capture.temperature_degC, np.full(frames_n, np.nan), np.zeros(frames_n, np.int64))
    arrived_bytes_n = capture.arrived_frames_n * wire.record_type(WIRE, chips_n).itemsize
    return header, probe_file | {
        STREAM_FILE: wire.encode(untimed, WIRE),
        ARRIVALS_FILE: clocks.render(Arrivals(arrived_bytes_n, capture.arrived_s)).encode(),
    }


def _tip(plan: Plan, rig: Rig, skin: Skin, rng: np.random.Generator) -> Float64[np.ndarray, "n p 3"]:
    """Give where the tip is in the board's frame, in m; a weight sinks as deep as the skin lets it."""
    tip_m = (misplace(plan, rig, rng) - (*plan.centre_mm, 0)) * milli
    if plan.weight_N is not None:
        tip_m[:, :, 2] = depths_under(skin, plan.weight_N)
    return tip_m


def _force_readings(response: Response, rig: Rig, rng: np.random.Generator) -> tuple[Float32[np.ndarray, "n d 3"], int]:
    """Give the force sensor's readings in N, and how many exceed its range; in the first dwell, no load, only noise."""
    force_N = np.concatenate([np.zeros((len(response.force_N), 1, 3)), response.force_N], axis=1)
    read_N, past_range_n = read_force(force_N.reshape(-1, 3), noise_N=rig.force_noise_N, rng=rng)
    return read_N.reshape(force_N.shape), past_range_n

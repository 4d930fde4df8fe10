"""Simulate captures: the readings of a board while its skin is pressed according to a protocol.

The result is encoded in the file formats of recorded captures. A program can distinguish a simulated capture from a
recorded one only by the entry `source: simulated` in its header.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int64
from scipy.constants import milli

from reskin.board import wire
from reskin.board.wire import Frames, Wire
from reskin.physics.board import draw_board
from reskin.physics.chip import steps_uT
from reskin.physics.skin import Skin, draw_skin
from reskin.recordings import clocks, probe
from reskin.recordings.clocks import Arrivals
from reskin.recordings.header import ARRIVALS_FILE, LOG_FILE, PROBE_FILE, STREAM_FILE, Clock, Firmware, Header
from reskin.recordings.probe import ProbeLog
from reskin.recordings.readers import sd_card
from reskin.seeds import rng_for
from reskin.simulation.contact import Response, simulate_response
from reskin.simulation.protocols import Plan, Walk, depths_under_load
from reskin.simulation.rig import (
    Rig,
    actual_positions,
    draw_arrivals,
    draw_clock,
    probe_log,
    read_force,
    read_frames,
    rig_for,
    start_readout,
    timeline,
)
from reskin.simulation.settings import MAIN, SimulationSettings

WIRE: Wire = "binary"
# The parts of a simulation. Each part has its own random generator. If a part needs more random numbers than before,
# the random numbers of the other parts therefore stay the same.
PARTS = ("plan", "robot", "drift", "chips", "noise", "warmth", "port", "probe")


@dataclass(frozen=True)
class SimulatedCapture:
    """A simulated capture before it is encoded, with f frames in order of time and c chunks.

    A frame contains one reading of each of the k chips. A chunk is a sequence of frames that arrive at the same time.
    """

    name: str
    board: str
    skin: str
    b_uT: Float32[np.ndarray, "f ch"]
    temperature_degC: Float32[np.ndarray, "f k"]
    arrived_frames_n: Int64[np.ndarray, " c"]  # cumulative number of frames after each chunk; starts with 0
    arrived_s: Float64[np.ndarray, " c"]  # arrival time of each chunk, on the stream's clock
    probe: ProbeLog  # the log of the robot and the force sensor
    # Times at which the clocks of stream and probe can be compared. Each pair has the time of one event on both clocks.
    marks: tuple[tuple[float, float], ...]
    protocol: str  # description of the protocol, for the header
    overruns: dict[str, int]  # maps each kind of value out of range to the number of such values
    # frame rate, if the board writes its frames to an SD card; None if it sends the frames to a port
    card_rate_hz: float | None


def list_captures(settings: SimulationSettings, protocol: str) -> list[tuple[str, str]]:
    """Return the names of the board and the skin of each capture of a protocol.

    If the number of boards or skins in the settings is increased, the existing names stay the same.
    """
    kind, skins_n = settings.boards[settings.protocols[protocol].boards], settings.protocols[protocol].skins_n
    boards = [f"{kind.letter}{board_i}" for board_i in range(kind.boards_n)]
    skins = [(board, f"{board}_s{skin_i}") for skin_i in range(kind.skins_per_board_n) for board in boards]
    return sorted(skins[:skins_n])


def simulate_capture(
    settings: SimulationSettings, protocol: str, *, board: str, skin: str, seed: int
) -> SimulatedCapture:
    """Simulate the capture of a protocol with the board and the skin that have the given names.

    The board and the skin are drawn at random. Their random generators are seeded by `seed` and by their names.
    """
    presses, chip, spreads = settings.protocols[protocol], settings.chip, settings.spreads
    rig, terms = rig_for(settings.rig, presses), settings.terms.only(presses.terms)
    kind = settings.boards[presses.boards]
    rngs = {part: rng_for(seed, "recording", protocol, board, skin, part) for part in PARTS}
    drawn_board = draw_board(kind.design, spreads, seed=seed, name=board)
    rule = kind.quadrature.in_si()
    drawn_skin = draw_skin(settings.skin, spreads, seed=seed, name=skin, rule=rule, sides_m=kind.skin_m)
    plan = presses.plan(rngs["plan"], kind.skin_mm)
    tip_m = _tip(plan, rig, drawn_skin, rngs["robot"])
    if plan.labelled:
        tip_m[..., :2] += rig.place_offset_sd_mm * milli * rng_for(seed, "rig", board).standard_normal(2)
    response = simulate_response(drawn_board, drawn_skin, tip_m, tilt=plan.tilt, terms=terms, rng=rngs["drift"])
    readout = start_readout(drawn_board, chip, rate_hz=rig.rate_hz, temperature=terms.temperature, rng=rngs["chips"])
    line = timeline(rig, plan.x_mm.shape[1])
    frames = read_frames(response, line, readout, noise=rngs["noise"], warmth_noise=rngs["warmth"])
    frame_s = (1 + np.arange(len(frames.b_uT))) / rig.rate_hz
    arrived_frames_n, arrived_s = draw_arrivals(frame_s, rig, rngs["port"])
    offset_s, rate = clock = draw_clock(rig, rngs["port"])
    read_N, past_range_n = _force_readings(response, rig, rngs["probe"])
    return SimulatedCapture(
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
            "field values clipped at 50 mT": frames.clipped_n,
            "field values that overflow int16": frames.wrapped_n,
            "force values beyond the range of the sensor": past_range_n,
            "stops deeper than 0.6 of the skin's thickness": response.beyond_verified_n,
        },
        card_rate_hz=rig.rate_hz if isinstance(presses, Walk) else None,
    )


def to_files(capture: SimulatedCapture, settings: SimulationSettings) -> tuple[Header, dict[str, bytes]]:
    """Encode a simulated capture; return the header, and a dict from the name of each file to its content.

    The layout of the capture is `sd-card` if the board writes its frames to an SD card, and `native` otherwise. The
    hashes of the files are not yet in the header. The caller adds them when it writes the files.
    """
    on_card = capture.card_rate_hz is not None
    frames_n, chips_n = capture.temperature_degC.shape
    xy_uT, _, z_uT = steps_uT(settings.chip.gain_sel).tolist()
    header = Header(
        format="reskin-capture/1", capture=capture.name, board=capture.board, skin=capture.skin, source="simulated",
        layout="sd-card" if on_card else "native", wire=None if on_card else WIRE,
        chips_n=chips_n, unit_b="uT", unit_force="N", unit_place="mm",
        firmware=Firmware(gain_sel=settings.chip.gain_sel, lsb_xy_uT=xy_uT, lsb_z_uT=z_uT),
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
    """Return the true positions of the tip in m, in the coordinate system of the board.

    If the plan has loads instead of depths, the depths are computed from the loads and the skin's stiffness.
    """
    tip_m = (actual_positions(plan, rig, rng) - (*plan.centre_mm, 0)) * milli
    if plan.weight_N is not None:
        tip_m[:, :, 2] = depths_under_load(skin, plan.weight_N)
    return tip_m


def _force_readings(response: Response, rig: Rig, rng: np.random.Generator) -> tuple[Float32[np.ndarray, "n d 3"], int]:
    """Return force readings in N at each dwell, and the number of clipped values.

    A dwell is a time in which the tip does not move. In the first dwell of each indentation, the tip is above the skin.
    The other dwells are at the stops of the indentation.
    """
    force_N = np.concatenate([np.zeros((len(response.force_N), 1, 3)), response.force_N], axis=1)
    read_N, past_range_n = read_force(force_N.reshape(-1, 3), noise_N=rig.force_noise_N, rng=rng)
    return read_N.reshape(force_N.shape), past_range_n

"""A synthetic capture as a port would have left it: arrays -> header and files in the wire format.

From here on nothing tells it from a recorded one, but for the word `simulated` in its header. Refuses to know folders.
"""

import numpy as np

from pipeline.capture import arrivals, probe, sd_card, wire
from pipeline.capture.arrivals import Arrivals
from pipeline.capture.header import ARRIVALS_FILE, LOG_FILE, PROBE_FILE, STREAM_FILE, Clock, Firmware, Header, Wire
from pipeline.capture.wire import Frames
from pipeline.physics.sensor import steps_uT
from pipeline.synthesis.capture import Synthesis, SyntheticCapture

WIRE: Wire = "binary"


def to_files(capture: SyntheticCapture, parameters: Synthesis) -> tuple[Header, dict[str, bytes]]:
    """Write a synthetic capture as the files of a native one, or an SD card's; the files' hashes are still to come."""
    probed = {PROBE_FILE: probe.render(capture.probe).encode()}
    if capture.card_rate_hz is not None:
        return _header(capture, parameters), probed | {LOG_FILE: _log(capture, capture.card_rate_hz)}
    frames_n, chips_n = capture.temperature_degC.shape
    unknown = Frames(capture.b_uT, capture.temperature_degC, np.full(frames_n, np.nan), np.zeros(frames_n, np.int64))
    frame_bytes_n = wire.record_type(WIRE, chips_n).itemsize
    return _header(capture, parameters), probed | {
        STREAM_FILE: wire.encode(unknown, WIRE),
        ARRIVALS_FILE: arrivals.render(Arrivals(capture.arrived_frames_n * frame_bytes_n, capture.arrived_s)).encode(),
    }


def _log(capture: SyntheticCapture, rate_hz: float) -> bytes:
    frame_s = (1 + np.arange(len(capture.b_uT))) / rate_hz
    return sd_card.render(frame_s, capture.b_uT, capture.temperature_degC).encode()


def _header(capture: SyntheticCapture, parameters: Synthesis) -> Header:
    on_card = capture.card_rate_hz is not None
    xy_uT, _, z_uT = steps_uT(parameters.chip.gain_sel).tolist()
    return Header(
        format="reskin-capture/1", capture=capture.name, board=capture.board, skin=capture.skin, source="simulated",
        layout="sd-card" if on_card else "native", wire=None if on_card else WIRE,
        chips_n=capture.temperature_degC.shape[1], unit_b="uT", unit_force="N", unit_place="mm",
        firmware=Firmware(gain_sel=parameters.chip.gain_sel, lsb_xy_uT=xy_uT, lsb_z_uT=z_uT),
        clock=Clock(kind="recording" if on_card else "arrivals", rate_hz=None, marks=capture.marks),
        protocol=capture.words,
        contacts_before_n=0, options={}, files={},
        note=", ".join(f"{what}: {n}" for what, n in capture.overruns.items()),
    )  # fmt: skip

"""What a board that is not there sends, and when. In: a capture's folder, or a simulated scene. Out: a `Script`.

Refuses to know ports, and who listens.
"""

from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float64

from pipeline.capture import sd_card
from pipeline.capture.header import HEADER_FILE, LOG_FILE, STREAM_FILE, Wire
from pipeline.capture.stream import decode_all
from pipeline.capture.wire import TEXT_WIRES, Frames, encode, record_type
from pipeline.core import io
from pipeline.core.config import SCENES, Settings, params_of, parse, read_yaml
from pipeline.core.errors import CaptureError, ParamsError
from pipeline.dataset.captures import read_header, timer
from pipeline.params import Scene
from pipeline.synthesis.capture import record, roster
from pipeline.synthesis.settings import MAIN, check_synthesis

WALK = "log"  # the protocol that is most like a hand: touches, and pauses between them
Source = Literal["simulated", "recorded"]


@dataclass(frozen=True)
class Script:
    """Pieces of a stream, each up to the end of one frame: the bytes, the frame, and when it is sent."""

    source: Source
    wire: Wire
    frames: Frames
    pieces: list[bytes]
    t_s: Float64[np.ndarray, " f"]  # from the start
    away_s: dict[int, float] = field(default_factory=dict)  # piece: how long the board is unplugged before it

    def __len__(self) -> int:
        return len(self.pieces)

    @property
    def duration_s(self) -> float:
        """How long it lasts, the pause before the first frame comes again included."""
        return float(self.t_s[-1] * len(self) / max(len(self) - 1, 1)) if len(self) else 0.0


def read_script(source: str, root: Path) -> Script:
    """Read a capture's folder, or simulate the scene of this name: its walk if it has one, else its grid."""
    folder, scene = Path(source), root / SCENES / f"{source}.yaml"
    if (folder / HEADER_FILE).is_file():
        return read_capture(folder)
    if folder.name == source and scene.is_file():
        return simulate(source, root)
    scenes = ", ".join(sorted(file.stem for file in (root / SCENES).glob("*.yaml")))
    remedy = f"Scenes: {scenes or 'none here'}; the folder of a capture holds {HEADER_FILE}."
    raise ParamsError(source, "the source", "a capture's folder or the name of a scene", "neither", remedy)


def read_capture(folder: Path) -> Script:
    """Read what a port or an SD card left; a card's log is sent as binary frames."""
    header = read_header(folder)
    if header.layout == "sd-card":
        t_s, b_uT, temperature_degC, _ = sd_card.read_log(folder / LOG_FILE)
        return _script(header.source, b_uT, temperature_degC, t_s)
    if header.wire is None:
        remedy = "What others recorded has no bytes of a port."
        raise CaptureError(folder, "layout", "native or sd-card", header.layout, remedy)
    data = io.read_bytes(folder / STREAM_FILE)
    frames, _ = decode_all(data, header.wire, header.chips_n, str(folder / STREAM_FILE))
    t_s = timer(folder, header)(frames, 0)
    timed = np.isfinite(t_s)
    frames, t_s = frames.where(timed), t_s[timed]
    edges = np.append(0, frames.end_byte).tolist()  # bytes between two frames go with the second
    pieces = [data[first:last] for first, last in pairwise(edges)]
    return Script(header.source, header.wire, frames, pieces, t_s - t_s[0])


def simulate(name: str, root: Path) -> Script:
    """Take the first skin of a simulated scene through its walk or its grid."""
    file = root / SCENES / f"{name}.yaml"
    words = read_yaml(file)
    if parse(Scene, words, str(file)).simulate is None:
        raise ParamsError(file, "the scene", "simulated", "recorded", "Give the folder of one of its captures.")
    synthesis = check_synthesis(Settings(name, str(file), words, read_yaml(params_of(root)), {}))
    protocol = WALK if WALK in synthesis.protocols else MAIN
    board, skin = roster(synthesis, protocol)[0]
    capture = record(synthesis, protocol, board=board, skin=skin, seed=words["seed"])
    chunk_i = np.searchsorted(capture.arrived_frames_n, 1 + np.arange(len(capture.b_uT)))
    return _script("simulated", capture.b_uT, capture.temperature_degC, capture.arrived_s[chunk_i])


def encode_pieces(frames: Frames, wire: Wire) -> list[bytes]:
    """Write frames as the firmware sends them, one by one."""
    data = encode(frames, wire)
    if wire in TEXT_WIRES:
        return data.splitlines(keepends=True)
    size = record_type(wire, frames.temperature_degC.shape[1]).itemsize
    return [data[first : first + size] for first in range(0, len(data), size)]


def _script(source: Source, b_uT: np.ndarray, temperature_degC: np.ndarray, t_s: np.ndarray) -> Script:
    wire: Wire = "binary"
    unknown = np.full(len(t_s), np.nan), np.zeros(len(t_s), np.int64)
    frames = Frames(b_uT, temperature_degC, *unknown)
    return Script(source, wire, frames, encode_pieces(frames, wire), t_s - t_s[0])

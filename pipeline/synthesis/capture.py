"""A capture of a skin that does not exist. In: parameters and names. Out: what a port and a probe would have written.

Refuses to know bytes (`capture.wire`) and files: a stage encodes and writes.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float32, Float64, Int64
from pydantic import Field, model_validator
from scipy.constants import milli

from pipeline.capture.probe import ProbeLog
from pipeline.core.config import Strict
from pipeline.core.seeds import rng_for
from pipeline.physics.board import BoardDesign, Spreads, draw_board
from pipeline.physics.force_sensor import read_force
from pipeline.physics.nodes import Rule
from pipeline.physics.sensor import ChipDesign
from pipeline.physics.skin import Skin, SkinDesign, draw_skin
from pipeline.synthesis.felt import Felt, Terms, feel
from pipeline.synthesis.frames import read_frames, switch_on
from pipeline.synthesis.plans import Plan
from pipeline.synthesis.pressing import depths_under
from pipeline.synthesis.protocols import SKIN_MM, Drag, Grid, Hand, Protocol, Walk, make_plan
from pipeline.synthesis.rig import Rig, chunks, draw_clock, misplace, probe_log, suit, timeline

MAIN = "grid"  # its captures bear the names of their skins alone
# The protocols that questions are asked of, and the kind that each question can read.
KINDS: dict[str, str] = {
    MAIN: "grid", "wear": "grid", "flexible": "grid", "drag": "drag", "hand": "hand", "sleeve": "scatter",
    "glass": "load", "press": "press", "log": "walk",
}  # fmt: skip
ON_MAIN_BOARDS = ("wear", "drag", "hand", "glass", "press", "log")  # compared with, or read by networks of, these
ON_OTHER_BOARDS = ("flexible",)
OF_ONE_SKIN = ("wear", "glass", "press", "log")  # a question about the protocol reads one capture
# What is drawn for a capture, each by a name of its own: a term more leaves all other draws as they are.
PARTS = ("plan", "robot", "drift", "chips", "noise", "warmth", "port", "probe")
Count = Annotated[int, Field(ge=1, le=1000)]
Side_mm = Annotated[float, Field(gt=0, le=500)]


class BoardKind(Strict):
    """Boards of one make, each with its own skins; their names start with the letter."""

    letter: Annotated[str, Field(pattern="^[a-z]$")]
    boards_n: Count
    skins_per_board_n: Count
    design: BoardDesign
    skin_mm: tuple[Side_mm, Side_mm]  # along x and y
    quadrature: Rule

    @property
    def skin_m(self) -> tuple[float, float]:
        """Give the skin's sides in SI."""
        return self.skin_mm[0] * milli, self.skin_mm[1] * milli


class Synthesis(Strict):
    """Section `simulate` of a scene: which skins there are, what they are like and how they are recorded."""

    boards: Annotated[dict[str, BoardKind], Field(min_length=1)]
    protocols: Annotated[dict[str, Protocol], Field(min_length=1)]
    rig: Rig
    skin: SkinDesign
    chip: ChipDesign
    spreads: Spreads
    terms: Terms

    @model_validator(mode="after")
    def _nothing_is_named_that_is_not_there(self) -> "Synthesis":
        used = {term for protocol in self.protocols.values() for term in protocol.terms}
        if used != self.terms.named():
            raise ValueError(
                f"terms holds exactly what a protocol needs, {sorted(used)}; it holds {sorted(self.terms.named())}"
            )
        for name, protocol in self.protocols.items():
            if protocol.boards not in self.boards:
                raise ValueError(f"protocol {name}: boards is one of {sorted(self.boards)}, not {protocol.boards!r}")
            if isinstance(protocol, Hand) and protocol.tilt_sd_deg > 0 and "friction" not in protocol.terms:
                raise ValueError(f"protocol {name}: a stylus that leans (tilt_sd_deg) needs the term friction")
            kind = self.boards[protocol.boards]
            if protocol.skins_n > kind.boards_n * kind.skins_per_board_n:
                have_n, asked_n = kind.boards_n * kind.skins_per_board_n, protocol.skins_n
                raise ValueError(
                    f"protocol {name}: skins_n {asked_n} is more than {protocol.boards} boards have, {have_n}"
                )
        if len({kind.letter for kind in self.boards.values()}) < len(self.boards):
            raise ValueError("kinds of boards need different letters")
        return self

    @model_validator(mode="after")
    def _folds_are_drawn_on_the_papers_protocol(self) -> "Synthesis":
        if MAIN not in self.protocols or not isinstance(self.protocols[MAIN], Grid):
            raise ValueError(f"protocols holds a grid named {MAIN}")
        if self.main_boards.skin_mm != SKIN_MM:  # the studies of physics are of the authors' skin
            raise ValueError(f"skin_mm of the boards of protocol {MAIN} is {list(SKIN_MM)}")
        return self

    @model_validator(mode="after")
    def _protocols_suit_their_questions(self) -> "Synthesis":
        for name, protocol in self.protocols.items():
            kind, boards, skins_n = KINDS.get(name, protocol.kind), protocol.boards, protocol.skins_n
            if protocol.kind != kind:
                raise ValueError(f"protocol {name}: kind is {kind}, which its question reads, not {protocol.kind}")
            if isinstance(protocol, Drag) and "friction" not in protocol.terms:
                raise ValueError(f"protocol {name}: terms of a drag hold friction, without which there is no shear")
            if name in ON_MAIN_BOARDS and boards != self.main.boards:
                raise ValueError(f"protocol {name}: boards is {self.main.boards}, as of {MAIN}, not {boards}")
            if name in ON_OTHER_BOARDS and boards == self.main.boards:
                raise ValueError(f"protocol {name}: boards is another kind than that of {MAIN}, not {boards} too")
            if name in OF_ONE_SKIN and skins_n != 1:
                raise ValueError(f"protocol {name}: skins_n is 1, as its question reads one skin, not {skins_n}")
        return self

    @property
    def main(self) -> Grid:
        """The protocol that folds are drawn on."""
        main = self.protocols[MAIN]
        assert isinstance(main, Grid), "checked above"
        return main

    @property
    def main_boards(self) -> BoardKind:
        """The boards of the main protocol."""
        return self.boards[self.main.boards]


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
    words: str  # the protocol
    overruns: dict[str, int]  # what went past a range, counted
    card_rate_hz: float | None  # of frames that went to an SD card; None: they came through a port


def roster(parameters: Synthesis, protocol: str) -> list[tuple[str, str]]:
    """Name (board, skin) of every capture of a protocol; more of either leave the others' names and draws alone."""
    asked = parameters.protocols[protocol]
    kind = parameters.boards[asked.boards]
    boards = [f"{kind.letter}{board_i}" for board_i in range(kind.boards_n)]
    skins = [(board, f"{board}_s{skin_i}") for skin_i in range(kind.skins_per_board_n) for board in boards]
    return sorted(skins[: asked.skins_n])


def record(parameters: Synthesis, protocol: str, *, board: str, skin: str, seed: int) -> SyntheticCapture:
    """Draw the board and the skin of these names, take the skin through the protocol, and record it."""
    asked = parameters.protocols[protocol]
    rig = suit(parameters.rig, asked)
    terms = parameters.terms.only(asked.terms)
    rngs = {part: rng_for(seed, "recording", protocol, board, skin, part) for part in PARTS}
    kind = parameters.boards[asked.boards]
    own_board = draw_board(kind.design, parameters.spreads, seed=seed, name=board)
    rule = kind.quadrature.quadrature()
    own_skin = draw_skin(parameters.skin, parameters.spreads, seed=seed, name=skin, rule=rule, sides_m=kind.skin_m)
    plan = make_plan(asked, rngs["plan"], skin_mm=kind.skin_mm)
    tip_m = _put_tip(plan, rig, own_skin, rngs["robot"])
    felt = feel(own_board, own_skin, tip_m, tilt=plan.tilt, terms=terms, rng=rngs["drift"])
    reader = switch_on(
        own_board, parameters.chip, rate_hz=rig.rate_hz, temperature=terms.temperature, rng=rngs["chips"]
    )
    frames = read_frames(
        felt, timeline(rig, plan.x_mm.shape[1]), reader, noise=rngs["noise"], warmth_noise=rngs["warmth"]
    )
    frame_s = (1 + np.arange(len(frames.b_uT))) / rig.rate_hz
    arrived_frames_n, arrived_s = chunks(frame_s, rig, rngs["port"])
    offset_s, rate = clock = draw_clock(rig, rngs["port"])
    read_N, past_range_n = _feel_force(felt, rig, rngs["probe"])
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
        words=plan.words,
        overruns={
            "field held at 50 mT": frames.clipped_n,
            "field past int16": frames.wrapped_n,
            "force past the sensor": past_range_n,
            "stops past 0.6 of the thickness": felt.beyond_verified_n,
        },
        card_rate_hz=rig.rate_hz if isinstance(asked, Walk) else None,
    )


def _put_tip(plan: Plan, rig: Rig, skin: Skin, rng: np.random.Generator) -> Float64[np.ndarray, "n p 3"]:
    """Give where the tip is in the board's frame, in m; a weight sinks as deep as the skin lets it."""
    tip_m = (misplace(plan, rig, rng) - (*plan.centre_mm, 0)) * milli
    if plan.weight_N is not None:
        tip_m[:, :, 2] = depths_under(skin, plan.weight_N)
    return tip_m


def _feel_force(felt: Felt, rig: Rig, rng: np.random.Generator) -> tuple[Float32[np.ndarray, "n d 3"], int]:
    # The no-load dwell comes first, and feels nothing but noise.
    force_N = np.concatenate([np.zeros((len(felt.force_N), 1, 3)), felt.force_N], axis=1)
    read_N, past_range_n = read_force(force_N.reshape(-1, 3), noise_N=rig.force_noise_N, rng=rng)
    return read_N.reshape(force_N.shape), past_range_n

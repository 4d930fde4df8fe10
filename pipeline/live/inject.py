"""Faults by name, put into a script: what real boards, ports and hosts do. In: a script, a fault. Out: another script.

Refuses to know how they are found (`health`, `capture.faults`).
"""

import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Float64

from pipeline.capture.faults import FAILED_B_uT, FAILED_TEMPERATURE_degC, RESET_LSB_XY_uT, RESET_LSB_Z_uT
from pipeline.core.errors import ParamsError
from pipeline.core.seeds import rng_for
from pipeline.live.script import Script, encode_pieces

START_S, DURATION_S = 3.0, 1.0  # of a fault that says neither
TORN_EVERY_N, TORN_BYTES_N = 10, 7
CRLF_TEMPERATURE_degC = 34.513275  # its float32 holds 0D 0A
FULL_SCALE_uT, WRAP_uT = 50_000.0, 2**16 * 0.15  # of the chip; of int16 at its finest step
MAGNET_uT = 400.0
HOT_degC = 150.0
CLOCK_JUMP_S = 3600.0
Fields = Float32[np.ndarray, "f k 3"]
Values = Callable[[Fields, Float[np.ndarray, "f k"], Float64[np.ndarray, " f"], int], None]


class Fault(NamedTuple):
    """A fault's name, when it begins and how long it lasts."""

    name: str
    start_s: float
    duration_s: float


def parse(text: str) -> Fault:
    """Read NAME, NAME@START_S or NAME@START_S+DURATION_S.

    >>> parse("stall@2.5+1")
    Fault(name='stall', start_s=2.5, duration_s=1.0)
    """
    found = re.fullmatch(r"([a-z0-9-]+)(?:@(\d{1,6}(?:\.\d+)?)(?:\+(\d{1,6}(?:\.\d+)?))?)?", text)
    if found is None or found[1] not in FAULTS:
        rule = f"NAME[@START_S[+DURATION_S]] with one of {', '.join(FAULTS)}"
        raise ParamsError("--fault", "a fault", rule, repr(text)[:40], "Try: --fault stuck@3+1")
    return Fault(found[1], float(found[2] or START_S), float(found[3] or DURATION_S))


def inject(script: Script, fault: Fault) -> Script:
    """Let a fault happen; of values, chip 1 is hit, or the only one."""
    inside = (script.t_s >= fault.start_s) & (script.t_s < fault.start_s + fault.duration_s)
    if not inside.any():
        rule, got = f"within the {script.duration_s:.1f} s that are sent", f"{fault.start_s:g} s"
        raise ParamsError("--fault", f"the start of {fault.name}", rule, got, "Try: NAME@START_S")
    if fault.name in TIMES:
        return TIMES[fault.name](script, int(inside.argmax()), fault.duration_s)
    rows = np.flatnonzero(inside)
    if fault.name in VALUES:
        changed = _changed(script, inside, VALUES[fault.name])
    else:
        changed = PIECES[fault.name]([script.pieces[i] for i in rows], rng_for(0, "inject", fault.name))
    pieces = list(script.pieces)
    for i, piece in zip(rows, changed, strict=True):
        pieces[i] = piece
    return replace(script, pieces=pieces)


def _changed(script: Script, inside: np.ndarray, change: Values) -> list[bytes]:
    frames = script.frames.where(inside)
    chip_i = min(1, frames.temperature_degC.shape[1] - 1)
    change(frames.b_uT.reshape(len(frames), -1, 3), frames.temperature_degC, frames.device_s, chip_i)
    return encode_pieces(frames, script.wire)


def _fail_read(b_uT: Fields, temperature_degC: np.ndarray, _: np.ndarray, chip_i: int) -> None:
    b_uT[:, chip_i], temperature_degC[:, chip_i] = FAILED_B_uT, FAILED_TEMPERATURE_degC


def _read_nothing(b_uT: Fields, temperature_degC: np.ndarray, _: np.ndarray, _chip: int) -> None:
    b_uT[:], temperature_degC[:] = 0.0, 0.0


def _reset(b_uT: Fields, _temperature: np.ndarray, _: np.ndarray, chip_i: int) -> None:
    step_uT = np.array([RESET_LSB_XY_uT, RESET_LSB_XY_uT, RESET_LSB_Z_uT])
    b_uT[:, chip_i] = np.rint(b_uT[:, chip_i] / step_uT) * step_uT


def _stick(b_uT: Fields, temperature_degC: np.ndarray, _: np.ndarray, chip_i: int) -> None:
    b_uT[:, chip_i], temperature_degC[:, chip_i] = b_uT[0, chip_i], temperature_degC[0, chip_i]


def _saturate(b_uT: Fields, _temperature: np.ndarray, _: np.ndarray, chip_i: int) -> None:
    b_uT[:, chip_i] = FULL_SCALE_uT * np.sign(b_uT[:, chip_i])


def _wrap(b_uT: Fields, _temperature: np.ndarray, _: np.ndarray, chip_i: int) -> None:
    b_uT[::2, chip_i, 2] -= WRAP_uT * np.sign(b_uT[::2, chip_i, 2])


def _magnetise(b_uT: Fields, _temperature: np.ndarray, _: np.ndarray, _chip: int) -> None:
    b_uT[:, :, 2] += MAGNET_uT  # chips are turned about z, which is the same for all


def _heat(_field: Fields, temperature_degC: np.ndarray, _: np.ndarray, chip_i: int) -> None:
    temperature_degC[:, chip_i] = HOT_degC


def _hold_crlf(_field: Fields, temperature_degC: np.ndarray, _: np.ndarray, chip_i: int) -> None:
    temperature_degC[:, chip_i] = CRLF_TEMPERATURE_degC


def _jump(_field: Fields, _temperature: np.ndarray, device_s: np.ndarray, _chip: int) -> None:
    if np.isnan(device_s).all():
        raise ParamsError("--fault", "clock-jump", "put where frames have a clock", "none", "Take binary-clock.")
    device_s += CLOCK_JUMP_S


def _stall(script: Script, first: int, duration_s: float) -> Script:
    return replace(script, t_s=script.t_s + duration_s * (np.arange(len(script)) >= first))


def _unplug(script: Script, first: int, duration_s: float) -> Script:
    return replace(_stall(script, first, duration_s), away_s=script.away_s | {first: duration_s})


VALUES: Mapping[str, Values] = {
    "failed-read": _fail_read, "zeros": _read_nothing, "chip-reset": _reset, "stuck": _stick, "saturated": _saturate,
    "int16-wrap": _wrap, "magnet": _magnetise, "too-hot": _heat, "crlf": _hold_crlf, "clock-jump": _jump,
}  # fmt: skip
PIECES: Mapping[str, Callable[[list[bytes], np.random.Generator], list[bytes]]] = {
    "repeated": lambda pieces, _: [2 * piece for piece in pieces],
    "dropped": lambda pieces, _: [piece if i % 2 else b"" for i, piece in enumerate(pieces)],
    "torn": lambda pieces, _: [p[:-TORN_BYTES_N] if i % TORN_EVERY_N == 0 else p for i, p in enumerate(pieces)],
    "wrong-baud": lambda pieces, rng: [rng.bytes(len(piece)) for piece in pieces],
}
TIMES: Mapping[str, Callable[[Script, int, float], Script]] = {"stall": _stall, "unplug": _unplug}
FAULTS = (*VALUES, *PIECES, *TIMES)

"""Faults of boards and connections, which tests add to the scripts of emulated boards."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float64

from reskin.board.chips import RESET_LSB_XY_uT, RESET_LSB_Z_uT
from reskin.board.faults import INT16_STEPS_N, FAILED_B_uT, FAILED_TEMPERATURE_degC, find_lsb
from reskin.board.wire import Frames
from reskin.live.emulator import Script, encode_pieces
from reskin.seeds import rng_for

TORN_EVERY_N, TORN_BYTES_N = 10, 7  # fault `torn`: every 10th frame loses its last 7 bytes
# Fault `crlf`: as a float32, this temperature contains the bytes 0D 0A, which also mark the end of a frame.
CRLF_TEMPERATURE_degC = 34.513275
FINEST_LSB_uT = (0.15, 0.242)  # along x and y, and along z; assumed if the LSB of a chip cannot be detected
NEAR_END = 0.98  # fraction of the range at which fields of fault int16-wrap alternate
MAGNET_uT = 400.0  # fault `magnet`: change of the field along z
HOT_degC = 150.0  # fault `too-hot`: temperature
CLOCK_JUMP_S = 3600.0  # fault `clock-jump`: change of the time
# Fault `slow-chips`: each chip has a new reading only in every third frame, and the chips take turns.
SLOW_FRAMES_N = 3
VALUE_FAULTS = (
    "failed-read", "zeros", "chip-reset", "stuck", "slow-chips", "saturated", "int16-wrap", "magnet", "too-hot", "crlf",
    "clock-jump",
)  # fmt: skip
BYTE_FAULTS = ("repeated", "dropped", "torn", "wrong-baud")


def inject(script: Script, fault: str) -> Script:
    """Return a copy of the script in which a fault occurs, such as `stuck@3+1`: from 3 s on, for 1 s.

    A fault of a single chip affects chip 1. If the board has only one chip, the fault affects this chip. Fault `stall`
    is a pause in which the board sends nothing.
    """
    name, _, times = fault.partition("@")
    start_s, duration_s = map(float, times.split("+"))
    inside = (script.t_s >= start_s) & (script.t_s < start_s + duration_s)
    rows = np.flatnonzero(inside)
    if name == "stall":
        return replace(script, t_s=script.t_s + duration_s * (np.arange(len(script)) >= rows[0]))
    if name in VALUE_FAULTS:
        frames = script.frames.where(inside)
        _change_values(frames, name, find_lsb(script.frames.b_uT))
        changed = encode_pieces(frames, script.wire)
    else:
        changed = _change_bytes([script.pieces[i] for i in rows], name)
    pieces = list(script.pieces)
    for i, piece in zip(rows, changed, strict=True):
        pieces[i] = piece
    return replace(script, pieces=pieces)


def _change_values(frames: Frames, fault: str, lsb_uT: Float64[np.ndarray, "k 2"]) -> None:
    """Change the values in the given frames as a fault would change them. The frames are changed in place."""
    b_uT, temperature_degC = frames.b_uT.reshape(len(frames), -1, 3), frames.temperature_degC
    chip_i = min(1, temperature_degC.shape[1] - 1)
    end_uT = INT16_STEPS_N * np.where(np.isfinite(lsb_uT[chip_i]), lsb_uT[chip_i], FINEST_LSB_uT)[[0, 0, 1]]
    match fault:
        case "failed-read":
            b_uT[:, chip_i], temperature_degC[:, chip_i] = FAILED_B_uT, FAILED_TEMPERATURE_degC
        case "zeros":
            b_uT[:], temperature_degC[:] = 0.0, 0.0
        case "chip-reset":
            step_uT = np.array([RESET_LSB_XY_uT, RESET_LSB_XY_uT, RESET_LSB_Z_uT])
            b_uT[:, chip_i] = np.rint(b_uT[:, chip_i] / step_uT) * step_uT
        case "stuck":
            b_uT[:, chip_i], temperature_degC[:, chip_i] = b_uT[0, chip_i], temperature_degC[0, chip_i]
        case "slow-chips":
            frame_i, all_i = np.indices(temperature_degC.shape)
            read_i = np.maximum(frame_i - (frame_i - all_i) % SLOW_FRAMES_N, 0)
            b_uT[:], temperature_degC[:] = b_uT[read_i, all_i], temperature_degC[read_i, all_i]
        case "saturated":
            b_uT[:, chip_i] = end_uT * np.sign(b_uT[:, chip_i])
        case "int16-wrap":
            b_uT[::2, chip_i, 2] = NEAR_END * end_uT[2]
            b_uT[1::2, chip_i, 2] = -NEAR_END * end_uT[2]
        case "magnet":
            # All chips measure the same change of Bz, because chips are rotated only about z.
            b_uT[:, :, 2] += MAGNET_uT
        case "too-hot":
            temperature_degC[:, chip_i] = HOT_degC
        case "crlf":
            temperature_degC[:, chip_i] = CRLF_TEMPERATURE_degC
        case "clock-jump":
            frames.device_s[:] += CLOCK_JUMP_S


def _change_bytes(pieces: list[bytes], fault: str) -> list[bytes]:
    """Return the bytes of the given frames, changed as a fault of the connection would change them."""
    if fault == "repeated":
        return [2 * piece for piece in pieces]
    if fault == "dropped":
        return [piece if i % 2 else b"" for i, piece in enumerate(pieces)]
    if fault == "torn":
        return [piece[:-TORN_BYTES_N] if i % TORN_EVERY_N == 0 else piece for i, piece in enumerate(pieces)]
    rng = rng_for(0, "inject", fault)  # the remaining fault is `wrong-baud`: the bytes are random
    return [rng.bytes(len(piece)) for piece in pieces]

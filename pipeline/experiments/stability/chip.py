"""Fields past a chip's range, and chips that break (PHYSICS 10). In: a scene's chip. Out: cases.

The faults are those of real recordings. Refuses to know skins: fields are made up.
"""

import numpy as np
from jaxtyping import Bool, Float, Float32
from scipy.constants import milli

from pipeline.capture import faults
from pipeline.capture.header import Clock, Firmware, Header
from pipeline.capture.readers.chips import Watch
from pipeline.capture.wire import Frames
from pipeline.core.seeds import rng_for
from pipeline.experiments.stability.cases import Case, measured, refused, told
from pipeline.experiments.verification.electronics import quiet, read_bare
from pipeline.physics.sensor import ChipDesign, steps_uT

AREA = "chip"
FRAMES_N = 800
BROKEN_I = 3  # the chip that breaks
FULL_TURN_N = 2**16


def survey_chip(chip: ChipDesign, chips_n: int, seed: int) -> list[Case]:
    """Try fields past int16 and past 50 mT, and a failed, a stuck and a reset chip on a board."""
    sound_uT = _still_board(chip, chips_n, seed)
    broken_i = min(BROKEN_I, chips_n - 1)
    return [
        *_range(),
        *_failed(sound_uT, broken_i),
        *_stuck(sound_uT, broken_i),
        *_reset(sound_uT, broken_i, chip.gain_sel),
    ]


def _range() -> list[Case]:
    step_uT = steps_uT(7)
    rng = rng_for(0, "stability", "range")
    past_T, beyond_T = np.array([[5.0, -4.0, -8.5]]) * milli, np.array([[60.0, -4.0, -70.0]]) * milli
    (past_uT, past), (beyond_uT, beyond) = (read_bare(b_T, quiet(7), rng) for b_T in (past_T, beyond_T))
    turn_uT = FULL_TURN_N * step_uT
    expected_uT = 5000 - turn_uT[0], -4000, -8500 + turn_uT[2]
    held_uT = np.array([50e3, -4e3, -50e3])
    held_uT -= turn_uT * np.rint(held_uT / turn_uT)
    past_error, beyond_error = (
        float((np.abs(read - truth) / step_uT).max())
        for read, truth in ((past_uT, np.array(expected_uT)), (beyond_uT, held_uT))
    )
    return [
        measured(AREA, "5, -4 and -8.5 mT at GAIN_SEL 7 (range 4.915 and 7.93 mT)",
                 should="the two past the range wrap as int16, and are counted",
                 happened=f"{_list(past_uT)} uT; {past.wrapped_n} counted as wrapped, {past.clipped_n} as clipped",
                 error=past_error if (past.wrapped_n, past.clipped_n) == (2, 0) else np.inf, limit=0.51),
        measured(AREA, "60, -4 and -70 mT at GAIN_SEL 7", should="held at 50 mT, which wraps; both counted",
                 happened=f"{_list(beyond_uT)} uT; {beyond.wrapped_n} counted as wrapped, "
                          f"{beyond.clipped_n} as clipped",
                 error=beyond_error if (beyond.wrapped_n, beyond.clipped_n) == (2, 2) else np.inf, limit=0.51),
    ]  # fmt: skip


def _failed(sound_uT: Float32[np.ndarray, "f ch"], broken_i: int) -> list[Case]:
    some = np.zeros((len(sound_uT), sound_uT.shape[1] // 3), bool)
    some[100:150, broken_i] = True
    return [
        _marked(f"{case}: 8028.16, 5194.00, 12943.36 uT, -880.49 degC", _failed_reads(sound_uT, which), which,
                should="every such reading marked, and no other")
        for case, which in (("50 dropped readings of one chip", some), ("every chip dropped", np.ones_like(some)))
    ]  # fmt: skip


def _failed_reads(sound_uT: Float32[np.ndarray, "f ch"], which: Bool[np.ndarray, "f k"]) -> Bool[np.ndarray, "f k"]:
    b_uT = np.where(which[..., None], faults.FAILED_B_uT, sound_uT.reshape(*which.shape, 3)).reshape(sound_uT.shape)
    return faults.failed_reads(b_uT, np.where(which, faults.FAILED_TEMPERATURE_degC, 25.0))


def _stuck(sound_uT: Float32[np.ndarray, "f ch"], broken_i: int) -> list[Case]:
    axes = slice(3 * broken_i, 3 * broken_i + 3)
    stuck_uT, from_i = sound_uT.copy(), FRAMES_N // 2
    stuck_uT[from_i:, axes] = stuck_uT[from_i, axes]
    expected = np.zeros((FRAMES_N, sound_uT.shape[1] // 3), bool)
    expected[from_i + faults.STUCK_FRAMES_MIN_N - 1 :, broken_i] = True
    resting = np.tile(sound_uT[:1], (FRAMES_N, 1))
    return [
        _marked("a chip that stops while the board moves", faults.stuck_chips(stuck_uT), expected,
                should=f"marked from its {faults.STUCK_FRAMES_MIN_N}th equal reading on, and no other"),
        _marked("a whole board without noise, at rest", faults.stuck_chips(resting), np.zeros_like(expected),
                should="nothing marked: a board at rest is not broken"),
    ]  # fmt: skip


def _reset(sound_uT: Float32[np.ndarray, "f ch"], broken_i: int, gain_sel: int) -> list[Case]:
    reset_uT = _at_power_on(sound_uT, broken_i)
    found_uT = faults.find_lsb(reset_uT)[broken_i]
    flagged = np.flatnonzero(faults.reset_chips(reset_uT, None)).tolist()
    falsely = np.flatnonzero(faults.reset_chips(sound_uT, None)).tolist()
    return [
        told(AREA, f"chip {broken_i} lost its settings: its LSB is 0.98 and 1.58 uT",
             should="that chip flagged, no other",
             happened=f"flagged: {flagged}; LSB found {found_uT[0]:.2f} and {found_uT[1]:.2f} uT",
             holds=flagged == [broken_i]),
        told(AREA, "no chip lost its settings", should="none flagged",
             happened=f"flagged: {falsely}", holds=not falsely),
        *(
            refused(AREA, f"a chip loses its settings while it is recorded, {known}", attempt=attempt,
                    should="reported by the ingest, with the chip and the frame")
            for known, attempt in (
                (f"GAIN_SEL {gain_sel} in the header", lambda: _watch(sound_uT, reset_uT, gain_sel)),
                ("no settings in the header", lambda: _watch(sound_uT, reset_uT, None)),
            )
        ),
    ]  # fmt: skip


def _watch(before_uT: Float32[np.ndarray, "f ch"], after_uT: Float32[np.ndarray, "f ch"], gain_sel: int | None) -> None:
    b_uT = np.concatenate([before_uT, after_uT])
    chips_n = b_uT.shape[1] // 3
    firmware = None
    if gain_sel is not None:
        xy_uT, _, z_uT = steps_uT(gain_sel).tolist()
        firmware = Firmware(gain_sel=gain_sel, lsb_xy_uT=xy_uT, lsb_z_uT=z_uT)
    header = Header(
        format="reskin-capture/1", capture="stability", board="b0", skin="s0", source="simulated", layout="native",
        wire="binary", chips_n=chips_n, unit_b="uT", unit_force="N", unit_place="mm", firmware=firmware,
        clock=Clock(kind="rate", rate_hz=400.0, marks=()), protocol="", contacts_before_n=0, options={}, files={},
        note="",
    )  # fmt: skip
    warm = np.full((len(b_uT), chips_n), 25, np.float32)
    frames = Frames(b_uT, warm, np.full(len(b_uT), np.nan), np.arange(len(b_uT), dtype=np.int64))
    Watch(header, "stability").stuck(frames, np.zeros(len(b_uT), bool))


def _marked(case: str, found: Bool[np.ndarray, "f k"], expected: Bool[np.ndarray, "f k"], *, should: str) -> Case:
    hits_n, false_n = int((found & expected).sum()), int((found & ~expected).sum())
    happened = (
        f"{hits_n} of {int(expected.sum())} readings marked, and {false_n} of the {int((~expected).sum())} others"
    )
    return told(AREA, case, should=should, happened=happened, holds=bool((found == expected).all()))


def _still_board(chip: ChipDesign, chips_n: int, seed: int) -> Float32[np.ndarray, "f ch"]:
    rng = rng_for(seed, "stability", "board")
    rest_T = rng.uniform(-2, 2, (chips_n, 3)) * milli
    return np.concatenate([read_bare(np.tile(one_T, (FRAMES_N, 1)), chip, rng)[0] for one_T in rest_T], axis=1)


def _at_power_on(sound_uT: Float32[np.ndarray, "f ch"], broken_i: int) -> Float32[np.ndarray, "f ch"]:
    grid_uT = np.array([faults.RESET_LSB_XY_uT, faults.RESET_LSB_XY_uT, faults.RESET_LSB_Z_uT])
    axes = slice(3 * broken_i, 3 * broken_i + 3)
    reset_uT = sound_uT.copy()
    reset_uT[:, axes] = np.rint(sound_uT[:, axes] / grid_uT) * grid_uT
    return reset_uT


def _list(values_uT: Float[np.ndarray, "1 3"]) -> str:
    return ", ".join(f"{value:.0f}" for value in values_uT[0])

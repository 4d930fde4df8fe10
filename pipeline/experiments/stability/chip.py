"""Cases of fields beyond the range of a chip, and of chips with faults that occur in real recordings."""

from functools import partial

import numpy as np
from jaxtyping import Bool, Float, Float32
from scipy.constants import micro, milli

from pipeline.experiments.stability.cases import Case, condition_case, error_case, rejection_case
from pipeline.experiments.verification.signals import quiet, read_bare
from reskin.board import faults
from reskin.board.wire import Frames
from reskin.physics.chip import ChipDesign, steps_uT
from reskin.recordings.fault_policy import REFUSE_ALL, FaultLog
from reskin.seeds import rng_for

AREA = "chip"
FRAMES_N = 800
BROKEN_I = 3  # index of the faulty chip
WRAP_COUNTS_N = 2**16  # overflow of an int16 changes its value by this number of counts


def chip_cases(chip: ChipDesign, chips_n: int, seed: int) -> list[Case]:
    """Run cases of fields beyond the range of int16 or 50 mT, and of a chip that fails, is stuck or was reset."""
    intact_uT = _still_board(chip, chips_n, seed)
    broken_i = min(BROKEN_I, chips_n - 1)
    return [
        *_range(), *_failed(intact_uT, broken_i), *_stuck(intact_uT, broken_i),
        *_reset(intact_uT, broken_i, chip.gain_sel),
    ]  # fmt: skip


def _range() -> list[Case]:
    past_uT, beyond_uT = np.array([[5000.0, -4000.0, -8500.0]]), np.array([[60e3, -4e3, -70e3]])
    return [
        out_of_range(past_uT, "5, -4 and -8.5 mT at GAIN_SEL 7 (range 4.915 mT in x and y, 7.93 mT in z)",
                     "the two values beyond the range overflow an int16 and wrap around, and are counted as wrapped",
                     wrapped_n=2, clipped_n=0),
        out_of_range(beyond_uT, "60, -4 and -70 mT at GAIN_SEL 7",
                     "60 and -70 mT are clipped to 50 and -50 mT, which then wrap around; both are counted as clipped "
                     "and as wrapped", wrapped_n=2, clipped_n=2),
    ]  # fmt: skip


def out_of_range(b_uT: Float[np.ndarray, "n 3"], case: str, should: str, *, wrapped_n: int, clipped_n: int) -> Case:
    """Read fields with a noiseless chip at GAIN_SEL 7, which clips fields at 50 mT and wraps counts to int16.

    `wrapped_n` and `clipped_n` are the expected numbers of wrapped and of clipped values.
    """
    read_uT, overruns = read_bare(b_uT * micro, quiet(7), rng_for(0, "stability", "range"))
    step_uT = steps_uT(7)
    truth_uT = b_uT.clip(-50e3, 50e3)
    truth_uT -= WRAP_COUNTS_N * step_uT * np.rint(truth_uT / (WRAP_COUNTS_N * step_uT))
    counted = (overruns.wrapped_n, overruns.clipped_n) == (wrapped_n, clipped_n)
    observed = (
        f"{', '.join(f'{value:.0f}' for value in read_uT[0])} uT; {overruns.wrapped_n} counted as wrapped, "
        f"{overruns.clipped_n} as clipped"
    )
    error = float((np.abs(read_uT - truth_uT) / step_uT).max()) if counted else np.inf
    return error_case(AREA, case, should=should, happened=observed, error=error, limit=0.51)


def _failed(intact_uT: Float32[np.ndarray, "f ch"], broken_i: int) -> list[Case]:
    one_chip = np.zeros((FRAMES_N, intact_uT.shape[1] // 3), bool)
    one_chip[100:150, broken_i] = True
    cases = []
    every_chip = np.ones_like(one_chip)
    for case, dropped in (("50 failed readings of one chip", one_chip), ("all readings failed", every_chip)):
        b_uT = np.where(dropped[..., None], faults.FAILED_B_uT, intact_uT.reshape(*dropped.shape, 3))
        b_uT = b_uT.reshape(intact_uT.shape)
        marked = faults.failed_reads(b_uT, np.where(dropped, faults.FAILED_TEMPERATURE_degC, 25.0))
        case += ", with 8028.16, 5194.00, 12943.36 uT and -880.49 degC"
        cases.append(_marked(case, marked, dropped, should="all failed readings are marked, and no others"))
    return cases


def _stuck(intact_uT: Float32[np.ndarray, "f ch"], broken_i: int) -> list[Case]:
    stuck_uT, from_i = intact_uT.copy(), FRAMES_N // 2
    stuck_uT[from_i:, _axes(broken_i)] = stuck_uT[from_i, _axes(broken_i)]
    expected = np.zeros((FRAMES_N, intact_uT.shape[1] // 3), bool)
    expected[from_i + faults.STUCK_FRAMES_MIN_N - 1 :, broken_i] = True
    resting = np.tile(intact_uT[:1], (FRAMES_N, 1))
    return [
        _marked("a chip that repeats one reading while others change", faults.stuck_chips(stuck_uT), expected,
                should=f"this chip is marked from its {faults.STUCK_FRAMES_MIN_N}th equal reading on, and no others"),
        _marked("a board at rest whose chips all have no noise", faults.stuck_chips(resting), np.zeros_like(expected),
                should="nothing is marked: if all chips repeat their readings, the board is at rest, not faulty"),
    ]  # fmt: skip


def _marked(case: str, marked: Bool[np.ndarray, "f k"], expected: Bool[np.ndarray, "f k"], *, should: str) -> Case:
    hits_n, false_n = int((marked & expected).sum()), int((marked & ~expected).sum())
    observed = (
        f"{hits_n} of {int(expected.sum())} faulty readings marked, and {false_n} of {int((~expected).sum())} others"
    )
    return condition_case(AREA, case, should=should, happened=observed, holds=bool((marked == expected).all()))


def _reset(intact_uT: Float32[np.ndarray, "f ch"], broken_i: int, gain_sel: int) -> list[Case]:
    # After a reset, a chip has the resolution of its power-on settings.
    lsb_uT = np.array([faults.RESET_LSB_XY_uT, faults.RESET_LSB_XY_uT, faults.RESET_LSB_Z_uT])
    reset_uT, axes = intact_uT.copy(), _axes(broken_i)
    reset_uT[:, axes] = np.rint(intact_uT[:, axes] / lsb_uT) * lsb_uT
    found_uT = faults.find_lsb(reset_uT)[broken_i]
    flagged, flagged_intact = (
        np.flatnonzero(faults.reset_chips(b_uT, None)).tolist() for b_uT in (reset_uT, intact_uT)
    )
    known = {f"GAIN_SEL {gain_sel} in the file header": gain_sel, "no settings in the file header": None}
    return [
        condition_case(AREA, f"chip {broken_i} lost its settings: its step is 0.98 uT in x and y, 1.58 uT in z",
                       should="only this chip is flagged",
                       happened=f"flagged: {flagged}; steps found: {found_uT[0]:.2f} and {found_uT[1]:.2f} uT",
                       holds=flagged == [broken_i]),
        condition_case(AREA, "no chip lost its settings", should="no chip is flagged",
                       happened=f"flagged: {flagged_intact}", holds=not flagged_intact),
        *(
            rejection_case(AREA, f"a chip loses its settings while it is recorded, {of_header}",
                           attempt=partial(_detect, np.concatenate([intact_uT, reset_uT]), gain_of_header),
                           should="an error that states the chip and the frame")
            for of_header, gain_of_header in known.items()
        ),
    ]  # fmt: skip


def _detect(b_uT: Float32[np.ndarray, "f ch"], gain_sel: int | None) -> None:
    """Check readings for faults like the ingest stage; raise an error if there is any fault."""
    frames_n, chips_n, expected_lsb_uT = len(b_uT), b_uT.shape[1] // 3, None
    if gain_sel is not None:
        xy_uT, _, z_uT = steps_uT(gain_sel).tolist()
        expected_lsb_uT = (xy_uT, z_uT)
    detector = faults.FaultDetector(chips_n, expected_lsb_uT=expected_lsb_uT)
    warm_degC, t_s = np.full((frames_n, chips_n), 25, np.float32), np.arange(frames_n) / 400
    frames = Frames(b_uT, warm_degC, np.full(frames_n, np.nan), np.arange(frames_n, dtype=np.int64))
    FaultLog(REFUSE_ALL, "stability", "ms").apply(detector.feed(frames, t_s), t_s)


def _axes(chip_i: int) -> slice:
    return slice(3 * chip_i, 3 * chip_i + 3)


def _still_board(chip: ChipDesign, chips_n: int, seed: int) -> Float32[np.ndarray, "f ch"]:
    """Simulate readings of a board without faults in a constant field; the readings vary only by noise."""
    rng = rng_for(seed, "stability", "board")
    rest_T = rng.uniform(-2, 2, (chips_n, 3)) * milli
    return np.concatenate([read_bare(np.tile(chip_T, (FRAMES_N, 1)), chip, rng)[0] for chip_T in rest_T], axis=1)

"""A native capture's broken chips and wrong units are told, frame by frame; sound ones are let pass."""

import dataclasses
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from reskin import seeds
from reskin.board import faults
from reskin.board.wire import Frames
from reskin.errors import CaptureError
from reskin.recordings import probe
from reskin.recordings.chips import SCALE_FRAMES_N, Watch
from reskin.recordings.header import Firmware
from reskin.recordings.text import check_log
from tests.board.signals import frames_of
from tests.recordings.headers import AS_USUAL, make_header

CHIPS_N = 3
RESET_uT = (faults.RESET_LSB_XY_uT, faults.RESET_LSB_XY_uT, faults.RESET_LSB_Z_uT)
LOG = probe.parse(
    "indentation,pass_i,phase,t_start_s,t_end_s,x_mm,y_mm,depth_mm,Fx_N,Fy_N,Fz_N\n"
    "0,0,noload,0.0,0.5,,,,,,0\n0,0,contact,1.0,1.5,2,4,0.6,,,1.25\n"
    "1,0,noload,2,2.5,,,,,,0\n1,0,contact,3,3.5,16,4,0.8,,,2.5\n",
    "probe.csv",
)


def board(frames_n: int, *, steps_uT: tuple[float, float, float] = (0.15, 0.15, 0.242), seed: int = 0) -> Frames:
    """Chips with 5 uT of noise about some field, on the grid of their LSB."""
    rng = seeds.rng_for(seed, "watch")
    rest_uT = seeds.rng_for(0, "rest").uniform(-1500, 1500, 3 * CHIPS_N)
    b_uT = rest_uT + 5 * rng.standard_normal((frames_n, 3 * CHIPS_N))
    grid_uT = np.tile(steps_uT, CHIPS_N)
    return frames_of(np.round(b_uT / grid_uT) * grid_uT, np.full((frames_n, CHIPS_N), 25.0))


def changed(frames: Frames, rows: slice, chip_i: int, values_uT: np.ndarray) -> Frames:
    b_uT = frames.b_uT.copy()
    b_uT[rows, 3 * chip_i : 3 * chip_i + 3] = values_uT
    return dataclasses.replace(frames, b_uT=b_uT)


def look(frames: Frames, *ends: int, **header: object) -> np.ndarray:
    """Watch frames in portions that end at `ends`."""
    watch = Watch(
        make_header(**({"layout": "native", "wire": "binary", "chips_n": CHIPS_N} | header)), "stream.bin", AS_USUAL
    )
    edges = [0, *sorted(ends), len(frames)]
    masks = []
    for begin, end in pairwise(edges):
        rows = (np.arange(len(frames)) >= begin) & (np.arange(len(frames)) < end)
        masks.append(watch.stuck(frames.where(rows), np.zeros(end - begin, bool)))
    return np.concatenate(masks)


def test_a_sound_board_is_let_pass() -> None:
    assert not look(board(2000)).any()
    assert not look(board(2000), firmware=Firmware(gain_sel=7, lsb_xy_uT=0.15, lsb_z_uT=0.242)).any()


@pytest.mark.parametrize("chips", [(1,), (0, 1, 2)])
@pytest.mark.parametrize("firmware", [None, Firmware(gain_sel=7, lsb_xy_uT=0.15, lsb_z_uT=0.242)])
def test_a_chip_that_loses_its_settings_on_the_way_is_named(chips: tuple[int, ...], firmware: Firmware | None) -> None:
    frames, reset = board(2000), board(2000, steps_uT=RESET_uT)
    for chip_i in chips:
        columns = slice(3 * chip_i, 3 * chip_i + 3)
        frames = changed(frames, slice(1200, None), chip_i, reset.b_uT[1200:, columns])
    message = rf"stream.bin from sound frame 1201: the LSB of chip {', '.join(map(str, chips))} must .* got 0.98 uT"
    with pytest.raises(CaptureError, match=message):
        look(frames, 500, 1300, firmware=firmware)


def test_a_board_whose_chips_all_change_to_any_other_scale_is_refused() -> None:
    frames, other = board(1600), board(1600, steps_uT=(0.6, 0.6, 0.968))
    for chip_i in range(CHIPS_N):
        frames = changed(frames, slice(800, None), chip_i, other.b_uT[800:, 3 * chip_i : 3 * chip_i + 3])
    with pytest.raises(CaptureError, match="from sound frame 801: the LSB of chip 0, 1, 2 must be as before"):
        look(frames)


def test_a_chip_that_freezes_for_two_thirds_of_the_stream_is_stuck_there() -> None:
    frames = board(1500)
    frozen = changed(frames, slice(500, None), 1, frames.b_uT[500, 3:6])
    stuck = look(frozen)
    # It is told from the 20th equal reading on.
    assert np.flatnonzero(stuck).tolist() == list(range(500 + faults.STUCK_FRAMES_MIN_N - 1, 1500))


@settings(max_examples=20, deadline=None)
@given(ends=st.lists(st.integers(0, 3 * SCALE_FRAMES_N), max_size=6))
def test_portions_do_not_matter(ends: list[int]) -> None:
    frames = board(3 * SCALE_FRAMES_N)
    frozen = changed(frames, slice(100, 300), 1, frames.b_uT[100, 3:6])
    np.testing.assert_array_equal(look(frozen, *ends), look(frozen))


def test_failed_reads_are_not_looked_at() -> None:
    failed = changed(board(100), slice(10, 60), 0, np.array(faults.FAILED_B_uT))
    watch = Watch(make_header(layout="native", wire="binary", chips_n=CHIPS_N), "stream.bin", AS_USUAL)
    mask = np.arange(100) // 10 % 6 > 0
    assert not (watch.stuck(failed, mask) & mask).any()


@pytest.mark.parametrize(("factor", "unit"), [(1e-3, "mT or G"), (1e-2, "(mT or )?G"), (1e-6, "mT or G")])
def test_fields_in_other_units_are_refused(factor: float, unit: str) -> None:
    frames = board(1000)
    other = dataclasses.replace(frames, b_uT=frames.b_uT * np.float32(factor))
    with pytest.raises(CaptureError, match=f"stream.bin: field must be .* Convert {unit} to uT"):
        look(other)


@pytest.mark.parametrize(("wire", "other"), [("text-xyzt", "text-txyz"), ("text-txyz", "text-xyzt")])
def test_the_other_text_order_is_suspected(wire: str, other: str) -> None:
    right = board(100)
    chips = right.b_uT.reshape(-1, CHIPS_N, 3)
    degC = right.temperature_degC[..., None]
    sent = np.concatenate([degC, chips] if other == "text-txyz" else [chips, degC], axis=2)
    at = 0 if wire == "text-txyz" else 3
    for scale in (1.0, 0.05):  # also fields as weak as temperatures
        wrong = np.where(sent == degC, sent, scale * sent) if scale < 1 else sent
        swapped = frames_of(np.delete(wrong, at, axis=2).reshape(len(right), -1), wrong[..., at])
        with pytest.raises(CaptureError, match=rf"temperatures of {wire} must be .* Is the wire format {other}\?"):
            look(swapped, wire=wire)
    assert not look(right, wire=wire).any()


@pytest.mark.parametrize(
    ("column", "factor", "says"),
    [
        ("x_mm", 1e-3, "places must be .* Convert m or um"),
        ("x_mm", 1e3, "places must be .* Convert m or um"),
        ("depth_mm", 1e-3, "depth must be .* Convert m or um"),
        ("depth_mm", 1e3, "depth must be .* Convert m or um"),
        ("Fz_N", 102.0, "force must be below 100 N; got 127.5 in line 3. Convert grams"),
        ("Fz_N", 1e3, "force must be below 100 N"),
        ("Fz_N", 1e-3, "force must be 0.05 N or more somewhere in contact; got 0.0025 at most"),
        ("Fz_N", -1.0, "the usual Fz_N in contact must be positive; got -1.875 N. Turn its sign"),
    ],
)
def test_a_probe_log_in_other_units_or_signs_is_refused(column: str, factor: float, says: str) -> None:
    check_log(LOG, "probe.csv")
    other = dataclasses.replace(LOG, **{column: getattr(LOG, column) * np.float32(factor)})
    with pytest.raises(CaptureError, match=rf"^probe.csv: {says}"):
        check_log(other, "probe.csv")


def test_a_log_that_knows_no_label_is_let_pass() -> None:
    unknown = np.full(len(LOG), np.nan, np.float32)
    check_log(dataclasses.replace(LOG, **dict.fromkeys(probe.LABELS, unknown)), "probe.csv")

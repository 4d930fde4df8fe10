"""Tests of the checks of units, which refuse implausible values."""

from typing import get_args

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from reskin import seeds
from reskin.errors import CaptureError
from reskin.recordings import ReaderLayout
from reskin.recordings.readers import READERS
from reskin.recordings.tables import TableFile, make_readings
from reskin.recordings.units import check_fields, check_labels
from reskin.schema import to_table
from tests.recordings.headers import make_header

SKIN_uT = np.array([[-541.2, 917.2, 44.9], [120.0, -3600.0, 700.0]])
# For each real board, these are the step (LSB) and the typical field in uT. Two boards have ReSkin skins, one has
# eFlesh, and one has eFlesh at another gain of the chips.
BOARDS_uT = {"ini": (0.15, 400.0), "lab": (0.2, 1500.0), "eflesh": (2.4, 9000.0), "eflesh shear": (0.6, 6000.0)}


def fields_uT(step_uT: float, usual_uT: float, seed: int = 0) -> np.ndarray:
    """Return 1000 noisy rows of five chips.

    Fields are about `usual_uT`, and are rounded to multiples of `step_uT`.
    """
    rng = seeds.rng_for(seed, "fields")
    axes = rng.standard_normal((5, 3))
    rest_uT = usual_uT * axes / np.linalg.norm(axes, axis=1, keepdims=True)
    b_uT = rest_uT.ravel() + 5 * rng.standard_normal((1000, 15))
    return np.round(b_uT / step_uT) * step_uT


def test_fields_of_a_skin_are_accepted_only_in_microtesla() -> None:
    check_fields(SKIN_uT, "here")
    with pytest.raises(CaptureError, match="convert the fields to uT"):
        check_fields(SKIN_uT / 1e3, "here")
    with pytest.raises(CaptureError, match="in line 2"):
        check_fields(SKIN_uT * 1e3, "here")


@settings(deadline=None, max_examples=20)
@given(name=st.sampled_from(sorted(BOARDS_uT)), seed=st.integers(0, 1000))
def test_fields_of_a_board_are_accepted_only_in_microtesla(name: str, seed: int) -> None:
    b_uT = fields_uT(*BOARDS_uT[name], seed)
    check_fields(b_uT, "here")
    for factor in (1e-2, 1e-3, 1e-6, 1e3):
        with pytest.raises(CaptureError, match="^here: .*field must be .* got .* uT"):
            check_fields(factor * b_uT, "here")


def test_strong_fields_in_gauss_are_recognised_by_the_step_of_the_chips() -> None:
    with pytest.raises(CaptureError, match="must be 0.1 to 100 uT, .*; got 0.024. The unit is probably G"):
        check_fields(1e-2 * fields_uT(*BOARDS_uT["eflesh"]), "here")


@pytest.mark.parametrize("usual_uT", [30.0, 65.0, 3000.0])
def test_fields_without_a_detectable_step_are_accepted_if_as_strong_as_the_earths_field(usual_uT: float) -> None:
    constant = np.tile(fields_uT(0.15, usual_uT)[:1] * 0 + usual_uT / np.sqrt(3), (400, 1))
    check_fields(constant, "here")
    smooth = usual_uT + seeds.rng_for(0, "smooth").standard_normal((400, 15))
    check_fields(smooth, "here")
    check_fields(smooth.round(2), "here")


def test_recorded_fields_are_accepted_only_in_microtesla(shared_data) -> None:
    files = sorted((shared_data / "lab").glob("*.csv"))
    boards = [np.loadtxt(file, delimiter=",", skiprows=1, usecols=[5, 6, 7, 9, 10, 11]) for file in files]
    boards += [np.loadtxt(file, delimiter=",")[:, 1:] for file in sorted((shared_data / "eflesh").rglob("sensor.csv"))]
    assert len(boards) > 6
    for b_uT in boards:
        check_fields(b_uT, "here")
        with pytest.raises(CaptureError, match="The unit is probably G"):
            check_fields(b_uT / 100, "here")


def check(place_mm: np.ndarray, first_line_n: int = 1, **others: np.ndarray) -> None:
    """Check labels of rows that are all in contact."""
    labels = {"x_mm": place_mm[:, 0], "y_mm": place_mm[:, 1], **others}
    check_labels(labels, np.ones(len(place_mm), bool), "here", first_line_n=first_line_n)


def test_forces_are_accepted_only_in_newtons() -> None:
    unknown_mm, press_N = np.full((4, 2), np.nan), np.array([np.nan, 0.0, -9.5, 3.4])
    check(unknown_mm, Fx_N=press_N)
    with pytest.raises(CaptureError, match="in line 12"):
        check(unknown_mm, first_line_n=10, Fx_N=press_N * 101.97)


def test_implausible_forces_are_refused() -> None:
    unknown_mm = np.full((3, 2), np.nan)
    for fine_N in (np.array([0.0, 0.05, np.nan]), np.zeros(3), np.full(3, np.nan), np.array([0.1, -1.0, 0.0])):
        check(unknown_mm, Fy_N=fine_N)
    with pytest.raises(CaptureError, match="^here: force must be .* got 0.0416 N at most. If the unit is kg"):
        check(unknown_mm, Fx_N=np.zeros(3), Fy_N=np.array([0.0, -0.0416, np.nan]))


@settings(deadline=None)
@given(extent_mm=st.floats(1.0, 199.0), start_mm=st.floats(-500, 500))
def test_places_are_accepted_only_in_millimetres(extent_mm: float, start_mm: float) -> None:
    place_mm = np.array([[start_mm, 3.0], [start_mm + extent_mm * 1.001, 3.0], [np.nan, np.nan]])
    check(place_mm)
    for factor in (1e-3, 1e3):
        if extent_mm * factor > 200 or 0.01 < extent_mm * factor < 1:
            with pytest.raises(
                CaptureError, match="^here: places must be all equal, or spread over a range of 1 to 200 mm"
            ):
                check(factor * place_mm)


def test_error_names_the_line_of_a_place_far_from_all_others() -> None:
    place_mm = np.array([[np.nan, np.nan], *([float(i), 2.0] for i in range(19)), [999.0, 2.0]])
    with pytest.raises(CaptureError, match=r"line 22 \(999, 2 mm\) is far from the other places"):
        check(place_mm, first_line_n=2)
    with pytest.raises(CaptureError, match="convert the places to mm"):
        check(1e3 * place_mm[:20])


def test_single_place_with_rounding_errors_counts_as_one_place() -> None:
    check(np.array([[315.0, -100.0], [315.00003, -99.99999]]))
    check(np.full((3, 2), np.nan))


@pytest.mark.parametrize(
    ("deepest_mm", "accepted"), [(1.2, True), (0.0, True), (12.0, True), (0.0012, False), (1200, False)]
)
def test_depths_are_accepted_only_in_millimetres(deepest_mm: float, accepted: bool) -> None:
    unknown_mm, depth_mm = np.full((4, 2), np.nan), np.array([0.0, deepest_mm / 2, deepest_mm, np.nan])
    if accepted:
        check(unknown_mm, depth_mm=depth_mm)
    else:
        with pytest.raises(CaptureError, match="^here: the greatest depth must be 0.05 to 100 mm"):
            check(unknown_mm, depth_mm=depth_mm)


@pytest.mark.parametrize(
    ("text", "message"), [("", "the file is empty"), ("1,2\n1,2.8", "last line has no line break")]
)
def test_text_that_ends_within_a_number_is_refused(tmp_path, text: str, message: str) -> None:
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(CaptureError, match=message):
        TableFile(tmp_path / "a.csv", "a.csv")


def test_each_layout_has_a_reader() -> None:
    assert set(READERS) == set(get_args(ReaderLayout))


def test_readings_have_nan_for_quantities_that_were_not_recorded() -> None:
    readings = make_readings(
        make_header(chips_n=2), np.array([True, False]), indentation=np.zeros(2), pass_i=np.zeros(2),
        b_uT=np.ones((2, 6)), noload_uT=np.ones((2, 6)), n_contacts=np.zeros(2),
    )  # fmt: skip
    table = to_table(readings)
    assert np.isnan(np.asarray(table.column("temperature_degC").combine_chunks().flatten())).tolist() == [True, True]

"""Tests of the rows on which models are trained: field change, passes, indentation numbers, order of captures."""

import numpy as np
import pytest

from reskin.data.rows import SHEAR_TARGETS, Selection, gather
from reskin.errors import ParamsError
from tests.data.tables import readings

ALL = Selection(force_min_N=0.0)


def test_field_change_uses_the_no_load_reading_of_the_row():
    rows = gather([readings()], ALL)
    assert rows.db_uT[:, 0].tolist() == [0, 1, 2, 3, 4, 5]


def test_dropped_rows_are_counted_by_reason():
    x_mm = np.array([0, np.nan, 2, 3, 4, 5], np.float32)
    y_mm = np.array([0, 1, 2, 3, np.nan, 5], np.float32)
    Fz_N = np.array([1, 1, 0.05, np.nan, 1, 1], np.float32)
    rows = gather([readings(x_mm=x_mm, y_mm=y_mm, Fz_N=Fz_N)], Selection(force_min_N=0.1))
    # The row at x = 3 mm is kept, because the selection ignores forces that are unknown.
    assert rows.target[:, 0].tolist() == [0, 3, 5]
    assert rows.dropped == {"no_contact_rows_n": 2, "low_force_rows_n": 1}


def test_pass_numbers_continue_across_captures_of_a_skin():
    rows = gather([readings("c1"), readings("c0"), readings("c2", skin="s1")], ALL)
    assert rows.pass_i.tolist() == [0, 0, 0, 1, 1, 1, 2, 2, 2, 3, 3, 3, 0, 0, 0, 1, 1, 1]


def test_indentations_of_all_captures_get_different_numbers():
    # Both captures use these indentation numbers, which do not start at 0.
    press = np.array([7, 7, 2, 2, 9, 9], np.int32)
    lost = np.array([0, 0, np.nan, np.nan, 4, 4], np.float32)
    rows = gather([readings("c1", indentation=press, x_mm=lost), readings("c0", indentation=press)], ALL)
    naive, seen = [], []
    for capture, number in zip(rows.capture, [*press, *press[~np.isnan(lost)]], strict=True):
        if (capture, number) not in seen:
            seen.append((capture, number))
        naive.append((capture, number))
    same = np.array([[one == other for one in naive] for other in naive])
    assert ((rows.indentation[:, None] == rows.indentation) == same).all()
    assert sorted(set(rows.indentation.tolist())) == list(range(len(seen)))
    assert rows.indentation[rows.capture == "c0"].max() < rows.indentation[rows.capture == "c1"].min()


def test_rows_do_not_depend_on_the_order_of_captures():
    one, other = readings("c0"), readings("c1", board="b1", skin="s1", Fz_N=np.full(6, 2, np.float32))
    expected, actual = gather([one, other], ALL), gather([other, one], ALL)
    assert (expected.board == actual.board).all()
    assert (expected.target == actual.target).all()


@pytest.mark.parametrize(
    ("second", "message"),
    [
        (readings("c1", board="b9"), "board of skin s0 must be b0"),
        (readings("c1", skin="s1", source="simulated"), "source must be recorded"),
        (
            readings("c1", skin="s1", b_uT=np.zeros((6, 6), np.float32), noload_uT=np.zeros((6, 6), np.float32)),
            "2 chips, but c0 in the same scene has 1",
        ),
    ],
)
def test_gather_raises_if_captures_do_not_fit_together(second, message):
    with pytest.raises(ParamsError, match=message):
        gather([readings(), second], ALL)


def test_gather_raises_if_no_row_of_a_capture_is_usable():
    with pytest.raises(ParamsError, match=r"capture c1: none of \d+ readings has a known place and at least 0.0 N"):
        gather([readings(), readings("c1", board="b1", skin="s1", Fz_N=np.full(6, -3, np.float32))], ALL)


def test_gather_raises_if_there_are_no_captures():
    with pytest.raises(ParamsError, match="reskin add"):
        gather([], ALL)


def test_targets_have_the_columns_that_the_caller_chooses():
    rows = gather(
        [readings(Fx_N=np.full(6, 0.5, np.float32), Fy_N=np.full(6, -0.25, np.float32))], ALL, targets=SHEAR_TARGETS
    )
    assert rows.target.tolist() == [[i, 2, 0.5, -0.25, 1] for i in range(6)]
    assert gather([readings()], ALL).target.tolist() == [[i, 2, 1] for i in range(6)]

"""Rows below a scene's rows: nothing above moves, and by hand nothing but order is known."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.core.errors import ParamsError
from pipeline.dataset.lines import hand_lines, hand_rows, shifted
from pipeline.dataset.rows import Selection, gather, stack
from tests.dataset.tables import readings

ALL = Selection(force_min_N=0.0)
UNKNOWN = np.full(6, np.nan, np.float32)


def by_hand(skin: str = "s0", **changes: object):
    pressed = {"indentation": np.repeat(np.arange(3, dtype=np.int32), 2), "pass_i": np.zeros(6, np.int32)}
    unknown = {"x_mm": UNKNOWN, "y_mm": UNKNOWN, "depth_mm": UNKNOWN, "Fz_N": UNKNOWN}
    return readings(f"{skin}-hand", "b0", skin, **(pressed | unknown | changes))


@given(st.integers(2, 12), st.integers(2, 12))
def test_rows_above_stay_as_they_were_and_indentations_are_never_shared(above_n, below_n):
    above, below = gather([readings("c0", f=above_n)], ALL), gather([readings("c1", skin="s1", f=below_n)], ALL)
    both = stack(above, below)
    assert len(both) == above_n + below_n
    for name in ("capture", "board", "skin", "db_uT", "target", "pass_i", "indentation"):
        assert (getattr(both, name)[:above_n] == getattr(above, name)).all()
    assert (both.db_uT[above_n:] == below.db_uT).all()
    assert (both.skin[above_n:] == "s1").all()
    assert not {*both.indentation[:above_n]} & {*both.indentation[above_n:]}
    assert len({*both.indentation[above_n:]}) == len({*below.indentation})


def test_pokes_by_hand_have_fields_but_neither_place_nor_force_and_no_row_is_left_out():
    rows, _ = hand_rows([by_hand("s0"), by_hand("s1")])
    assert len(rows) == 12
    assert np.isnan(rows.target).all()
    assert rows.db_uT[:, 0].tolist() == [0, 1, 2, 3, 4, 5] * 2
    assert len({*rows.indentation}) == 6


def test_lines_of_each_skin_name_its_own_rows_in_the_order_of_the_hand():
    captures = [by_hand("s0"), by_hand("s1")]
    rows, lines = hand_rows(captures)
    for one in captures:
        alone = hand_lines(one.pass_i, one.indentation)
        assert lines[one.skin].order_i.tolist() == alone.order_i.tolist() == [0, 0, 1, 1, 2, 2]
        assert set(rows.skin[lines[one.skin].row]) == {one.skin}
    above = gather([readings("c0", f=4)], ALL)
    below = shifted(lines["s1"], len(above))
    assert set(stack(above, rows).skin[below.row]) == {"s1"}


def test_boards_of_other_channels_and_a_skin_poked_twice_are_refused():
    wide = {name: np.zeros((6, 6), np.float32) for name in ("b_uT", "noload_uT")}
    other = gather([readings("c1", skin="s1", temperature_degC=np.zeros((6, 2), np.float32), **wide)], ALL)
    with pytest.raises(ParamsError, match="channels must be the 3 of c0; got 6"):
        stack(gather([readings("c0")], ALL), other)
    with pytest.raises(ParamsError, match="its skin must be poked by hand in one capture; got s0"):
        hand_rows([by_hand("s0"), by_hand("s0")])

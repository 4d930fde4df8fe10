"""Scan order: the number of an indentation in its pass, aligned with the selected rows."""

import numpy as np

from reskin.data.rows import Selection, gather, gather_scan, number_in_pass
from reskin.schema import Readings
from tests.data.tables import readings

ALL = Selection(force_min_N=0.0)


def test_indentations_count_from_0_in_each_pass():
    press = np.array([7, 7, 8, 20, 21, 21], np.int32)
    one = readings(indentation=press, pass_i=np.array([0, 0, 0, 1, 1, 1], np.int32))
    assert number_in_pass(one).tolist() == [0, 0, 1, 0, 1, 1]


def test_excluded_rows_keep_their_numbers():
    lost = np.array([0, np.nan, 2, 3, np.nan, 5], np.float32)
    one = readings(x_mm=lost, noload_uT=np.arange(18, dtype=np.float32).reshape(6, 3))
    scan = gather_scan([one], ALL)
    assert scan.scan_i.tolist() == [0, 2, 0, 2]
    assert scan.noload_uT[:, 0].tolist() == [0, 6, 9, 15]


def test_rows_are_aligned_with_gather():
    def made(name: str, first: float) -> Readings:
        x_mm = first + np.arange(6, dtype=np.float32)
        return readings(name, x_mm=x_mm, noload_uT=np.tile(x_mm[:, None], 3))

    captures = [made("c1", 10.0), made("c0", 0.0)]
    assert gather_scan(captures, ALL).noload_uT[:, 0].tolist() == gather(captures, ALL).target[:, 0].tolist()

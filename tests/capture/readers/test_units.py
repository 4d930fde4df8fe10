"""Units that cannot be right are told; those that can are let pass."""

import numpy as np
import pytest

from pipeline.capture.readers import READERS
from pipeline.capture.readers.units import check_fields, check_forces
from pipeline.errors import CaptureError

SKIN_uT = np.array([[-541.2, 917.2, 44.9], [120.0, -3600.0, 700.0]])


def test_a_skins_field_passes_in_microtesla_only() -> None:
    check_fields(SKIN_uT, "here", first_line_n=1)
    with pytest.raises(CaptureError, match="Convert mT or G"):
        check_fields(SKIN_uT / 1e3, "here", first_line_n=1)
    with pytest.raises(CaptureError, match="in line 2"):
        check_fields(SKIN_uT * 1e3, "here", first_line_n=1)


def test_a_press_passes_in_newtons_only() -> None:
    press_N = np.array([np.nan, 0.0, -9.5, 3.4])
    check_forces(press_N, "here", first_line_n=1)
    with pytest.raises(CaptureError, match="in line 12"):
        check_forces(press_N * 101.97, "here", first_line_n=10)


def test_each_layout_has_a_reader() -> None:
    assert set(READERS) == {"lab", "ini", "eflesh"}

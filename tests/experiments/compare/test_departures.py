"""Tests of departures: differences between a capture and the skin of its scene that suggest wrong labels."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.experiments.compare import find_departure
from reskin.recordings.readers import lab
from reskin.schema import Readings
from tests.experiments.compare.test_run import DESIGN, SECTION
from tests.recordings.test_recordings import ingest


@pytest.fixture(scope="module")
def real(shared_data, tmp_path_factory) -> Readings:
    """Return every third poke of a recording of lab board 1, with five readings per poke."""
    readings, _ = ingest(lab, shared_data / "lab/board1_depth2.csv", tmp_path_factory.mktemp("lab"))
    return select(readings, (readings.indentation % 3 == 0) & (readings.reading_i < 5))


def select(readings: Readings, rows: np.ndarray) -> Readings:
    arrays = {name: value[rows] for name, value in vars(readings).items() if isinstance(value, np.ndarray)}
    return replace(readings, **arrays)


def test_agreeing_recording_has_no_departure(real):
    assert find_departure([real], SECTION, DESIGN) is None


def test_swapped_chips_are_named(real):
    order = np.arange(15).reshape(5, 3)[[0, 2, 1, 3, 4]].ravel()
    swapped = replace(real, b_uT=real.b_uT[:, order], noload_uT=real.noload_uT[:, order])
    assert find_departure([swapped], SECTION, DESIGN) == "Against the scene, chips 1 and 2 are exchanged."


def test_mirrored_labels_are_named(real):
    mirrored = replace(real, y_mm=16 - real.y_mm)
    assert find_departure([mirrored], SECTION, DESIGN) == "Against the scene, the labels are mirrored along y."


def test_incomplete_captures_have_no_departure(real):
    unknown = np.full(len(real), np.nan, np.float32)
    few = select(real, real.indentation < 30)
    fewer_chips = replace(real, b_uT=real.b_uT[:, :12], noload_uT=real.noload_uT[:, :12])
    for cannot in (replace(real, Fz_N=unknown), replace(real, x_mm=unknown), few, fewer_chips):
        assert find_departure([cannot], SECTION, DESIGN) is None

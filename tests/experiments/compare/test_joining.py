"""A capture that joins a scene: one that lies as the scene says is told nothing of, exchanged chips and labels are."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.experiments.compare import POKES_MAX_N, _thin, departure
from reskin.recordings.readers import lab
from reskin.schema import Readings
from reskin.universal.presses import pool
from tests.experiments.compare.test_run import DESIGN, SECTION
from tests.recordings.test_recordings import ingest


@pytest.fixture(scope="module")
def real(shared_data, tmp_path_factory) -> Readings:
    """A third of the pokes of a file of board 1, five readings each."""
    readings, _ = ingest(lab, shared_data / "lab/board1_depth2.csv", tmp_path_factory.mktemp("lab"))
    return some(readings, (readings.indentation % 3 == 0) & (readings.reading_i < 5))


def some(readings: Readings, rows: np.ndarray) -> Readings:
    words = {name: value[rows] for name, value in vars(readings).items() if isinstance(value, np.ndarray)}
    return replace(readings, **words)


def test_a_recorded_file_that_lies_as_its_scene_says_gives_no_warning(real):
    assert departure([real], SECTION, DESIGN) is None


def test_exchanged_chips_of_a_recorded_file_are_named(real):
    order = np.arange(15).reshape(5, 3)[[0, 2, 1, 3, 4]].ravel()
    swapped = replace(real, b_uT=real.b_uT[:, order], noload_uT=real.noload_uT[:, order])
    assert departure([swapped], SECTION, DESIGN) == "Against the scene, chips 1 and 2 are exchanged."


def test_mirrored_labels_of_a_recorded_file_are_named(real):
    mirrored = replace(real, y_mm=16 - real.y_mm)
    assert departure([mirrored], SECTION, DESIGN) == "Against the scene, the labels are mirrored along y."


def test_what_cannot_tell_gives_no_warning(real):
    unknown = np.full(len(real), np.nan, np.float32)
    few = some(real, real.indentation < 30)
    fewer_chips = replace(real, b_uT=real.b_uT[:, :12], noload_uT=real.noload_uT[:, :12])
    for cannot in (replace(real, Fz_N=unknown), replace(real, x_mm=unknown), few, fewer_chips):
        assert departure([cannot], SECTION, DESIGN) is None


def test_many_pokes_are_thinned_evenly(real):
    pokes = pool([real])
    many = _thin(
        replace(
            pokes,
            **{
                name: np.repeat(getattr(pokes, name), 10, axis=0)
                for name in ("group_i", "capture_i", "place_mm", "force_N", "db_uT", "noload_uT")
            },
        )
    )
    assert len(many) == POKES_MAX_N
    assert (many.place_mm[[0, -1]] == pokes.place_mm[[0, -1]]).all()

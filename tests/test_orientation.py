"""Tests that exchanged, mirrored and rotated axes of labels are detected by comparison with captures of other skins."""

import shutil

import numpy as np
import pytest

from pipeline.manage.add import COMPARED_PRESSES_MAX_N, ORIENTATIONS, Presses, other_orientation, presses_of
from reskin.recordings.readers import lab
from reskin.recordings.tables import make_readings
from reskin.seeds import rng_for
from tests.fields import fields_uT
from tests.recordings.headers import DEFAULT_POLICY, make_header

DEPARTURES = [name for name in ORIENTATIONS if name != "as they are"]


def board(name: str, presses_n: int = 60) -> Presses:
    """Return presses of a skin, with noise and random gains of the channels."""
    rng = rng_for(0, "orientation", name)
    place_mm = rng.uniform(-8, 8, (presses_n, 2))
    db_uT = fields_uT(place_mm, rng.uniform(1, 5, presses_n)) * rng.normal(1, 0.1, 15)
    db_uT = db_uT + rng.normal(0, 5, db_uT.shape)
    return Presses(place_mm, db_uT / np.linalg.norm(db_uT, axis=1, keepdims=True))


def relabel(presses: Presses, way: str) -> Presses:
    return Presses(presses.place_mm @ np.array(ORIENTATIONS[way]).T, presses.direction)


def inverse_of(way: str) -> str:
    inverse = np.array(ORIENTATIONS[way]).T.tolist()
    return next(name for name, matrix in ORIENTATIONS.items() if matrix == inverse)


@pytest.mark.parametrize("way", DEPARTURES)
def test_change_of_the_labels_is_found_and_its_inverse_is_reported(way):
    assert other_orientation(relabel(board("one"), way), board("other")) == inverse_of(way)


def test_no_alarm_is_raised_for_correct_labels_or_too_little_information():
    one, other = board("one"), board("other")
    assert other_orientation(one, other) is None
    assert other_orientation(relabel(board("few", 19), "with x mirrored"), other) is None
    fewer_chips = Presses(other.place_mm, other.direction[:, :9])
    assert other_orientation(relabel(one, "with x mirrored"), fewer_chips) is None
    noise = Presses(other.place_mm, rng_for(0, "noise").normal(size=other.direction.shape))
    assert other_orientation(relabel(one, "with x mirrored"), noise) is None


def test_each_wrong_orientation_of_labels_is_found_on_recorded_boards(shared_data, tmp_path):
    """The recordings at depth 2 are used.

    Of all 18 pairs of recordings, only one is inconclusive: board 2 at depth 3 compared with board 1 at depth 1.
    """
    boards = {}
    for number in (1, 2):
        shutil.copy(shared_data / f"lab/board{number}_depth2.csv", tmp_path / lab.READINGS)
        readings, _ = lab.read(tmp_path, make_header(layout="lab", chips_n=5), DEFAULT_POLICY)
        boards[number] = presses_of([readings])
    for new, other in ((1, 2), (2, 1)):
        assert other_orientation(boards[new], boards[other]) is None
        for way in DEPARTURES:
            assert other_orientation(relabel(boards[new], way), boards[other]) == inverse_of(way)


@pytest.mark.parametrize(("place_mm", "compared_n"), [(2.0, COMPARED_PRESSES_MAX_N), (np.nan, 0)])
def test_long_capture_is_thinned_and_presses_without_a_place_are_left_out(place_mm, compared_n):
    """The comparison of 20000 presses with 20000 others would need several GB of memory."""
    n = 3 * COMPARED_PRESSES_MAX_N
    fields = np.ones((n, 15))
    readings = make_readings(
        make_header(chips_n=5), np.ones(n, bool), indentation=np.arange(n), pass_i=np.zeros(n),
        x_mm=np.full(n, place_mm), y_mm=np.full(n, place_mm), b_uT=2 * fields, noload_uT=fields, n_contacts=np.zeros(n),
    )  # fmt: skip
    assert len(presses_of([readings]).place_mm) == compared_n

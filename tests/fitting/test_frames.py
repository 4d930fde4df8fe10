"""Tests that mirrored, rotated and exchanged labels and chips are found by comparison with the nominal skin."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from pipeline.fitting.axes import BoardAxes
from pipeline.fitting.frames import TURNS, find_departure, frames_of, quarter_turn
from pipeline.fitting.presses import RecordedPresses
from pipeline.settings import Settings
from pipeline.training.recorded import Compare
from reskin.config import read_yaml
from reskin.errors import ParamsError
from reskin.layouts import FOLDER
from reskin.recordings.readers import lab
from reskin.schema import Readings
from reskin.universal.law import simulate_uT
from tests.data.tables import readings
from tests.fitting.recorded import AXES, simulated_presses
from tests.recordings.test_recordings import ingest


@pytest.fixture(scope="module")
def recorded() -> RecordedPresses:
    return simulated_presses()


def sentence(pokes: RecordedPresses) -> str:
    return frames_of(AXES.align(pokes), AXES).sentence(AXES.stated_by)


def test_presses_that_agree_with_the_scene_are_oriented_as_stated(recorded):
    assert sentence(recorded) == "Labels, chips and skin are oriented as layout reskin states."


def test_exchanged_chips_are_found(recorded):
    swapped = replace(recorded, db_uT=recorded.db_uT[:, [0, 2, 1, 3, 4]])
    assert sentence(swapped) == "Contrary to layout reskin, chips 1 and 2 are exchanged."


def test_rotated_chip_is_reported(recorded):
    db_uT = recorded.db_uT.copy()
    db_uT[:, 3] = db_uT[:, 3] @ quarter_turn(1)
    assert sentence(replace(recorded, db_uT=db_uT)) == (
        "Contrary to layout reskin, chip 3 is turned by 90 degrees more than layout reskin says."
    )


@pytest.mark.parametrize("axis", [0, 1])
def test_axis_along_which_labels_are_mirrored_is_reported(recorded, axis):
    place_mm = recorded.place_mm.copy()
    place_mm[:, axis] = 16.0 - place_mm[:, axis]
    assert sentence(replace(recorded, place_mm=place_mm)) == (
        f"Contrary to layout reskin, the labels are mirrored along {'xy'[axis]}."
    )


def test_skin_with_exchanged_poles_is_reported(recorded):
    flipped = replace(recorded, db_uT=-recorded.db_uT)
    assert sentence(flipped) == "Contrary to layout reskin, the skin is flipped: every field has the opposite sign."


def test_sixteen_orientations_of_a_skin_are_distinct():
    matrices = {tuple(turn.matrix.ravel().round().astype(int)) for turn in TURNS}
    assert len(matrices) == len(TURNS) == 16
    assert TURNS[0].describe() == ""
    assert all(turn.matrix[2, 2] == (1 if i < 8 else -1) for i, turn in enumerate(TURNS))


@pytest.fixture(scope="module")
def real(shared_data, tmp_path_factory) -> Readings:
    """Return every third press of a recording of lab board 1, with five readings per press."""
    readings, _ = ingest(lab, shared_data / "lab/board1_depth2.csv", tmp_path_factory.mktemp("lab"))
    return select(readings, (readings.indentation % 3 == 0) & (readings.reading_i < 5))


def select(readings: Readings, rows: np.ndarray) -> Readings:
    arrays = {name: value[rows] for name, value in vars(readings).items() if isinstance(value, np.ndarray)}
    return replace(readings, **arrays)


def test_recording_that_agrees_with_the_scene_has_no_departure(real):
    assert find_departure([real], AXES) is None


def test_exchanged_chips_are_reported(real):
    order = np.arange(15).reshape(5, 3)[[0, 2, 1, 3, 4]].ravel()
    swapped = replace(real, b_uT=real.b_uT[:, order], noload_uT=real.noload_uT[:, order])
    assert find_departure([swapped], AXES) == "Contrary to layout reskin, chips 1 and 2 are exchanged."


def test_no_departure_is_reported_without_places_or_with_too_few_presses(real):
    unknown = np.full(len(real), np.nan, np.float32)
    few = select(real, real.indentation < 30)
    fewer_chips = replace(real, b_uT=real.b_uT[:, :12], noload_uT=real.noload_uT[:, :12])
    for cannot in (replace(real, x_mm=unknown), few):
        assert find_departure([cannot], AXES) is None
    with pytest.raises(ParamsError, match=r"4 chips were recorded, but compare\.layout has 5"):
        find_departure([fewer_chips], AXES)


def test_mirrored_labels_are_reported_although_forces_are_unknown(real):
    unknown = np.full(len(real), np.nan, np.float32)
    assert find_departure([replace(real, Fz_N=unknown)], AXES) is None
    mirrored = replace(real, Fz_N=unknown, y_mm=16 - real.y_mm)
    assert find_departure([mirrored], AXES) == "Contrary to layout reskin, the labels are mirrored along y."


# This is the layout of a square board with four chips, as it is written in the file of a scene.
SQUARE = read_yaml(FOLDER / "reskin.yaml") | {
    "name": "square",
    "centre_mm": [10.0, 12.0],
    "chips": [
        {"x_mm": x_mm, "y_mm": y_mm, "turn_deg": turn_deg}
        for (x_mm, y_mm), turn_deg in zip(product((-4.0, 5.0), repeat=2), (0, 90, 0, 270), strict=True)
    ],
}


def square_axes() -> BoardAxes:
    scene = {"compare": {"layout": SQUARE, "labels_mirrored": False}}
    return Settings("mine", "mine.yaml", scene, {}).section(Compare, "compare").axes


def square_recording(axes: BoardAxes) -> Readings:
    """Return simulated presses at 5 x 5 places of the square board. Their forces are unknown."""
    place_mm = np.stack(np.meshgrid(*[np.linspace(-6, 6, 5)] * 2), axis=-1).reshape(-1, 2)
    simulated_uT = simulate_uT(axes.nominal, axes.setup, place_mm, np.full(25, 2.0))
    db_uT = np.einsum("kij,nki->nkj", axes.rotations, simulated_uT).reshape(25, 12)
    label_mm = axes.label(place_mm).astype(np.float32)
    return readings(
        "c", "b", "s", 25, indentation=np.arange(25, dtype=np.int32), x_mm=label_mm[:, 0], y_mm=label_mm[:, 1],
        b_uT=db_uT.astype(np.float32), noload_uT=np.zeros((25, 12), np.float32),
        temperature_degC=np.full((25, 4), 25, np.float32), Fz_N=np.full(25, np.nan, np.float32),
    )  # fmt: skip


def test_departures_from_a_layout_name_the_layout_instead_of_the_scene():
    axes = square_axes()
    recording = square_recording(axes)
    assert find_departure([recording], axes) is None
    swapped = recording.b_uT.reshape(25, 4, 3)[:, [0, 3, 2, 1]].reshape(25, 12)
    sentence = find_departure([replace(recording, b_uT=swapped)], axes)
    assert sentence == "Contrary to layout square, chips 1 and 3 are exchanged."


def test_presses_outside_the_skin_are_reported_before_orientations_are_compared():
    axes = square_axes()
    recording = square_recording(axes)
    elsewhere = replace(recording, x_mm=recording.x_mm + 20, y_mm=recording.y_mm - 5)
    sentence = find_departure([elsewhere], axes)
    assert sentence == (
        "25 of 25 presses are outside the skin (20 x 20 mm) that layout square states: relative to centre_mm [10, 12], "
        "all presses have x from 14 to 26 mm and y from -11 to 1 mm. Correct centre_mm, the size of the skin or the "
        "places of the presses."
    )

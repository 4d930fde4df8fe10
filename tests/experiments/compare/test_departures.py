"""Tests of departures, which are differences between a capture and the scene's skin that suggest wrong labels."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from pipeline.experiments import compare
from pipeline.experiments.compare import (
    Compare,
    check_frames,
    chip_rotations,
    compare_boards,
    figures,
    find_departure,
    make_setup,
    pool_skins,
    tables,
    to_board_axes,
)
from pipeline.settings import Settings
from reskin.config import read_yaml
from reskin.errors import ParamsError
from reskin.recordings.readers import lab
from reskin.schema import Readings
from reskin.universal.law import nominal_uT
from reskin.universal.layout import FOLDER
from reskin.universal.presses import pool
from tests.data.tables import readings
from tests.experiments.compare.test_run import DESIGN, SECTION
from tests.recordings.test_recordings import ingest


@pytest.fixture(scope="module")
def real(shared_data, tmp_path_factory) -> Readings:
    """Return every third press of a recording of lab board 1, with five readings per press."""
    readings, _ = ingest(lab, shared_data / "lab/board1_depth2.csv", tmp_path_factory.mktemp("lab"))
    return select(readings, (readings.indentation % 3 == 0) & (readings.reading_i < 5))


def select(readings: Readings, rows: np.ndarray) -> Readings:
    arrays = {name: value[rows] for name, value in vars(readings).items() if isinstance(value, np.ndarray)}
    return replace(readings, **arrays)


def test_recording_that_agrees_with_the_scene_has_no_departure(real):
    assert find_departure([real], SECTION, DESIGN) is None


def test_exchanged_chips_are_reported(real):
    order = np.arange(15).reshape(5, 3)[[0, 2, 1, 3, 4]].ravel()
    swapped = replace(real, b_uT=real.b_uT[:, order], noload_uT=real.noload_uT[:, order])
    assert find_departure([swapped], SECTION, DESIGN) == "Contrary to the scene, chips 1 and 2 are exchanged."


def test_mirrored_labels_are_reported(real):
    mirrored = replace(real, y_mm=16 - real.y_mm)
    assert find_departure([mirrored], SECTION, DESIGN) == "Contrary to the scene, the labels are mirrored along y."


def test_no_departure_is_reported_without_places_or_with_too_few_presses(real):
    unknown = np.full(len(real), np.nan, np.float32)
    few = select(real, real.indentation < 30)
    fewer_chips = replace(real, b_uT=real.b_uT[:, :12], noload_uT=real.noload_uT[:, :12])
    for cannot in (replace(real, x_mm=unknown), few):
        assert find_departure([cannot], SECTION, DESIGN) is None
    with pytest.raises(ParamsError, match=r"4 chips were recorded, but compare\.design has 5"):
        find_departure([fewer_chips], SECTION, DESIGN)


def test_mirrored_labels_are_reported_although_forces_are_unknown(real):
    unknown = np.full(len(real), np.nan, np.float32)
    assert find_departure([replace(real, Fz_N=unknown)], SECTION, DESIGN) is None
    mirrored = replace(real, Fz_N=unknown, y_mm=16 - real.y_mm)
    assert find_departure([mirrored], SECTION, DESIGN) == "Contrary to the scene, the labels are mirrored along y."


# This is the layout of a square board with four chips, as it is written in the file of a scene.
SQUARE = read_yaml(FOLDER / "reskin.yaml") | {
    "name": "square",
    "centre_mm": [10.0, 12.0],
    "chips": [
        {"x_mm": x_mm, "y_mm": y_mm, "turn_deg": turn_deg}
        for (x_mm, y_mm), turn_deg in zip(product((-4.0, 5.0), repeat=2), (0, 90, 0, 270), strict=True)
    ],
}


def square_section(**changes: object) -> Compare:
    scene = {"compare": {"layout": SQUARE, "labels_mirrored": False, "memory": 0.065} | changes}
    return Settings("mine", "mine.yaml", scene, {}).section(Compare, "compare")


def square_recording(section: Compare) -> Readings:
    """Return simulated presses at 5 x 5 places of the square board. Their forces are unknown."""
    setup, turns = make_setup(section, DESIGN), chip_rotations(section)
    place_mm = np.stack(np.meshgrid(*[np.linspace(-6, 6, 5)] * 2), axis=-1).reshape(-1, 2)
    db_uT = np.einsum("kij,nki->nkj", turns, nominal_uT(setup, place_mm, np.full(25, 2.0))).reshape(25, 12)
    label_mm = (place_mm + section.labels_middle_mm).astype(np.float32)
    return readings(
        "c", "b", "s", 25, indentation=np.arange(25, dtype=np.int32), x_mm=label_mm[:, 0], y_mm=label_mm[:, 1],
        b_uT=db_uT.astype(np.float32), noload_uT=np.zeros((25, 12), np.float32),
        temperature_degC=np.full((25, 4), 25, np.float32), Fz_N=np.full(25, np.nan, np.float32),
    )  # fmt: skip


def test_departures_from_a_layout_name_the_layout_instead_of_the_scene():
    section = square_section()
    recording = square_recording(section)
    assert find_departure([recording], section, DESIGN) is None
    swapped = recording.b_uT.reshape(25, 4, 3)[:, [0, 3, 2, 1]].reshape(25, 12)
    sentence = find_departure([replace(recording, b_uT=swapped)], section, DESIGN)
    assert sentence == "Contrary to layout square, chips 1 and 3 are exchanged."


def test_presses_outside_the_skin_are_reported_before_orientations_are_compared():
    section = square_section()
    recording = square_recording(section)
    elsewhere = replace(recording, x_mm=recording.x_mm + 20, y_mm=recording.y_mm - 5)
    sentence = find_departure([elsewhere], section, DESIGN)
    assert sentence == (
        "25 of 25 presses are outside the skin (20 x 20 mm) that layout square states: relative to centre_mm [10, 12], "
        "all presses have x from 14 to 26 mm and y from -11 to 1 mm. Correct centre_mm, the size of the skin or the "
        "places of the presses."
    )
    aligned = to_board_axes(pool([elsewhere], with_force=False), section)
    assert check_frames(aligned, make_setup(section, DESIGN), section)["sentence"] == sentence


def test_boards_without_known_forces_have_only_the_table_of_axes(monkeypatch):
    monkeypatch.setattr(compare, "FITTED_MAX_N", 22)
    section = square_section()
    boards = pool_skins([square_recording(section)], with_force=False)
    numbers, plot_data = compare_boards(boards, section, DESIGN, 0)
    assert (
        numbers["by_board"]["b"]["frames"]["sentence"] == "Labels, chips and skin are oriented as layout square states."
    )
    assert (numbers["by_board"]["b"]["pokes_n"], numbers["by_board"]["b"]["fitted_n"]) == (25, 22)
    assert set(tables(numbers, "recorded")) == {"compare_frames"}
    assert figures(numbers, plot_data, "recorded") == {}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"layout": "my_board.yaml"},
            "my_board.yaml is the name of a file, .* Replace the name by the content",
        ),
        ({"layout": "reskim"}, "reskim: this is neither a YAML file.*Did you mean reskin"),
        ({"skin_mm": [20.0, 20.0]}, "skin_mm cannot be set together with layout"),
        ({"layout": SQUARE | {"gap": 1.0}}, "compare.layout: gap is not a known parameter"),
    ],
)
def test_layout_that_a_scene_states_wrongly_is_refused(changes, message):
    with pytest.raises(ParamsError, match=message):
        square_section(**changes)

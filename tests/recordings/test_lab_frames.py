"""Tests of the chip rotations that are stated in the scenes.

Recorded field changes are compared with simulated ones, without any fit. The axes of the labels and of the board have
the same x axis and opposite y axes.
"""

from pathlib import Path

import numpy as np
import pytest
from scipy.constants import micro, milli
from scipy.linalg import orthogonal_procrustes
from scipy.spatial.transform import Rotation

from reskin.config import parse
from reskin.layouts import PAPER, geometry
from reskin.physics.board import BoardDesign, Spreads, draw_board
from reskin.physics.skin import SkinDesign, changes_of_field, draw_skin
from reskin.recordings.readers import lab
from reskin.schema import Readings
from reskin.simulation.defaults import nominal
from tests.physics.test_board import SPREADS
from tests.recordings.test_recordings import LAB, ingest

ROOT = Path(__file__).resolve().parents[2]
# The recordings do not state the depth. The directions of field changes are the same at 0.6 and at 1 mm.
DEPTH_M = 0.8e-3
LABEL_TO_BOARD = np.diag([1.0, -1.0])  # Converts places from the axes of the labels to those of the board.
MIDDLE_MM = 8.0


@pytest.fixture(scope="module")
def design() -> BoardDesign:
    return parse(BoardDesign, geometry(PAPER)["design"], "test")


@pytest.fixture(scope="module")
def recorded_uT(shared_data, tmp_path_factory) -> np.ndarray:
    """Return recorded field changes [file, place, chip, axis], along the axes of the chips.

    The places are those of `simulated_uT`.
    """
    return np.stack([_change_uT(_readings(name, shared_data, tmp_path_factory)) for name in LAB])


@pytest.fixture(scope="module")
def simulated_uT(design, shared_data, tmp_path_factory) -> np.ndarray:
    """Return simulated field changes [place, chip, axis], along the axes of the board."""
    readings = _readings(LAB[0], shared_data, tmp_path_factory)
    labels_mm = np.column_stack([readings.x_mm, readings.y_mm])[::100] - MIDDLE_MM
    pokes_m = np.column_stack([labels_mm @ LABEL_TO_BOARD * milli, np.full(65, DEPTH_M)])
    no_spread = Spreads(**(dict.fromkeys(SPREADS, 0.0) | {"skin_filler_length_mm": 3.0}))
    # The setting `hold` is not used, because it was fitted to these recordings.
    values = nominal("skin") | {"hold": None}
    skin = draw_skin(parse(SkinDesign, values, "test"), no_spread, seed=0, name="nominal")
    _, changes_T = changes_of_field(draw_board(design, no_spread, seed=0, name="nominal"), skin, pokes_m)
    return changes_T / micro


def _readings(name: str, shared_data: Path, folders: pytest.TempPathFactory) -> Readings:
    return ingest(lab, shared_data / "lab" / f"{name}.csv", folders.mktemp(name))[0]


def _change_uT(readings: Readings) -> np.ndarray:
    return (readings.b_uT - readings.noload_uT).reshape(65, 100, 5, 3).mean(axis=1)


def test_chip_rotations_fitted_to_recordings_equal_those_of_the_scenes(recorded_uT, simulated_uT, design):
    # Rotations are fitted to all files together. If they were fitted to a single file, a rotation would be wrong by up
    # to 40 degrees, or would even be mirrored.
    for chip_i, turn_deg in enumerate(design.chips_turn_deg):
        read_uT = recorded_uT[:, :, chip_i].reshape(-1, 3)
        found, _ = orthogonal_procrustes(read_uT, np.tile(simulated_uT[:, chip_i], (len(LAB), 1)))
        turn = Rotation.from_euler("z", turn_deg, degrees=True).as_matrix()
        assert np.linalg.det(found) > 0, f"chip {chip_i} is mirrored"
        # If a chip had a wrong rotation by a quarter turn, the difference would be 1. Smaller differences are due to
        # the positions of skins on their boards, and to skins that slide.
        assert np.abs(found.T - turn).max() < 0.35, f"chip {chip_i}"


def test_field_changes_of_the_nominal_skin_have_the_recorded_directions(recorded_uT, simulated_uT, design):
    turn = Rotation.from_euler("z", np.array(design.chips_turn_deg)[:, None], degrees=True).as_matrix()
    seen_uT = np.einsum("kij,dnkj->dnki", turn, recorded_uT)
    along = (seen_uT * simulated_uT).sum(axis=(2, 3))
    cosine = along / np.linalg.norm(seen_uT, axis=(2, 3)) / np.linalg.norm(simulated_uT, axis=(1, 2))
    # Measured cosines are 0.69 to 0.83. If two chips were exchanged, they would be at most 0.59.
    assert (cosine.mean(axis=1) > 0.65).all()

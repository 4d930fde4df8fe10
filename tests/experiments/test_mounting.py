"""Tests of experiment mounting, in which skins are turned, chips are exchanged or the axes of labels are wrong."""

import numpy as np
import pytest

from pipeline.experiments.mounting import (
    AS_RECORDED,
    SWAPPED,
    TURNED,
    WITH_CHECK,
    WITHOUT_CHECK,
    Mounting,
    accuracy_rows,
    label_rows,
    orientations,
    simulated_skins,
    summarise_accuracy,
    tables,
)
from pipeline.experiments.random_presses import BoardPresses
from reskin.seeds import rng_for
from reskin.universal.calibration import LabelledPresses
from reskin.universal.law import simulate_uT, to_board
from reskin.universal.map import NOMINAL
from reskin.universal.population import grid
from tests.universal.skins import SETUP

SECTION = Mounting(skins_n=3, labels_n=(4,), draws_n=1)
SKINS = simulated_skins(SETUP, SECTION.skins_n, 5, "mounting")


@pytest.fixture(scope="module")
def board() -> BoardPresses:
    """Return presses on the nominal skin: two forces at each place of the grid, with one reading per press."""
    place_mm = np.repeat(grid(), 2, axis=0)
    force_N = np.tile([1.0, 3.0], len(grid())) * rng_for(0, "mounting").uniform(0.9, 1.1, len(place_mm))
    presses = LabelledPresses(place_mm, force_N, simulate_uT(NOMINAL, SETUP, place_mm, force_N).reshape(-1, 15))
    rest_uT = to_board(SKINS[0].rest_uT[None])[0]
    return BoardPresses("b1", rest_uT, presses, presses, np.arange(len(place_mm)))


def test_turning_negates_the_no_load_field_and_swapping_exchanges_two_chips():
    skin = SKINS[0]
    np.testing.assert_array_equal(skin.changed(AS_RECORDED).db_uT, skin.db_uT)
    np.testing.assert_array_equal(skin.changed(TURNED).rest_uT, -skin.rest_uT)
    chips_uT, swapped_uT = (one.db_uT.reshape(-1, 5, 3) for one in (skin, skin.changed(SWAPPED)))
    np.testing.assert_array_equal(swapped_uT[:, [0, 2, 1, 3, 4]], chips_uT)
    np.testing.assert_array_equal(skin.changed(SWAPPED).changed(SWAPPED).db_uT, skin.db_uT)


def test_turned_skins_are_recognised():
    as_recorded, turned = (
        orientations([skin.changed(change) for skin in SKINS], 0) for change in (AS_RECORDED, TURNED)
    )
    assert (as_recorded["turned_pct"], turned["turned_pct"]) == (0, 100)
    assert as_recorded["log_odds_min"] == pytest.approx(turned["log_odds_min"])
    assert as_recorded["skins_n"] == 3


def test_labels_with_wrong_axes_raise_a_warning():
    rows = label_rows("simulated", SKINS, SECTION, 0, draws_n=2)
    warned = {row["axes"]: row["warned_pct"] for row in rows}
    assert len(warned) == 8
    assert {row["trials_n"] for row in rows} == {6}
    assert warned.pop("as given") == 0
    assert np.mean([*warned.values()]) > 60  # Most trials raise a warning. By chance alone, few would.


def test_accuracy_on_a_turned_skin_is_kept_only_if_the_orientation_is_checked(board):
    rows = accuracy_rows(board, SECTION, 0)
    scores = {(row["change"], row["check"]): row["accuracy_pct"] for row in rows if not row["labels_n"]}
    assert scores[TURNED, WITH_CHECK] == scores[AS_RECORDED, WITH_CHECK] == scores[AS_RECORDED, WITHOUT_CHECK]
    assert scores[TURNED, WITHOUT_CHECK] < scores[TURNED, WITH_CHECK] - 20
    numbers = {
        "orientation": [{"source": "simulated", "change": TURNED} | orientations(SKINS, 0)],
        "labels": label_rows("simulated", SKINS[:1], SECTION, 0, 1),
        "accuracy": summarise_accuracy(rows), "draws_n": 1,
    }  # fmt: skip
    shown = tables(numbers, "recorded")
    assert list(shown) == ["mounting", "mounting_labels", "mounting_accuracy"]
    assert shown["mounting"].iloc[0]["skins"] == "3 simulated"
    # One row for each mounting, with and without the check, and for each number of labels.
    assert len(shown["mounting_accuracy"]) == 2 * 2 * 2

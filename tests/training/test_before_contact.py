"""Tests of predicting places from readings before contact.

Such predictions can succeed only if the order of a scan, the memory of earlier presses, or a magnetic tip reveals the
place.
"""

from pathlib import Path

import numpy as np

from pipeline.settings import Settings
from pipeline.training.before_contact import gather_hover, gather_scan, score_before_contact
from pipeline.training.jobs import SceneData
from reskin import io
from reskin.data.rows import Selection, gather
from reskin.data.splits import Split, draw_folds
from reskin.schema import Readings
from reskin.seeds import rng_for
from tests.data.tables import readings

ALL = Selection(force_min_N=0.0)
PASSES_N, PLACES_N = 4, 64
SCENE = {"seed": 0, "selection": {"force_min_N": 0.0}}
# A random guess is right in 1 of 64 cases. Predictions between neighbouring places are right a little more often.
CHANCE_MAX_PCT = 15.0


def score_scan(folder: Path, *, snake: bool, memory: float) -> dict[str, float]:
    """Return scores of predictions for a scan of a grid in four passes.

    A fraction `memory` of each field change remains in the following no-load reading.
    """
    rng = rng_for(0, "scan")
    order = [np.arange(PLACES_N) if snake else rng.permutation(PLACES_N) for _ in range(PASSES_N)]
    place_i = np.concatenate(order)
    x_mm, y_mm = (2 * (place_i // 8)).astype(np.float32), (2 * (place_i % 8)).astype(np.float32)
    db_uT = np.stack([x_mm, y_mm, x_mm * y_mm], axis=1) * np.float32(10)
    noise_uT = 0.01 * rng.standard_normal(db_uT.shape)
    noload_uT = (100 + memory * np.roll(db_uT, 1, axis=0) + noise_uT).astype(np.float32)
    one = readings(
        f=len(place_i), x_mm=x_mm, y_mm=y_mm, noload_uT=noload_uT, b_uT=noload_uT + db_uT,
        pass_i=np.repeat(np.arange(PASSES_N, dtype=np.int32), PLACES_N),
    )  # fmt: skip
    io.write_readings(folder / "c0.parquet", [one], {})
    rows = gather([one], Selection(force_min_N=0.0))
    folds = draw_folds(rows, ["single_temporal"], Split(temporal_test_fraction=0.25), 0)
    scored = score_before_contact(
        SceneData("test", Settings("test", "test.yaml", SCENE, {}), rows, folds), folder, ["c0"], {}
    )
    return {row["method"]: row["accuracy_pct"] for row in scored}


def test_field_memory_of_the_previous_press_reveals_the_place_in_a_snake_scan(tmp_path):
    found = score_scan(tmp_path, snake=True, memory=0.1)
    assert found["scan"] == 100.0
    assert found["noload"] > 95.0


def test_number_of_an_indentation_reveals_its_place_in_a_snake_scan(tmp_path):
    found = score_scan(tmp_path, snake=True, memory=0.0)
    assert found["scan"] == 100.0
    assert found["noload"] < CHANCE_MAX_PCT


def score_hovering(folder: Path, *, magnetic: bool) -> dict[str, dict[str, float]]:
    """Return scores of predictions from readings while the tip hovers.

    Only a magnetic tip changes these readings.
    """
    # There are two readings per place: above the place, then in contact.
    place_i = np.tile(np.arange(PLACES_N), PASSES_N).repeat(2)
    touches = np.tile([False, True], PASSES_N * PLACES_N)
    place_mm = np.column_stack([2 * (place_i // 8), 2 * (place_i % 8)]).astype(np.float32)
    rng = rng_for(0, "hover")
    db_uT = np.column_stack([place_mm, place_mm[:, :1] * place_mm[:, 1:]]) * np.float32(10)
    db_uT = (db_uT * (touches | magnetic)[:, None] + rng.standard_normal(db_uT.shape)).astype(np.float32)
    corner = np.arange(len(place_i)) % (2 * PLACES_N) == 0  # The first reading of each pass is beside the skin.
    one = readings(
        f=len(place_i), x_mm=np.where(touches, place_mm[:, 0], np.nan).astype(np.float32),
        y_mm=np.where(touches, place_mm[:, 1], np.nan).astype(np.float32),
        Fz_N=touches.astype(np.float32), noload_uT=np.zeros_like(db_uT), b_uT=db_uT,
        pass_i=np.repeat(np.arange(PASSES_N, dtype=np.int32), 2 * PLACES_N),
    )  # fmt: skip
    hover = gather_hover([one])
    assert len(hover) == (~touches & ~corner).sum()
    # The label of a reading above the skin is the place that is touched next.
    np.testing.assert_array_equal(hover.place_mm, place_mm[~touches & ~corner])
    io.write_readings(folder / "c0.parquet", [one], {})
    rows = gather([one], Selection(force_min_N=0.1))
    folds = draw_folds(rows, ["single_temporal"], Split(temporal_test_fraction=0.25), 0)
    data = SceneData("test", Settings("test", "test.yaml", SCENE, {}), rows, folds)
    scored = score_before_contact(data, folder, ["c0"], {"s0": [lambda db_uT: np.zeros((len(db_uT), 3), np.float32)]})
    return {row["method"]: row for row in scored}


def test_hovering_tip_is_located_only_if_it_is_magnetic(tmp_path):
    found = score_hovering(tmp_path, magnetic=True)
    assert found["hover"]["accuracy_pct"] > 95
    assert found["hover"]["hover_uT"] > 0.9 * found["hover"]["touch_uT"]
    # The network predicts the same corner for all readings.
    assert found["hover_network"]["accuracy_pct"] < CHANCE_MAX_PCT
    found = score_hovering(tmp_path, magnetic=False)
    assert found["hover"]["accuracy_pct"] < CHANCE_MAX_PCT
    assert found["hover"]["hover_uT"] < 0.1 * found["hover"]["touch_uT"]


def test_indentations_keep_their_numbers_if_rows_without_a_place_are_excluded():
    lost = np.array([0, np.nan, 2, 3, np.nan, 5], np.float32)
    one = readings(x_mm=lost, noload_uT=np.arange(18, dtype=np.float32).reshape(6, 3))
    scan = gather_scan([one], ALL)
    assert scan.scan_i.tolist() == [0, 2, 0, 2]
    assert scan.noload_uT[:, 0].tolist() == [0, 6, 9, 15]


def test_readings_before_contact_are_in_the_order_of_the_training_rows():
    def made(name: str, first: float) -> Readings:
        x_mm = first + np.arange(6, dtype=np.float32)
        return readings(name, x_mm=x_mm, noload_uT=np.tile(x_mm[:, None], 3))

    captures = [made("c1", 10.0), made("c0", 0.0)]
    assert gather_scan(captures, ALL).noload_uT[:, 0].tolist() == gather(captures, ALL).target[:, 0].tolist()

"""Tests of experiment recorded_limits, which examines what limits the accuracy on recorded boards.

The tests check the rigid registration of places, estimates of shear force, thresholds of detection, and tables.
"""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from sklearn.metrics import r2_score

from pipeline.experiments import recorded_limits as limits
from pipeline.experiments.compare import Compare, chip_rotations
from pipeline.experiments.random_presses import BoardPresses
from pipeline.experiments.recorded_limits import Predictions, RecordedLimits, Recording
from pipeline.settings import read_settings
from pipeline.stages.ingest import ingest
from pipeline.training.universal_variants import Frame, Variant, Variants
from reskin import io
from reskin.data.rows import Rows, Selection, load_rows
from reskin.data.splits import render_folds
from reskin.errors import SchemaError
from reskin.logs import estimate_after
from reskin.models.classical import Ridge
from reskin.recordings.header import HEADER_FILE, render
from reskin.recordings.readers.lab import READINGS
from reskin.seeds import rng_for
from reskin.universal.batches import SkinPrior
from reskin.universal.calibration import LabelledPresses
from reskin.universal.map import NOMINAL, NOMINAL_SPREADS, new_map
from reskin.universal.model import PriorModel
from reskin.universal.network import draw_weights
from reskin.universal.population import grid
from tests.recordings.headers import make_header
from tests.universal.skins import ROOT, SETUP, make_tables, poked_uT

SECTION = RecordedLimits(
    known_n=5, presses_n=20, draws_n=2, methods={"ridge": Ridge(method="ridge", inputs="raw", alpha=1e-3)},
    folds_n=5, false_alarm_fraction=0.01, detected_fraction=0.95,
)  # fmt: skip
EXPONENT = 0.3


def rotation(angle_deg: float) -> np.ndarray:
    cos, sin = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    return np.array([[cos, -sin], [sin, cos]])


def make_board() -> BoardPresses:
    """Return presses on a synthetic board: three forces at each place of the grid, with two readings per press."""
    place_mm = np.repeat(grid(), 3, axis=0)
    force_N = np.tile([0.8, 2.0, 5.0], len(grid()))
    presses = LabelledPresses(place_mm, force_N, poked_uT(place_mm, force_N, np.array([0.5, -0.5, 0.3])))
    press_i = np.repeat(np.arange(len(place_mm)), 2)
    return BoardPresses("b1", np.zeros(15), presses, presses[press_i], press_i)


# --- Rigid registration: places are corrected by a shift and a rotation that are fitted to known presses. ---


@given(st.floats(-179, 179), st.floats(-5, 5), st.floats(-5, 5), st.integers(0, 99))
def test_fitted_rigid_motion_recovers_shift_and_rotation_and_is_never_a_reflection(angle_deg, x_mm, y_mm, seed):
    rng = np.random.default_rng(seed)
    from_mm = rng.uniform(-8, 8, (5, 2))
    to_mm = from_mm @ rotation(angle_deg).T + [x_mm, y_mm]
    motion = limits.fit_rigid(from_mm, to_mm)
    np.testing.assert_allclose(motion.apply(from_mm), to_mm, atol=1e-9)
    np.testing.assert_allclose(motion.shift_mm, [x_mm, y_mm], atol=1e-9)
    assert motion.angle_deg == pytest.approx(angle_deg, abs=1e-6)
    mirrored = limits.fit_rigid(from_mm, to_mm * [1, -1])
    assert np.linalg.det(mirrored.rotation) == pytest.approx(1)


def test_fitted_rotation_has_the_smallest_sum_of_squared_distances():
    rng = np.random.default_rng(0)
    from_mm, to_mm = rng.uniform(-8, 8, (2, 5, 2))

    def error_mm2(turned: np.ndarray) -> float:
        # For any rotation, the best shift makes the means equal.
        moved = turned - turned.mean(axis=0) + to_mm.mean(axis=0)
        return float(((moved - to_mm) ** 2).sum())

    searched = min(error_mm2(from_mm @ rotation(angle_deg).T) for angle_deg in np.arange(0, 360, 0.1))
    fitted = float(((limits.fit_rigid(from_mm, to_mm).apply(from_mm) - to_mm) ** 2).sum())
    assert fitted <= searched
    # The tolerance allows for the steps of 0.1 degrees between the angles that are tried.
    assert fitted == pytest.approx(searched, rel=1e-4)


def test_fitted_shift_is_the_mean_difference():
    motion = limits.fit_shift(np.array([[0.0, 0.0], [2.0, 1.0]]), np.array([[1.0, 0.0], [2.0, 3.0]]))
    np.testing.assert_allclose(motion.apply(np.array([[5.0, 5.0]])), [[5.5, 6.0]])
    assert motion.angle_deg == 0


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 99))
def test_tested_readings_exclude_known_places_and_unlabelled_presses(draw_i):
    board = make_board()
    draw = limits.draw_presses(board, SECTION, 2021, draw_i)
    tested = np.unique(board.press_i[draw.tested])
    known_mm = board.presses.place_mm[draw.known]
    distance_mm = np.linalg.norm(known_mm[:, None] - board.presses.place_mm[tested], axis=2)
    assert distance_mm.min() >= 2 - 1e-9  # Places of the grid are 2 mm apart.
    assert not set(tested) & set(draw.unlabelled)
    between_mm = np.linalg.norm(known_mm[:, None] - known_mm, axis=2)[np.triu_indices(5, 1)]
    # The known places are chosen far from each other. Five random places would often be neighbours, 2 mm apart.
    assert between_mm.min() >= 4


def test_board_with_too_few_places_is_refused():
    board = make_board()
    with pytest.raises(SchemaError, match="195 presses at 65 places"):
        limits.draw_presses(board, SECTION.model_copy(update={"known_n": 65}), 2021, 0)


def make_variant() -> Variant:
    """Return a variant of the model. It has the map of the synthetic skin, and a network that is not trained."""
    model = PriorModel(new_map(make_tables()), [draw_weights(15, rng_for(0, "recorded limits"))])
    return Variant(SkinPrior("nominal", NOMINAL, NOMINAL_SPREADS, SETUP), model)


@pytest.fixture(scope="module")
def scores() -> list[dict]:
    """Return scores of several methods on the synthetic board.

    The methods are a regressor whose places are wrong by a rigid motion, and two variants of a model that is not
    trained.
    """
    board = make_board()
    variant = make_variant()
    moved_mm = board.readings.place_mm @ rotation(10).T + [2, -1]
    regressors = [Predictions("moved", [moved_mm, moved_mm])]
    variants = Variants(variant, {"b1": variant})
    return [row for i in range(2) for row in limits.score_draw(board, regressors, variants, SECTION, 2021, i)]


def test_registration_removes_an_error_that_is_a_rigid_motion(scores):
    before, after = (
        [row for row in scores if row["method"] == "moved" and row["known"] == known]
        for known in (limits.UNCHANGED, limits.RIGID)
    )
    assert len(before) == len(after) == 4  # There are two draws with two models each.
    for row in before:
        assert row["accuracy_pct"] < 50
        assert row["rigid_limit_mm2"] == pytest.approx(0, abs=1e-12)
    for row in after:
        assert row["mse_xy_mm2"] == pytest.approx(0, abs=1e-12)
        assert row["angle_deg"] == pytest.approx(10)
        assert row["shift_mm"] == pytest.approx(np.sqrt(5))


def test_no_registration_has_a_smaller_error_than_one_fitted_to_the_tested_readings(scores):
    """A rigid motion that is fitted to the tested readings themselves gives a lower bound for the squared error."""
    for row in scores:
        if row["known"] in (limits.SHIFT, limits.RIGID):
            keys = {name: row[name] for name in ("method", "presses_n", "draw_i")} | {"known": limits.UNCHANGED}
            bound = next(other for other in scores if all(other[name] == value for name, value in keys.items()))
            assert bound["rigid_limit_mm2"] <= row["mse_xy_mm2"] + 1e-12


def test_universal_model_has_scores_for_each_way_of_using_the_known_presses(scores):
    uses = {limits.UNCHANGED, limits.SHIFT, limits.RIGID, limits.LABELS}
    for presses_n in (0, 20):
        for method in ("universal, boards of the rig", "universal, simulated alone"):
            found = {row["known"] for row in scores if row["method"] == method and row["presses_n"] == presses_n}
            assert found == uses

    def mean_mm2(known: str) -> float:
        return float(np.mean([row["mse_xy_mm2"] for row in scores if row["known"] == known and row["presses_n"]]))

    # Labels reduce the errors, because the fields of the synthetic skin follow the formula of the map.
    assert mean_mm2(limits.LABELS) < mean_mm2(limits.UNCHANGED)


# --- Shear forces ---


@given(arrays(float, (12, 2), elements=st.floats(-100, 100)), st.lists(st.integers(0, 3), min_size=8, max_size=8))
def test_mean_by_equals_the_mean_of_the_rows_of_each_group(values, numbers):
    group = np.array([0, 1, 2, 3, *numbers])
    expected = [values[group == i].mean(axis=0) for i in range(4)]
    np.testing.assert_allclose(limits.mean_by(group, values), expected, atol=1e-9)


def test_explained_fraction_within_groups_equals_r2_of_centred_values():
    rng = np.random.default_rng(1)
    true, predicted = rng.standard_normal((2, 30))
    group = np.repeat([0, 1, 2], 10)
    assert limits.explained(true, predicted, 0 * group) == pytest.approx(r2_score(true, predicted))
    shifted = predicted + np.array([5.0, -3.0, 1.0])[group]
    within = limits.explained(true, predicted, group)
    # Adding a constant to all predictions of a group has no effect, because values are centred by group.
    assert limits.explained(true, shifted, group) == pytest.approx(within)
    centred = [values - np.repeat(values.reshape(3, 10).mean(axis=1), 10) for values in (true, predicted)]
    assert within == pytest.approx(r2_score(*centred))


def make_rows(shear_in_field: bool) -> Rows:
    """Return rows of two boards with 30 places, two depths, two readings per press and 6 channels.

    The field is linear in the place and in the normal force. If `shear_in_field` is true, the field is also linear in
    the sideways force, which is random.
    """
    rng = np.random.default_rng(2)
    place_mm = 2.0 * np.stack(np.meshgrid(np.arange(6), np.arange(5)), axis=-1).reshape(-1, 2)
    presses_n = 2 * 2 * len(place_mm)
    target = np.column_stack([np.tile(place_mm, (4, 1)), rng.standard_normal((presses_n, 2)), np.zeros(presses_n)])
    target[:, 4] = np.tile(np.repeat([2.0, 4.0], len(place_mm)), 2) + rng.uniform(0, 0.5, presses_n)
    gain = rng.standard_normal((5, 6)) * 50
    gain[2:4] *= shear_in_field
    capture = np.repeat([f"c{i}" for i in range(4)], len(place_mm))
    readings = np.repeat(np.arange(presses_n), 2)
    db_uT = (target @ gain)[readings] + rng.standard_normal((len(readings), 6))
    board = np.array(["b1", "b2"])[readings // (2 * len(place_mm))]
    zeros = np.zeros(len(readings), np.int32)
    return Rows(
        capture[readings], board, board, db_uT.astype(np.float32), target[readings].astype(np.float32), zeros,
        readings, {},
    )  # fmt: skip


def test_shear_is_predicted_only_if_the_field_depends_on_shear():
    by_field = {}
    for shear_in_field in (True, False):
        rows = limits.evaluate_shear(make_rows(shear_in_field), SECTION, 2021)["rows"]
        # There are two kinds of training presses. For each of them, the shear force is predicted from no input, from
        # the field, and from the place with the normal force.
        assert len(rows) == 2 * 3
        for row in rows:
            if row["inputs"] == limits.FIELD:
                by_field[shear_in_field, row["trained_on"]] = row
    for trained_on in (limits.OTHER_BOARD, limits.OTHER_PLACES):
        known, unknown = by_field[True, trained_on], by_field[False, trained_on]
        for name in ("r2_Fx", "r2_within_Fy"):
            assert known[name]["mean"] > 0.95
            assert unknown[name]["mean"] < 0.1
        assert unknown["r2_Fz"]["mean"] > 0.95


def test_table_of_forces_describes_each_recording():
    rows = make_rows(True)
    line = next(line for line in limits.evaluate_shear(rows, SECTION, 2021)["forces"] if line["recording"] == "c1")
    # Both readings of a press have the same force, so one of them is enough.
    own = rows.target[rows.capture == "c1"][::2].astype(float)
    assert line["presses_n"] == len(own)
    assert line["Fx"]["mean_N"] == pytest.approx(own[:, 2].mean())
    assert line["Fy"]["sd_N"] == pytest.approx(own[:, 3].std())
    assert line["Fz"]["sd_in_press_N"] == pytest.approx(0, abs=1e-6)
    assert line["ratio_max"] == pytest.approx((np.hypot(own[:, 2], own[:, 3]) / own[:, 4]).max())


def test_presses_without_a_known_shear_force_are_refused():
    rows = make_rows(True)
    target = rows.target.copy()
    target[0, 2] = np.nan
    with pytest.raises(SchemaError, match="without Fx, Fy or Fz"):
        limits.evaluate_shear(replace(rows, target=target), SECTION, 2021)


def test_presses_at_one_place_are_in_the_same_fold():
    presses = limits.force_presses(make_rows(True))
    own = np.flatnonzero(presses.board == "b2")
    folds = limits.split_places(presses, own, 4, 2021)
    assert sorted(np.concatenate([test for _, test in folds])) == sorted(own)
    for train, test in folds:
        places = [{tuple(place) for place in presses.place_mm[part]} for part in (train, test)]
        assert not places[0] & places[1]


# --- Detection of contacts ---


@settings(deadline=None)
@given(st.integers(0, 99), st.floats(5, 60))
def test_reading_exceeds_the_threshold_if_the_needed_field_change_is_exceeded(seed, threshold_uT):
    rng = np.random.default_rng(seed)
    direction = rng.standard_normal((4, 15))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    noise_uT = 5 * rng.standard_normal((20, 15))
    needed_uT = limits.needed_changes_uT(direction, noise_uT, threshold_uT)
    for above_uT in (0.01, 1.0, 30.0):
        readings_uT = direction[:, None] * (needed_uT + above_uT)[..., None] + noise_uT
        assert (np.linalg.norm(readings_uT, axis=2) > threshold_uT).all()
    just_below = direction[:, None] * (needed_uT - 0.01)[..., None] + noise_uT
    assert (np.linalg.norm(just_below, axis=2)[needed_uT > 0] <= threshold_uT).all()


def test_needed_field_change_equals_the_threshold_if_there_is_no_noise():
    needed_uT = limits.needed_changes_uT(np.eye(15)[:2], np.zeros((1, 15)), 24.0)
    np.testing.assert_allclose(needed_uT, 24.0)


@given(st.floats(0.1, 2), st.lists(st.floats(50, 2000), min_size=3, max_size=3))
def test_fitted_power_law_recovers_exponent_and_forces(exponent, factors_uT):
    place_i, force_N = np.repeat([0, 1, 2], 3), np.array([0.6, 1, 3, 0.9, 2, 4, 1.5, 2.5, 8])
    change_uT = np.array(factors_uT)[place_i] * force_N**exponent
    law = limits.fit_power_law(place_i, force_N, change_uT)
    assert law.exponent == pytest.approx(exponent)
    np.testing.assert_allclose(law.factor_uT, factors_uT)
    assert law.r2 == pytest.approx(1)
    np.testing.assert_allclose(law.force_N(change_uT[:, None], place_i)[:, 0], force_N)


def test_power_law_cannot_be_fitted_if_all_forces_at_a_place_are_equal():
    with pytest.raises(SchemaError, match="no place has presses with different forces"):
        limits.fit_power_law(np.array([0, 0, 1]), np.array([1.0, 1, 2]), np.array([100.0, 110, 300]))


@given(st.lists(st.tuples(st.integers(1, 40), st.booleans()), min_size=1, max_size=30), st.sampled_from([0.5, 0.95]))
def test_smallest_detected_force_equals_the_result_of_a_search_over_all_forces(readings, fraction):
    force_N, detected = np.array([n / 4 for n, _ in readings]), np.array([found for _, found in readings])

    def enough(least_N: float) -> bool:
        return detected[(force_N >= least_N) & (force_N < 2 * least_N)].mean() >= fraction

    candidates = [least_N for least_N in force_N if all(enough(other) for other in force_N[force_N >= least_N])]
    found_N = limits.smallest_force_N(force_N, detected, fraction)
    assert found_N == min(candidates) if candidates else np.isnan(found_N)


def make_recording(board: str = "b1", *, drift_uT: float = 3.0, seed: int = 3) -> Recording:
    """Return 40 presses at 20 places with |dB| = 300 F^0.3 in uT.

    Each press has ten no-load readings, and the no-load field drifts linearly.
    """
    rng = np.random.default_rng(seed)
    presses_n = 40
    direction = rng.standard_normal((20, 15))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    force_N = np.repeat([0.7, 3.0], 20) * rng.uniform(0.9, 1.1, presses_n)
    rest_uT = 1000 + drift_uT * np.arange(presses_n)[:, None] * np.eye(15)[0]
    noload_i, press_i = np.repeat(np.arange(presses_n), 10), np.repeat(np.arange(presses_n), 4)
    change_uT = 300 * force_N[:, None] ** EXPONENT * np.tile(direction, (2, 1))
    place_mm = 2.0 * np.stack(np.meshgrid(np.arange(5), np.arange(4)), axis=-1).reshape(-1, 2)
    return Recording(
        board, noload_i, rest_uT[noload_i] + 4 * rng.standard_normal((len(noload_i), 15)), press_i,
        (rest_uT + change_uT)[press_i] + 4 * rng.standard_normal((len(press_i), 15)),
        np.tile(place_mm, (2, 1))[press_i], force_N[press_i],
    )  # fmt: skip


def test_each_baseline_subtracts_its_own_no_load_readings():
    recording = make_recording()
    noload_uT = recording.noload_uT.reshape(40, 10, 15)
    each = limits.changes(recording, limits.EACH)
    expected = noload_uT[1, 3] - np.delete(noload_uT[1], 3, axis=0).mean(axis=0)
    np.testing.assert_allclose(each.setting[3], expected, atol=1e-9)  # The readings of press 1 come first.
    np.testing.assert_allclose(each.contact[4], recording.b_uT[4] - noload_uT[1].mean(axis=0), atol=1e-9)
    previous = limits.changes(recording, limits.PREVIOUS)
    np.testing.assert_allclose(previous.verifying[0], noload_uT[2, 0] - noload_uT[1].mean(axis=0), atol=1e-9)
    start = limits.changes(recording, limits.START)
    np.testing.assert_allclose(start.setting[-1], noload_uT[39, -1] - noload_uT[0].mean(axis=0), atol=1e-9)
    assert len(each.contact) == len(each.force_N) == 160
    # The first press is omitted, because it has no previous no-load reading.
    assert len(start.contact) == len(previous.force_N) == 156
    assert len(start.setting) + len(start.verifying) == 390


def test_contact_threshold_equals_that_of_the_live_page():
    recording = make_recording(drift_uT=0)
    quiet_uT = recording.noload_uT[recording.noload_press_i == 1]
    threshold_uT = limits.live_threshold(quiet_uT - quiet_uT.mean(axis=0))
    direction = np.eye(15)[3]
    touched_uT = quiet_uT.mean(axis=0) + np.array([threshold_uT - 0.1, threshold_uT + 0.1])[:, None] * direction
    b_uT = np.concatenate([quiet_uT, touched_uT]).astype(np.float32)
    times_s = np.arange(len(b_uT)) / 100
    log = estimate_after(len(quiet_uT), times_s, b_uT, [lambda db_uT: np.zeros((len(db_uT), 3), np.float32)])
    assert log.contact[-2:].tolist() == [False, True]


@pytest.fixture(scope="module")
def detection() -> tuple[dict, dict]:
    recordings = [make_recording("b1"), make_recording("b2", drift_uT=6.0, seed=4)]
    return limits.evaluate_detection(recordings, SECTION)


def test_older_no_load_readings_raise_the_threshold_and_the_smallest_detected_force(detection):
    numbers, _ = detection
    for board in ("b1", "b2"):
        by_rate = [row for row in numbers["rows"] if row["board"] == board and row["rule"] == limits.BY_RATE]
        assert [row["baseline"] for row in by_rate] == list(limits.BASELINES)
        for better, worse in pairwise(by_rate):
            assert better["threshold_uT"] < worse["threshold_uT"]
            assert better["needed_uT"] < worse["needed_uT"]
            assert better["power_law_N"] < worse["power_law_N"]
        assert by_rate[0]["detected_pct"] == 100
        assert by_rate[0]["smallest_N"] == pytest.approx(0.7, rel=0.11)  # Even the smallest of all forces is detected.
        # If the field change is assumed to be proportional to the force, the extrapolated force is larger than by a
        # power law with an exponent below 1.
        assert by_rate[0]["power_law_N"] < by_rate[0]["proportional_N"] < 0.7
        live = next(row for row in numbers["rows"] if row["board"] == board and row["rule"] == limits.BY_LIVE)
        assert live["false_alarm_pct"] == 0
    # The tolerance allows for noise of 4 uT.
    assert [law["exponent"] for law in numbers["laws"]] == pytest.approx([EXPONENT] * 2, abs=0.02)
    least, most = (numbers["by_force"][i] for i in (0, -1))
    assert (least["low_N"], most["high_N"]) == (0.5, 4)


def test_tables_and_figure_contain_all_results(scores, detection):
    numbers, drawn = detection
    results = {
        "registration": {"rows": limits.summarise_draws(scores), "seed": 2021}, "detection": numbers,
        "shear": limits.evaluate_shear(make_rows(True), SECTION, 2021),
    } | SECTION.model_dump(exclude={"methods"})  # fmt: skip
    tables = limits.tables(results, "recorded")
    assert set(tables) == {f"limits_{name}" for name in "registration forces shear detection by_force law".split()}
    for table in tables.values():
        assert (table["source"] == "recorded").all()
        assert not any("|" in str(column) for column in table.columns)  # The character | separates columns in Markdown.
    registration = tables["limits_registration"]
    # The regressor has three rows. Each of two variants of the model has four rows with unlabelled presses and four
    # without.
    assert len(registration) == 3 + 2 * 2 * 4
    assert "20 unlabelled presses" in registration.attrs["meaning"]
    forces = tables["limits_detection"]["force by power law, N"]
    assert forces[0].endswith("(extrapolated)")
    assert "threshold, baseline before each press" in limits.figures(results, drawn, "recorded")["recorded_limits.svg"]


# --- The whole stage ---

COLUMNS = ["indent", "phase", "x_mm", "y_mm"]
COLUMNS += [f"{name}{chip}" for chip in range(5) for name in ("T", "Bx", "By", "Bz")] + ["Fx", "Fy", "Fz"]


def write_capture(folder: Path, frame: Frame, board: str, force_N: float) -> None:
    """Write a synthetic recording in the layout `lab`, with one press at each place of the grid.

    It has noise, but no drift.
    """
    rng, place_mm = rng_for(0, board, force_N), grid()
    number = {"board1": np.array([0.5, -0.5, 0.3]), "board2": np.array([-0.5, 0.2, -0.3])}[board]
    force_N = force_N * rng.uniform(0.8, 1.2, len(place_mm))
    change_uT = poked_uT(place_mm, force_N, number).reshape(-1, 5, 3)
    # Fields are rotated from the axes of the board to those of the chips.
    change_uT = np.einsum("kji,nkj->nki", frame.turn, change_uT)
    lines = [",".join(COLUMNS)]
    for i, (label_mm, force) in enumerate(zip(frame.label(place_mm), force_N, strict=True)):
        for phase in ["noload"] * 3 + ["contact"] * 2:
            pressed = float(phase == "contact")
            b_uT = pressed * change_uT[i] + 100 * np.arange(15).reshape(5, 3) + 4 * rng.standard_normal((5, 3))
            fields = [f"21.5,{','.join(f'{value:.3f}' for value in chip_uT)}" for chip_uT in b_uT]
            forces = f"{0.1 * pressed * label_mm[0]:.3f},{0.02 * pressed * i:.3f},{-pressed * force:.3f}"
            lines.append(f"{i},{phase},{label_mm[0]:g},{label_mm[1]:g},{','.join(fields)},{forces}")
    folder.mkdir(parents=True)
    (folder / READINGS).write_text("\n".join(lines) + "\n")
    header = make_header(capture=folder.name, board=board, skin=f"skin of {board}".replace(" ", "-"))
    (folder / HEADER_FILE).write_text(render(header))


def test_whole_stage_runs_on_two_synthetic_boards(tmp_path, monkeypatch):
    settings = read_settings("lab", ROOT)
    content = {name: settings.of_scene[name] for name in ("seed", "selection", "compare", "recorded_limits")}
    changed = {"draws_n": 2, "presses_n": 12, "methods": "tiny", "false_alarm_fraction": 0.01}
    content["recorded_limits"] = content["recorded_limits"] | changed
    settings = replace(settings, of_scene=content, captures=())
    section = settings.section(Compare, "compare")
    frame = Frame(chip_rotations(section), section.labels_middle_mm, section.labels_mirrored)
    for board in ("board1", "board2"):
        for force_N in (1.0, 4.0):
            name = f"{board}_{force_N:g}N"
            write_capture(tmp_path / "raw" / name, frame, board, force_N)
            ingest(settings, tmp_path / "raw" / name, tmp_path / "indentations" / f"{name}.parquet")
    files = sorted((tmp_path / "indentations").glob("*.parquet"))
    rows = load_rows(files, settings.section(Selection, "selection"))
    io.write_json(tmp_path / "folds.json", render_folds([file.stem for file in files], rows, []))
    variant = make_variant()
    variants = Variants(variant, {"board1": variant, "board2": variant})
    monkeypatch.setattr(limits, "read_variants", lambda known, models: variants)
    # These "networks" always predict the middle of the skin.
    middle = [lambda db_uT: np.full((len(db_uT), 3), 8, np.float32)]
    monkeypatch.setattr(limits, "networks_held_out", lambda networks, board: middle)
    limits.recorded_limits(
        settings, settings.section(RecordedLimits, "recorded_limits"), tmp_path / "indentations", tmp_path / "raw",
        tmp_path / "folds.json", tmp_path, tmp_path, tmp_path / "results.json",
    )  # fmt: skip
    results = io.read_json(tmp_path / "results.json")
    numbers = results["numbers"]
    assert all(len(table) for table in limits.tables(numbers, "recorded").values())
    assert limits.figures(numbers, results["drawn"], "recorded")["recorded_limits.svg"].startswith("<?xml")
    registration = {(row["method"], row["presses_n"], row["known"]): row for row in numbers["registration"]["rows"]}
    constant = registration[limits.NETWORK, 0, limits.UNCHANGED]
    assert constant["accuracy_pct"]["mean"] < 5  # A constant prediction is right only for presses in the middle.
    labelled = registration["universal, simulated alone", 12, limits.LABELS]
    assert labelled["accuracy_pct"]["mean"] > 90  # The synthetic skins follow the formula of the map.
    (each, *_) = [row for row in numbers["detection"]["rows"] if row["board"] == "board2"]
    assert each["detected_pct"] == 100
    forces = {line["recording"]: line for line in numbers["shear"]["forces"]}
    # The force along x falls by 0.1 N per mm, and the mean of x is 8 mm.
    assert forces["board1_4N"]["Fx"]["mean_N"] == pytest.approx(-0.8, abs=1e-3)

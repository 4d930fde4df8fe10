"""Tests of the variants of the universal model: axes, recorded boards, saved networks, calibrated intervals."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from pipeline.training.universal import (
    NOMINAL_POWERS,
    PoolCalibration,
    Powers,
    best_powers,
    calibrate,
    calibrate_on_simulated,
    calibrate_to_simulated,
    draw_prior_skins,
    estimate,
    lower_by_labels,
    split_presses,
)
from pipeline.training.universal_variants import (
    READINGS_N,
    Frame,
    Variant,
    Variants,
    read_networks,
    recorded_board,
    write_networks,
)

from pipeline.training import universal
from reskin import io
from reskin.data.rows import Rows
from reskin.seeds import rng_for
from reskin.universal.batches import SkinPrior, TrainingSettings
from reskin.universal.calibration import LabelledPresses, variance_inflation
from reskin.universal.map import NOMINAL, NOMINAL_SPREADS, new_map
from reskin.universal.model import PriorModel
from reskin.universal.network import draw_weights, predict
from tests.universal.skins import SETUP, make_population, make_tables

QUARTER = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
FRAME = Frame(np.tile(QUARTER, (5, 1, 1)), (8.0, 7.0), mirrored=True)


def test_places_and_fields_are_converted_to_the_axes_of_the_model():
    label_mm = np.array([[8.0, 7.0], [9.0, 10.0]])
    np.testing.assert_allclose(FRAME.place(label_mm), [[0, 0], [1, -3]])
    np.testing.assert_allclose(FRAME.label(FRAME.place(label_mm)), label_mm)
    rotated = FRAME.field(np.tile([1.0, 2.0, 3.0], 5)[None])
    np.testing.assert_allclose(rotated, np.tile([-2.0, 1.0, 3.0], 5)[None])


def test_recorded_readings_are_grouped_by_press():
    # These are the readings of four presses. The third press has no force, and the last press is on another board.
    counts = [2, 150, 1, 3]
    press = np.repeat(np.arange(4), counts)
    board = np.where(press == 3, "other", "own")
    target = np.stack([8 + press, 7 + press, np.where(press == 2, 0.0, 1 + press)], axis=1).astype(np.float32)
    db_uT = np.tile(press[:, None] + 1, (1, 15)).astype(np.float32)
    names = np.array(["c"] * len(press)), board, board
    rows = Rows(*names, db_uT, target, np.zeros(len(press), np.int32), press, {})
    found = recorded_board(rows, FRAME, "own", np.ones(15))
    assert found.db_uT.shape == (2, READINGS_N, 15)
    np.testing.assert_allclose(found.place_mm, [[0, 0], [1, -1]])
    np.testing.assert_allclose(found.force_N, np.tile([[1], [2]], READINGS_N))
    np.testing.assert_allclose(found.db_uT[..., 2], np.tile([[1], [2]], READINGS_N))


def test_saved_networks_give_the_same_predictions(tmp_path):
    networks = [draw_weights(15, rng_for(0, "written", i)) for i in range(2)]
    model = PriorModel(new_map(make_tables()), networks)
    nominal, held_out = (
        Variant(SkinPrior(name, NOMINAL, NOMINAL_SPREADS, SETUP), model) for name in ("nominal", "without b1")
    )
    settings = TrainingSettings(skins_n=1, steps_n=2, seeds_n=2)
    write_networks(tmp_path / "universal", Variants(nominal, {"b1": held_out}), settings, 0)
    read = read_networks(tmp_path / "universal", "without b1")
    db_uT = rng_for(0, "readings").normal(0, 300, (3, 15))
    before, after = (predict(of, db_uT, np.zeros(15), db_uT) for of in (networks, read))
    np.testing.assert_array_equal(before.place_mm, after.place_mm)
    card = io.read_json(tmp_path / "universal/without-b1.json")
    assert "universal" in card["method"]
    assert card["spreads"] == NOMINAL_SPREADS


@pytest.fixture(autouse=True)
def _synthetic_skins(monkeypatch):
    draw = lambda centre, spreads, setup, n, rng, forces: make_population(n, rng)  # noqa: E731
    monkeypatch.setattr(universal, "draw_population", draw)


@pytest.fixture(scope="module")
def nominal() -> Variant:
    model = PriorModel(new_map(make_tables()), [draw_weights(15, rng_for(0, "powers"))])
    return Variant(SkinPrior("nominal", NOMINAL, NOMINAL_SPREADS, SETUP), model)


def unchanged(skins, rng):
    return skins.db_uT


def scaled_channels(skins, rng):
    return skins.db_uT * np.exp(0.5 * rng.standard_normal((len(skins), 1, 15)))


def calibrate_to_skin_with(nominal: Variant, error) -> tuple[PoolCalibration, LabelledPresses]:
    return calibrate_to_simulated(nominal.model, draw_prior_skins(nominal.prior, 1, 0, "asked", error), 0, 0)


def test_calibrated_likelihood_powers_give_intervals_that_cover_90_percent():
    found = [np.array([[0.5, 0.7], [0.9, 0.8], [1.0, 1.0]]), np.array([[0.7, 0.9], [0.9, 0.9], [1.0, 1.0]])]
    assert best_powers((1.0, 0.5, 0.1), found) == (0.5, 0.5)


def test_larger_misfit_widens_intervals_but_keeps_estimates(nominal):
    (fitting, _), (misfitting, tested) = (
        calibrate_to_skin_with(nominal, error) for error in (unchanged, scaled_channels)
    )
    assert misfitting.misfit > 2 * fitting.misfit
    powers = misfitting.nominal_powers(Powers(0.2, 0.1))
    assert powers.map == pytest.approx(min(1.0, 0.2 / misfitting.misfit))
    by_misfit = [replace(misfitting, misfit=misfit).nominal_powers(Powers(0.5, 0.5)) for misfit in (0.1, 1.0, 4.0)]
    assert by_misfit == [(1.0, 1.0), (0.5, 0.5), (0.125, 0.125)]
    for estimates in zip(*estimate(misfitting.with_labels(0), tested.db_uT, by_misfit), strict=True):
        for one, wider in pairwise(estimates):
            np.testing.assert_array_equal(one.place_mm, wider.place_mm)
            assert wider.sd_mm.mean() > one.sd_mm.mean()


@pytest.fixture
def exact_and_wrong_labels(nominal) -> tuple[PoolCalibration, PoolCalibration]:
    """Return the calibration of a skin with exact labels, and with labels that have independent errors of 3 mm."""
    exact, _ = calibrate_to_skin_with(nominal, unchanged)
    off_mm = 3 * rng_for(1, "labels").standard_normal(exact.pool.place_mm.shape)
    return exact, replace(exact, pool=replace(exact.pool, place_mm=exact.pool.place_mm + off_mm))


def test_errors_of_held_out_labels_lower_the_likelihood_power(exact_and_wrong_labels):
    powers = [Powers(0.3, 0.3), Powers(0.1, 0.1)]
    fitting_powers, misled_powers = (np.array(lower_by_labels(one, 40, powers)) for one in exact_and_wrong_labels)
    _, misled = exact_and_wrong_labels
    assert (misled_powers < fitting_powers / 2).all()
    assert lower_by_labels(misled, 0, [Powers(0.3, 0.2)]) == [(0.3, 0.2)]  # Without labels, the powers stay the same.
    # Forty wrong labels must lower the powers more than three wrong labels.
    assert (misled_powers < np.array(lower_by_labels(misled, 3, powers))).all()


def test_single_label_is_predicted_without_using_it(exact_and_wrong_labels):
    exact, misled = exact_and_wrong_labels
    (found,) = lower_by_labels(misled, 1, [Powers(0.3, 0.3)])
    (without,) = estimate(exact.with_labels(0), exact.pool.db_uT[:1], [Powers(0.3, 0.3)])
    errors = [np.abs(one.place_mm - misled.pool.place_mm[:1]) / one.sd_mm for one in without]
    assert found == pytest.approx([0.3 / variance_inflation(one) for one in errors])


def test_likelihood_powers_are_calibrated_for_all_numbers_of_labels(nominal, monkeypatch):
    monkeypatch.setattr(universal, "CALIBRATION_SKINS_N", 2)
    found = calibrate_on_simulated(nominal, (0, 40), seed=0)
    assert set(found) == {0, 40}
    assert set(np.ravel(list(found.values()))) <= set(NOMINAL_POWERS)


def test_calibration_line_corrects_the_forces_of_a_stiffer_skin():
    tables = make_tables()
    model = PriorModel(new_map(tables), [draw_weights(15, rng_for(0, "powers"))])
    skins = make_population(1, rng_for(3, "stiffer"))
    pool, tested = split_presses(skins, 0, seed=1)
    # On a skin that is twice as stiff, all forces are twice as large.
    pool, tested = (replace(part, force_N=2 * part.force_N) for part in (pool, tested))
    calibration = calibrate(model, skins.rest_uT[0].astype(float), pool)
    assert universal.fit_force_line(calibration, 4).mean[0] == 0  # Four labels are too few for the line.
    labelled = calibration.with_labels(0)
    corrected = replace(labelled, line=universal.fit_force_line(calibration, 40))
    errors = [
        np.abs(np.log(each.estimate(tested.db_uT, [0.5])[0].force_N / tested.force_N)).mean()
        for each in (labelled, corrected)
    ]
    assert errors[1] < errors[0]

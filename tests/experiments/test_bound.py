"""Tests of the lower bound on the errors of any unbiased estimate.

The bound is compared with simulated chips, a linear estimate and the field of a dipole.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.experiments.bound import (
    NETWORK,
    bound_errors,
    expected_scores,
    least_covariance,
    noise_var_uT2,
    probability_within,
    reach_skin,
    score_network,
    slopes,
    tables,
)
from reskin import io
from reskin.errors import ParamsError, SchemaError
from reskin.metrics import score
from reskin.physics.board import draw_board
from reskin.physics.chip import ChipDesign, read_field
from reskin.physics.skin import draw_skin
from reskin.seeds import rng_for
from tests.report.synthetic import scores
from tests.simulation.scene import synthesis

ROWS_N = 40_000
# The standard error of a sample variance is sqrt(2 / n), relative to the variance. Therefore SAMPLING * sqrt(2) is six
# standard errors.
SAMPLING = 6 / math.sqrt(ROWS_N)
CHIP = ChipDesign(gain_sel=6, noise_xy_uT=3.3, noise_z_uT=5.0, noise_temperature_degC=0.0)
SCENE = synthesis()
NO_LABEL_ERRORS = {"place_sd_mm": 0.0, "force_sd_N": 0.0}


def linear_sensor(rng):
    """Return the slopes of 15 channels and of the force, with respect to x, y and depth.

    The slopes along x and y are correlated. The force depends on the depth only.
    """
    db_slopes = rng.normal(size=(1, 15, 3)) * np.array([2.0, 3.0, 8.0])
    return db_slopes + 0.7 * db_slopes[:, :, [1, 0, 2]], np.array([[0.0, 0.0, 1.7]])


def test_errors_of_the_best_linear_estimate_equal_the_bound():
    rng = rng_for(1, "linear sensor")
    db_slopes, force_slopes = linear_sensor(rng)
    var_uT2 = np.tile([10.0, 10.0, 25.0], 5)
    labels = {"place_sd_mm": 0.3, "force_sd_N": 0.2}
    expected = expected_scores(least_covariance(db_slopes, force_slopes, var_uT2), **labels)
    truth = rng.uniform(-8, 8, size=(ROWS_N, 3))
    db_uT = truth @ db_slopes[0].T + np.sqrt(var_uT2) * rng.standard_normal((ROWS_N, 15))
    weighted = db_slopes[0] / np.sqrt(var_uT2)[:, None]
    estimated = np.linalg.lstsq(weighted, (db_uT / np.sqrt(var_uT2)).T, rcond=None)[0].T
    estimated[:, 2] *= force_slopes[0, 2]
    truth[:, 2] *= force_slopes[0, 2]
    label_errors = np.array([labels["place_sd_mm"]] * 2 + [labels["force_sd_N"]]) * rng.standard_normal((ROWS_N, 3))
    scores = score(truth + label_errors, estimated)
    assert 20 < scores["accuracy_pct"] < 98  # The accuracy is not close to 0 or 100 %, where any estimate would agree.
    assert expected["accuracy_pct"][0] == pytest.approx(scores["accuracy_pct"], abs=100 * SAMPLING / 2)
    assert expected["mse_xy_mm2"][0] == pytest.approx(scores["mse_xy_mm2"], rel=SAMPLING * math.sqrt(2))
    assert expected["mse_f_N2"][0] == pytest.approx(scores["mse_f_N2"], rel=SAMPLING * math.sqrt(2))


@given(st.floats(0.05, 5.0), st.floats(0.05, 5.0))
def test_probability_that_uncorrelated_errors_are_within_limits_is_the_product_of_two(h, k):
    expected = math.erf(h / math.sqrt(2)) * math.erf(k / math.sqrt(2))
    assert probability_within(np.array([[h, k]]), np.zeros(1))[0] == pytest.approx(expected, abs=1e-12)


@given(st.floats(0.1, 3.0), st.floats(0.1, 3.0), st.floats(-0.95, 0.95))
def test_probability_that_correlated_errors_are_within_limits_equals_an_integral(h, k, r):
    nodes, weights = np.polynomial.legendre.leggauss(200)
    x, root = h * nodes, math.sqrt(1 - r**2)
    reach = np.vectorize(math.erf)
    inner = (reach((k - r * x) / root / math.sqrt(2)) - reach((-k - r * x) / root / math.sqrt(2))) / 2
    expected = h * (weights * np.exp(-(x**2) / 2) * inner).sum() / math.sqrt(2 * math.pi)
    assert probability_within(np.array([[h, k]]), np.array([r]))[0] == pytest.approx(expected, abs=1e-10)


def test_noise_variance_equals_that_of_simulated_readings():
    board, readings_n, noload_n = draw_board(SCENE.main_boards.design, SCENE.spreads, seed=1, name="b0"), 2, 10
    no_field = np.zeros((ROWS_N // 4 * (readings_n + noload_n), 5, 3))
    b_uT = read_field(no_field, board, design=CHIP, rng=rng_for(1, "still"))[0].astype(float)
    dwells_uT = b_uT.reshape(-1, readings_n + noload_n, 15)
    db_uT = dwells_uT[:, :readings_n].mean(axis=1) - dwells_uT[:, readings_n:].mean(axis=1)
    expected = noise_var_uT2(CHIP, 5, readings_n=readings_n, noload_frames_n=noload_n)
    np.testing.assert_allclose(db_uT.var(axis=0), expected, rtol=SAMPLING * 2)


def test_slopes_of_a_dipole_field_equal_the_closed_form():
    def read(mm):  # The reading is Bz of a dipole along z, 3 mm above the chip. A poke moves the dipole down.
        x, y, z = mm[:, 0], mm[:, 1], 3.0 - mm[:, 2]
        r2 = x**2 + y**2 + z**2
        return ((3 * z**2 - r2) / r2**2.5)[:, None]

    pokes_mm = np.array([[1.0, 0.5, 0.4], [-2.0, 3.0, 1.2], [0.0, 0.0, 0.2]])
    x, y, z = pokes_mm[:, 0], pokes_mm[:, 1], 3.0 - pokes_mm[:, 2]
    r2 = x**2 + y**2 + z**2
    per_rho = (3 * r2 - 15 * z**2) / r2**3.5
    per_z = (9 * z * r2 - 15 * z**3) / r2**3.5
    expected = np.stack([x * per_rho, y * per_rho, -per_z], axis=1)[:, None]
    # Tolerance: the error of central differences is quadratic in their step.
    np.testing.assert_allclose(slopes(read, pokes_mm), expected, rtol=1e-3, atol=1e-6)


@given(st.floats(0.1, 10.0))
def test_bound_is_proportional_to_the_noise_and_halves_for_four_times_the_readings(factor):
    db_slopes, force_slopes = linear_sensor(rng_for(2, "linear sensor"))
    one, four = (noise_var_uT2(CHIP, 5, readings_n=n, noload_frames_n=10 * n) for n in (1, 4))
    least = least_covariance(db_slopes, force_slopes, one)
    noisier = least_covariance(db_slopes, force_slopes, factor**2 * one)
    fewer = least_covariance(db_slopes, force_slopes, four)
    np.testing.assert_allclose(noisier, factor**2 * least, rtol=1e-9)
    sds = [np.sqrt(np.diagonal(part, axis1=1, axis2=2)) for part in (fewer, least)]
    np.testing.assert_allclose(2 * sds[0], sds[1], rtol=1e-9)


def test_bound_is_smaller_for_deeper_presses_and_larger_with_label_errors():
    numbers = bound_errors(SCENE, seed=1)
    assert [row["depth_mm"] for row in numbers["by_depth"]] == sorted(SCENE.main.depths_mm)
    assert (numbers["places_n"], numbers["above_the_skin_n"]) == (65, 0)
    errors = [row["signal"]["mse_xy_mm2"] for row in numbers["by_depth"]]
    assert errors == sorted(errors, reverse=True)
    signal, scored = numbers["all"]["signal"], numbers["all"]["with_label_errors"]
    assert scored["mse_xy_mm2"] - signal["mse_xy_mm2"] == pytest.approx(SCENE.rig.robot_place_sd_mm**2)
    assert scored["mse_f_N2"] - signal["mse_f_N2"] == pytest.approx(SCENE.rig.force_noise_N**2)


def test_depths_at_which_the_tip_does_not_touch_the_skin_are_marked():
    skin = draw_skin(SCENE.skin, SCENE.spreads, seed=1, name="b0_s0", rule=SCENE.main_boards.quadrature.in_si())
    depths_mm = np.array([0.2, 0.6])
    assert reach_skin(replace(skin, depth_zero_m=-0.3e-3), depths_mm).tolist() == [False, True]
    with pytest.raises(ParamsError, match="the largest of depths_mm is 0.6 mm"):
        reach_skin(replace(skin, depth_zero_m=-0.7e-3), depths_mm)


def test_networks_that_were_trained_on_another_skin_are_refused(tmp_path):
    card = {"question": NETWORK, "recipe_name": "paper", "train_skins": ["b0_s1"]}
    io.write_json(tmp_path / "one.json", card)
    with pytest.raises(SchemaError, match="networks of single_pass were trained on .*, not on b0_s0"):
        score_network(tmp_path, "b0_s0")


BOUND = {"accuracy_pct": 99.5, "mse_xy_mm2": 0.01, "mse_f_N2": 0.002}
ROW = {"signal": BOUND, "with_label_errors": BOUND | {"mse_xy_mm2": 0.04}}
NUMBERS = {
    "board": "b0", "skin": "b0_s0", "places_n": 65, "above_the_skin_n": 0, "readings_n": 1, "noload_frames_n": 10,
    "labels": {"place_sd_mm": 0.05, "force_sd_N": 0.00625},
    "by_depth": [{"depth_mm": 0.2, **ROW}, {"depth_mm": 1.2, **ROW}], "all": ROW, "network": scores(),
}  # fmt: skip


def test_table_compares_the_network_with_the_bound():
    table = tables(NUMBERS, "simulated")["bound"]
    assert table["depth, mm"].tolist() == ["0.2", "1.2", "all"]
    assert table["MSE_xy, mm² (bound)"].tolist() == ["0.01"] * 3
    assert table["MSE_xy, mm² (bound with label errors)"].tolist() == ["0.04"] * 3
    assert table["MSE_xy, mm² (network)"].tolist() == ["–", "–", "1.00 ± 0.50"]
    assert set(table["source"]) == {"simulated"}


def test_caption_counts_presses_without_contact():
    assert "left out" not in tables(NUMBERS, "simulated")["bound"].attrs["meaning"]
    meaning = tables(NUMBERS | {"above_the_skin_n": 65}, "simulated")["bound"].attrs["meaning"]
    assert "65 pokes that do not touch the skin are excluded" in meaning

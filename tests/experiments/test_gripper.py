"""Tests of a simulated gripper that controls the estimated force, on a skin whose field is linear in the force."""

import numpy as np
import pytest

from pipeline.experiments import gripper
from pipeline.experiments.gripper import Finger, Gripper, Press, hold, hold_all, judge, scale_to_press
from pipeline.report import tables
from reskin.seeds import rng_for

FORCE_N = np.linspace(0, 3, 31)
DIRECTION = np.arange(1.0, 16.0)
SKIN_N_MM, GAIN_uT_PER_N = 2.0, 200.0
SETTINGS = Gripper(aims_N=(0.5, 1.0), stiffness_N_mm=(0.3, 3.0), gain_mm_N=0.5)


def finger(noise_uT=0.0):
    direction = DIRECTION / np.linalg.norm(DIRECTION)
    return Finger(
        "b0", FORCE_N, FORCE_N / SKIN_N_MM, GAIN_uT_PER_N * FORCE_N[:, None] * direction, np.full(15, 50.0), noise_uT
    )


def true_force(b_uT):
    return (b_uT - 50.0) @ DIRECTION / np.linalg.norm(DIRECTION) / GAIN_uT_PER_N


def test_force_in_equilibrium_is_that_of_skin_and_object_in_series():
    closed_mm, stiffness_N_mm = np.array([0.4, 0.4]), np.array([0.3, 3.0])
    both_N_mm = 1 / (1 / SKIN_N_MM + 1 / stiffness_N_mm)
    np.testing.assert_allclose(finger().squeezed_N(closed_mm, stiffness_N_mm), both_N_mm * closed_mm)


@pytest.mark.parametrize(("factor", "held"), [(1.0, 100.0), (1.3, 0.0)])
def test_gripper_controls_the_estimated_force(factor, held):
    """If the estimate is 1.3 times the true force, the true force settles at 1 / 1.3 of the aim."""
    held_N = hold(finger(), lambda b_uT: factor * true_force(b_uT), 1.0, SETTINGS, rng_for(0, "hold"))
    np.testing.assert_allclose(held_N[50:].mean(), 1 / factor, rtol=0.05)
    assert judge({"b0": [held_N]}, 1.0)["held_pct"] == held


def test_calibration_by_one_press_corrects_a_wrong_scale():
    skin = finger(noise_uT=1.0)
    press = Press(1.0, skin.read(np.ones(5), rng_for(0, "press")).mean(axis=0))
    forces = scale_to_press(lambda b_uT: 1.3 * true_force(b_uT), press)
    assert judge({"b0": [hold(skin, forces, 1.0, SETTINGS, rng_for(0, "hold"))]}, 1.0)["held_pct"] == 100.0


def test_opposite_errors_of_two_networks_do_not_cancel():
    settings = SETTINGS.model_copy(update={"aims_N": (1.0,)})
    networks = [
        lambda db_uT, factor=factor: factor * true_force(db_uT + 50.0)[:, None] + np.zeros(3) for factor in (0.7, 1.3)
    ]
    numbers, _ = hold_all([finger()], {"b0": networks}, settings, seed=1)
    row = numbers["rows"][0]
    assert (row["feedback"], row["press"], row["held_pct"], row["runs_n"]) == ("networks", "none", 0.0, 4)
    alone = [hold_all([finger()], {"b0": [one]}, settings, seed=1)[0]["rows"][0]["error_pct"] for one in networks]
    assert row["error_pct"].mean == pytest.approx(np.mean([one.mean for one in alone]))
    assert row["error_pct"].sd_seeds == pytest.approx(np.std([one.mean for one in alone], ddof=1))
    assert alone[0].sd_seeds is None
    assert numbers["seeds_n"] == 2


def test_results_have_a_row_for_each_aim_and_kind_of_feedback():
    settings = SETTINGS.model_copy(update={"aims_N": (0.5,)})
    networks = {"b0": [lambda db_uT: true_force(db_uT + 50.0)[:, None] + np.zeros(3)]}
    numbers, figure_data = hold_all([finger(noise_uT=1.0)], networks, settings, seed=1)
    assert [(row["aim_N"], row["feedback"], row["press"]) for row in numbers["rows"]] == [
        (0.5, "networks", "none"), (0.5, "networks", "factor"), (0.5, "shipped", "none"), (0.5, "shipped", "factor"),
        (0.5, "shipped", "label"),
    ]  # fmt: skip
    assert [row["runs_n"] for row in numbers["rows"]] == [2] * 5
    assert numbers["rows"][0]["held_pct"] == 100
    assert len(tables.gripper({"gripper": numbers})) == 5
    assert "0.5 N" in gripper.figures(numbers, figure_data, "simulated")["gripper.svg"]

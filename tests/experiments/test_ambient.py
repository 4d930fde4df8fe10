"""Tests of experiment ambient: readings in ambient fields and near iron, compensation, scores, tables, figures."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.constants import micro

from pipeline.experiments.ambient import (
    Iron,
    draw_instrument,
    figures,
    iron_balls,
    iron_fields,
    one_row_per_poke,
    project,
    readings_uT,
    reference_uT,
    remove_common_part,
    rms_uT,
    scores_by_field,
    tables,
    uniform_fields,
)
from reskin.physics.chip import ChipDesign, read_field, steps_uT
from reskin.physics.skin import draw_skin
from reskin.seeds import rng_for
from tests.report.synthetic import texts_of
from tests.simulation.scene import SECTIONS, synthesis

NO_SPREAD = {name: 0.0 for name in SECTIONS["spreads"] if name != "skin_filler_length_mm"}
QUIET = {"noise_xy_uT": 0.0, "noise_z_uT": 0.0}
SCENE = synthesis()
PERFECT = draw_instrument(synthesis("spreads", **NO_SPREAD), "b0", seed=1)
REAL = draw_instrument(SCENE, "b0", seed=1)
fields_T = st.tuples(*[st.floats(-1e-4, 1e-4)] * 3).map(np.array)
ROUNDING_uT = 1e-9  # This is an upper limit for the rounding error of fields of 100 uT.


def uniform(b_T, chips_n=5):
    return np.tile(b_T, (1, chips_n, 1))


@given(fields_T)
def test_ambient_field_changes_readings_as_it_changes_those_of_simulated_chips(b_T):
    chip = ChipDesign(gain_sel=6, noise_temperature_degC=0.0, **QUIET)
    at_rest, with_field = (
        read_field(uniform(field), REAL.board, design=chip, rng=rng_for(0, "x"))[0] for field in (0 * b_T, b_T)
    )
    # Tolerance: each reading is rounded by at most half a step, so the difference of two readings is off by at most one
    # step.
    assert np.abs((with_field - at_rest) - readings_uT(REAL.board, uniform(b_T))).max() <= steps_uT(6).max() * 1.001


@given(fields_T)
def test_compensation_on_a_perfect_board_removes_a_uniform_field(b_T):
    added_uT = readings_uT(PERFECT.board, uniform(b_T))
    projection = remove_common_part(PERFECT.turn)
    assert np.abs(added_uT @ projection.T).max() < ROUNDING_uT
    silent = replace(PERFECT, noise_uT=np.zeros(3))
    guess = reference_uT(silent, b_T[None], rng_for(0, "silent"))
    np.testing.assert_allclose(guess, added_uT, rtol=0, atol=ROUNDING_uT)


def test_compensation_leaves_a_residual_if_gains_and_tilts_of_chips_are_unknown():
    added_uT = readings_uT(REAL.board, uniform(np.array([0, 0, 5e-5])))
    residual_uT = added_uT @ remove_common_part(REAL.turn).T
    # Gain errors of 2.5 % and tilts of 2 degrees in a field of 50 uT leave a few uT.
    assert 0.1 < np.abs(residual_uT).max() < 10


def test_removal_of_the_common_part_is_an_orthogonal_projection():
    projection = remove_common_part(REAL.turn)
    np.testing.assert_allclose(projection @ projection, projection, atol=1e-12)
    np.testing.assert_allclose(projection, projection.T, atol=1e-12)
    assert np.linalg.matrix_rank(projection) == 15 - 3


def test_common_part_is_the_mean_field_of_the_chips_in_board_axes():
    db_uT = rng_for(0, "db").normal(0, 50, (4, 15)).astype(np.float32)
    naive = np.empty((4, 15))
    for i, row in enumerate(db_uT.reshape(4, 5, 3)):
        mean = np.mean([turn @ chip for turn, chip in zip(REAL.turn, row, strict=True)], axis=0)
        naive[i] = np.concatenate([chip - turn.T @ mean for turn, chip in zip(REAL.turn, row, strict=True)])
    # The tolerance is the rounding of 200 uT to single precision.
    np.testing.assert_allclose(project(db_uT, remove_common_part(REAL.turn)), naive, atol=1e-4)


def test_noise_of_the_reference_chip_is_averaged_over_its_readings():
    read_uT = reference_uT(PERFECT, np.zeros((4000, 3)), rng_for(0, "noise")).reshape(4000, 5, 3)[:, 0]
    # The estimate is the mean of 3 readings minus the mean of 4 no-load readings.
    expected_uT = np.array([3.3, 3.3, 5.0]) * np.sqrt(1 / 3 + 1 / 4)
    # The tolerance of 6 % is five standard errors.
    np.testing.assert_allclose(read_uT.std(axis=0), expected_uT, rtol=0.06)


def test_disturbance_by_an_iron_ball_falls_with_its_distance():
    skin = draw_skin(SCENE.skin, SCENE.spreads, seed=1, name="b0_s0", rule=SCENE.main_boards.quadrature.in_si())
    disturbances = [iron_fields(REAL, skin, radius_mm=5.0, distance_mm=mm) for mm in (2.0, 5.0, 20.0, 80.0)]
    chips_uT = [rms_uT(chips) for chips, _ in disturbances]
    assert chips_uT == sorted(chips_uT, reverse=True)
    assert rms_uT(disturbances[0][1]) < 0.2 * chips_uT[0]
    # At 80 mm, the ball is magnetised almost only by the earth's field, and the distances from the ball to the chips
    # are equal within 10 %.
    dipole_uT = 2 * 50 * (5 / 87) ** 3
    assert 0.4 * dipole_uT < chips_uT[-1] < 1.1 * dipole_uT


def test_row_has_an_ambient_field_of_the_same_direction_at_all_strengths():
    cases = list(uniform_fields(REAL, [10.0, 50.0], rows_n=60, rng=rng_for(0, "cases")))
    assert [case.keys["field_uT"] for case in cases] == [0.0, 10.0, 50.0]
    assert not cases[0].added_uT.any()
    np.testing.assert_allclose(cases[2].added_uT, 5 * cases[1].added_uT, rtol=1e-9)
    assert len(np.unique(cases[1].added_uT.round(6), axis=0)) == 60


def test_iron_ball_is_placed_over_the_skin_of_each_row():
    rule = SCENE.main_boards.quadrature.in_si()
    skins = [draw_skin(SCENE.skin, SCENE.spreads, seed=1, name=name, rule=rule) for name in ("b0_s0", "b0_s1")]
    (case,) = iron_balls(
        REAL, skins, np.array([1, 0, 1]), Iron(radius_mm=5.0, distances_mm=(2.0,)), rng=rng_for(0, "iron")
    )
    alone_T, _ = iron_fields(REAL, skins[0], radius_mm=5.0, distance_mm=2.0)
    np.testing.assert_allclose(case.added_uT[1], readings_uT(REAL.board, alone_T[None])[0], rtol=1e-9)
    np.testing.assert_array_equal(case.added_uT[0], case.added_uT[2])
    assert (case.added_uT[0] != case.added_uT[1]).all()


def test_one_random_row_of_each_press_is_kept():
    indentation = np.repeat(np.arange(8), 5)
    candidates = np.arange(5, 35)
    kept = one_row_per_poke(indentation, candidates, rng_for(0, "kept"))
    assert indentation[kept].tolist() == [1, 2, 3, 4, 5, 6]
    assert np.isin(kept, candidates).all()
    assert len(set(kept % 5)) > 1  # Which reading of a press is kept must be random.


def test_scores_are_averaged_over_boards():
    def point(board, method, accuracy, **keys):
        return {"board": board, "arm": method, "scores": {"accuracy_pct": accuracy, "mse_xy_mm2": 1.0}, **keys}

    points = [
        point("b0", "a", 80.0, field_uT=5.0), point("b1", "a", 60.0, field_uT=5.0),
        point("b1", "b", 50.0, field_uT=5.0), point("b0", "a", 90.0, field_uT=0.0),
        point("b0", "a", 70.0, distance_mm=2.0, rms_uT=3.0, aside_rms_uT=1.0),
        point("b1", "a", 70.0, distance_mm=2.0, rms_uT=4.0, aside_rms_uT=1.0),
    ]  # fmt: skip
    rows = scores_by_field(points, "field_uT", ["b0", "b1"])
    assert [row["field_uT"] for row in rows] == [0.0, 5.0]
    assert rows[1]["a"]["accuracy_pct"] == {
        "mean": 70.0, "n": 2, "sd": pytest.approx(np.sqrt(200)), "values": [80.0, 60.0],
    }  # fmt: skip
    assert rows[1]["b"]["accuracy_pct"] == {"mean": 50.0, "n": 1}
    # These scores belong to networks with a second seed.
    again = [point("b0", "a", 84.0, field_uT=5.0), point("b1", "a", 60.0, field_uT=5.0)]
    variant_a = scores_by_field([*points, *again], "field_uT", ["b0", "b1"])[1]["a"]["accuracy_pct"]
    assert (variant_a["mean"], variant_a["n"]) == (71.0, 2)  # The number n is that of boards, of which there are two.
    assert variant_a["sd_seeds"] == pytest.approx(np.sqrt(8) / 2)
    (iron,) = scores_by_field(points, "distance_mm", ["b0", "b1"])
    assert iron["field_uT"] == pytest.approx(np.sqrt(12.5))
    assert scores_by_field(points, "field_uT", ["b0"])[1]["a"]["accuracy_pct"]["mean"] == 80.0


def test_size_of_fields_is_the_root_mean_square_of_vector_lengths():
    assert rms_uT(np.array([[[3.0, 4.0, 0.0], [0.0, 0.0, 5.0]]]) * micro) == pytest.approx(5.0)


def scores(accuracy, boards_n):
    return {name: {"mean": accuracy, "n": boards_n} for name in ("accuracy_pct", "mse_xy_mm2", "mse_f_N2")}


def rows(boards_n):
    methods = {"a": scores(80.0, boards_n), "b": scores(70.0, boards_n), "c": scores(60.0, 1)}
    iron = {"distance_mm": 2.0, "field_uT": 44.0, "aside_field_uT": 2.0}
    return {"uniform": [{"field_uT": 0.0} | methods, {"field_uT": 50.0} | methods], "iron": [iron | methods]}


NUMBERS = {
    "arms": {"a": "as it is", "b": "a chip more", "c": "trained anew"}, "boards_n": 3, "seeds_n": 2,
    "directions": "random", "earth_uT": 50.0, "earth_dip_deg": 66.0, "iron_radius_mm": 10.0, **rows(3),
    "last_board": {"board": "b2"} | rows(1),
}  # fmt: skip


def test_variant_that_was_scored_on_one_board_is_listed_only_for_that_board():
    table = tables(NUMBERS, "simulated")["ambient"]
    assert set(table[table["boards"] == "all held out"]["method"]) == {"a", "b"}
    assert table[table["boards"] == "b2"]["method"].tolist() == ["a", "b", "c"] * 3
    assert set(table["source"]) == {"simulated"}
    assert "iron at 2 mm (44 µT at the chips)" in set(table["field"])
    assert "20 mm across" in table.attrs["meaning"]


def test_figure_has_labels():
    texts = figures(NUMBERS, {}, "simulated")
    keys = texts_of(texts["ambient.svg"])
    axes = ("uniform field / µT", "distance of the iron ball from the skin / mm")
    for label in ("a", "b", "c", *axes, "earth", "b2", "(simulated)"):
        assert label in keys.split() or label in keys
    assert figures(NUMBERS, {}, "simulated") == texts

"""Ambient fields and iron: readings of boards, what subtraction removes, scores, tables and figures."""

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
ROUNDING_uT = 1e-9  # of 100 uT


def uniform(b_T, chips_n=5):
    return np.tile(b_T, (1, chips_n, 1))


@given(fields_T)
def test_changes_of_readings_equal_those_of_simulated_chips(b_T):
    chip = ChipDesign(gain_sel=6, noise_temperature_degC=0.0, **QUIET)
    at_rest, with_field = (
        read_field(uniform(field), REAL.board, design=chip, rng=rng_for(0, "x"))[0] for field in (0 * b_T, b_T)
    )
    # Two readings, each rounded to half a step.
    assert np.abs((with_field - at_rest) - readings_uT(REAL.board, uniform(b_T))).max() <= steps_uT(6).max() * 1.001


@given(fields_T)
def test_both_methods_remove_a_uniform_field_from_a_perfect_board(b_T):
    added_uT = readings_uT(PERFECT.board, uniform(b_T))
    off = remove_common_part(PERFECT.turn)
    assert np.abs(added_uT @ off.T).max() < ROUNDING_uT
    silent = replace(PERFECT, noise_uT=np.zeros(3))
    guess = reference_uT(silent, b_T[None], rng_for(0, "silent"))
    np.testing.assert_allclose(guess, added_uT, rtol=0, atol=ROUNDING_uT)


def test_of_a_real_board_its_unknown_gains_and_tilts_stay():
    added_uT = readings_uT(REAL.board, uniform(np.array([0, 0, 5e-5])))
    left_uT = added_uT @ remove_common_part(REAL.turn).T
    assert 0.1 < np.abs(left_uT).max() < 10  # gains of 2.5 % and tilts of 2 degrees, of 50 uT


def test_taking_the_common_part_off_twice_takes_no_more():
    off = remove_common_part(REAL.turn)
    np.testing.assert_allclose(off @ off, off, atol=1e-12)
    np.testing.assert_allclose(off, off.T, atol=1e-12)
    assert np.linalg.matrix_rank(off) == 15 - 3


def test_the_common_part_is_the_mean_over_chips_in_the_boards_frame():
    db_uT = rng_for(0, "db").normal(0, 50, (4, 15)).astype(np.float32)
    naive = np.empty((4, 15))
    for i, row in enumerate(db_uT.reshape(4, 5, 3)):
        mean = np.mean([turn @ chip for turn, chip in zip(REAL.turn, row, strict=True)], axis=0)
        naive[i] = np.concatenate([chip - turn.T @ mean for turn, chip in zip(REAL.turn, row, strict=True)])
    np.testing.assert_allclose(project(db_uT, remove_common_part(REAL.turn)), naive, atol=1e-4)  # float32 of 200 uT


def test_the_chip_aside_is_as_noisy_as_the_means_of_its_readings():
    drawn_uT = reference_uT(PERFECT, np.zeros((4000, 3)), rng_for(0, "noise")).reshape(4000, 5, 3)[:, 0]
    expected_uT = np.array([3.3, 3.3, 5.0]) * np.sqrt(1 / 3 + 1 / 4)  # readings and no-load frames of the scene
    np.testing.assert_allclose(drawn_uT.std(axis=0), expected_uT, rtol=0.06)  # five sd of an sd from 4000


def test_iron_is_felt_less_far_away_and_less_by_the_chip_aside():
    skin = draw_skin(SCENE.skin, SCENE.spreads, seed=1, name="b0_s0", rule=SCENE.main_boards.quadrature.in_si())
    both = [iron_fields(REAL, skin, radius_mm=5.0, distance_mm=mm) for mm in (2.0, 5.0, 20.0, 80.0)]
    chips_uT = [rms_uT(chips) for chips, _ in both]
    assert chips_uT == sorted(chips_uT, reverse=True)
    assert rms_uT(both[0][1]) < 0.2 * chips_uT[0]
    # Far away only the earth magnetises it: its dipole is then at the same distance of all chips, within 10 %.
    dipole_uT = 2 * 50 * (5 / 87) ** 3
    assert 0.4 * dipole_uT < chips_uT[-1] < 1.1 * dipole_uT


def test_each_row_keeps_its_direction_and_each_strength_adds_in_proportion():
    cases = list(uniform_fields(REAL, [10.0, 50.0], rows_n=60, rng=rng_for(0, "cases")))
    assert [case.keys["field_uT"] for case in cases] == [0.0, 10.0, 50.0]
    assert not cases[0].added_uT.any()
    np.testing.assert_allclose(cases[2].added_uT, 5 * cases[1].added_uT, rtol=1e-9)
    assert len(np.unique(cases[1].added_uT.round(6), axis=0)) == 60


def test_each_row_has_the_iron_over_its_own_skin():
    rule = SCENE.main_boards.quadrature.in_si()
    skins = [draw_skin(SCENE.skin, SCENE.spreads, seed=1, name=name, rule=rule) for name in ("b0_s0", "b0_s1")]
    (case,) = iron_balls(
        REAL, skins, np.array([1, 0, 1]), Iron(radius_mm=5.0, distances_mm=(2.0,)), rng=rng_for(0, "iron")
    )
    alone_T, _ = iron_fields(REAL, skins[0], radius_mm=5.0, distance_mm=2.0)
    np.testing.assert_allclose(case.added_uT[1], readings_uT(REAL.board, alone_T[None])[0], rtol=1e-9)
    np.testing.assert_array_equal(case.added_uT[0], case.added_uT[2])
    assert (case.added_uT[0] != case.added_uT[1]).all()


def test_one_row_of_every_poke_is_kept():
    indentation = np.repeat(np.arange(8), 5)
    own = np.arange(5, 35)
    kept = one_row_per_poke(indentation, own, rng_for(0, "kept"))
    assert indentation[kept].tolist() == [1, 2, 3, 4, 5, 6]
    assert np.isin(kept, own).all()
    assert len(set(kept % 5)) > 1  # not always the first reading


def test_arms_are_put_together_over_the_boards_that_they_were_tried_on():
    def point(board, arm, accuracy, **words):
        return {"board": board, "arm": arm, "scores": {"accuracy_pct": accuracy, "mse_xy_mm2": 1.0}, **words}

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
    again = [point("b0", "a", 84.0, field_uT=5.0), point("b1", "a", 60.0, field_uT=5.0)]  # of other seeds
    both = scores_by_field([*points, *again], "field_uT", ["b0", "b1"])[1]["a"]["accuracy_pct"]
    assert (both["mean"], both["n"]) == (71.0, 2)  # boards
    assert both["sd_seeds"] == pytest.approx(np.sqrt(8) / 2)
    (iron,) = scores_by_field(points, "distance_mm", ["b0", "b1"])
    assert iron["field_uT"] == pytest.approx(np.sqrt(12.5))
    assert scores_by_field(points, "field_uT", ["b0"])[1]["a"]["accuracy_pct"]["mean"] == 80.0


def test_a_fields_size_is_that_of_its_vectors():
    assert rms_uT(np.array([[[3.0, 4.0, 0.0], [0.0, 0.0, 5.0]]]) * micro) == pytest.approx(5.0)


def scores(accuracy, boards_n):
    return {name: {"mean": accuracy, "n": boards_n} for name in ("accuracy_pct", "mse_xy_mm2", "mse_f_N2")}


def rows(boards_n):
    arms = {"a": scores(80.0, boards_n), "b": scores(70.0, boards_n), "c": scores(60.0, 1)}
    iron = {"distance_mm": 2.0, "field_uT": 44.0, "aside_field_uT": 2.0}
    return {"uniform": [{"field_uT": 0.0} | arms, {"field_uT": 50.0} | arms], "iron": [iron | arms]}


NUMBERS = {
    "arms": {"a": "as it is", "b": "a chip more", "c": "trained anew"}, "boards_n": 3, "seeds_n": 2,
    "directions": "random", "earth_uT": 50.0, "earth_dip_deg": 66.0, "iron_radius_mm": 10.0, **rows(3),
    "last_board": {"board": "b2"} | rows(1),
}  # fmt: skip


def test_an_arm_of_one_board_stands_beside_others_on_that_board_alone():
    table = tables(NUMBERS, "simulated")["ambient"]
    assert set(table[table["boards"] == "all held out"]["method"]) == {"a", "b"}
    assert table[table["boards"] == "b2"]["method"].tolist() == ["a", "b", "c"] * 3
    assert set(table["source"]) == {"simulated"}
    assert "iron at 2 mm (44 µT at the chips)" in set(table["field"])
    assert "20 mm across" in table.attrs["meaning"]


def test_the_figure_names_arms_units_the_earth_the_board_and_the_source():
    drawn = figures(NUMBERS, {}, "simulated")
    words = texts_of(drawn["ambient.svg"])
    for word in ("a", "b", "c", "uniform field / µT", "iron ball above the skin / mm", "earth", "b2", "(simulated)"):
        assert word in words.split() or word in words
    assert figures(NUMBERS, {}, "simulated") == drawn

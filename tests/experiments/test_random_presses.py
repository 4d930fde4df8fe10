"""Tests of experiment random_presses, which check how presses are drawn and scored, and what the table contains."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pipeline.training.universal_variants import Variant, Variants
from sklearn.metrics import mean_squared_error, median_absolute_error, r2_score

from pipeline.experiments.random_presses import (
    CHECKERBOARD,
    HALVES,
    NEAREST,
    WEIGHT,
    BoardPresses,
    RandomPresses,
    draw_presses,
    force_scores,
    label_sets,
    score_draw,
    score_nearest,
    summarise_rows,
    tables,
)
from reskin.errors import SchemaError
from reskin.seeds import rng_for
from reskin.universal.batches import SkinPrior
from reskin.universal.calibration import LabelledPresses, LikelihoodPowers
from reskin.universal.map import NOMINAL, NOMINAL_SPREADS, new_map
from reskin.universal.model import PriorModel
from reskin.universal.network import draw_weights
from reskin.universal.population import grid
from tests.universal.skins import SETUP, make_tables, poked_uT

DEPTHS_N, READINGS_N = 3, 2
POWERS = LikelihoodPowers({12: {0: 0.5, 40: 0.5}, 65: {0: 0.5, 40: 0.5}}, {0: 0.5})


def make_board(seed: int = 0) -> BoardPresses:
    """Return presses on a synthetic board: three forces at each place of the grid, with two readings per press."""
    rng = rng_for(seed, "random presses")
    place_mm = np.repeat(grid(), DEPTHS_N, axis=0)
    force_N = np.tile([0.8, 2.0, 5.0], len(grid())) * rng.uniform(0.8, 1.2, len(place_mm))
    presses = LabelledPresses(place_mm, force_N, poked_uT(place_mm, force_N, np.array([0.5, -0.5, 0.3])))
    press_i = np.repeat(np.arange(len(place_mm)), READINGS_N)
    return BoardPresses("b1", np.zeros(15), presses, presses[press_i], press_i)


def test_force_scores_equal_those_of_scikit_learn():
    rng = np.random.default_rng(5)
    true_N, force_N = rng.uniform(0, 3, (2, 40))
    scores = force_scores(force_N, true_N)
    assert scores["mse_f_N2"] == pytest.approx(mean_squared_error(true_N, force_N))
    assert scores["median_error_N"] == pytest.approx(median_absolute_error(true_N, force_N))
    assert scores["r2_f"] == pytest.approx(r2_score(true_N, force_N))


@pytest.fixture(scope="module")
def board() -> BoardPresses:
    return make_board()


@settings(max_examples=20, deadline=None)
@given(st.sampled_from([CHECKERBOARD, HALVES]), st.integers(0, 11), st.integers(1, 65))
def test_tested_presses_are_not_used_for_calibration_and_are_far_from_labels(split, draw_i, presses_n):
    board = make_board()
    draw = draw_presses(board, split, presses_n, 2021, draw_i)
    tested = np.unique(board.press_i[draw.tested])
    assert not set(tested) & {*draw.unlabelled, *draw.labels, *draw.weight}
    assert len(draw.unlabelled) == presses_n == len(set(draw.unlabelled))
    labelled_mm, tested_mm = board.presses.place_mm[draw.labels], board.presses.place_mm[tested]
    distance_mm = np.linalg.norm(labelled_mm[:, None] - tested_mm, axis=2)
    assert distance_mm.min() >= (2 if split == CHECKERBOARD else 4) - 1e-9  # Places of the grid are 2 mm apart.
    assert (np.abs(board.presses.place_mm[draw.weight]) < 1).all()
    assert np.linalg.norm(tested_mm - board.presses.place_mm[draw.weight], axis=1).min() >= 2 - 1e-9


def test_tested_and_calibrated_parts_are_exchanged_in_every_second_draw(board):
    for split in (CHECKERBOARD, HALVES):
        np.testing.assert_array_equal(board.part(split, 0), -board.part(split, 1))
    assert len({tuple(board.part(HALVES, i)) for i in range(4)}) == 4


def test_board_without_a_press_in_the_middle_is_refused(board):
    outside = np.flatnonzero(~board.middle)
    reduced = replace(board, presses=board.presses[outside])
    with pytest.raises(SchemaError, match="no press within 1 mm of the middle"):
        draw_presses(reduced, CHECKERBOARD, 12, 2021, 0)


def test_more_labels_than_presses_are_refused(board):
    draw = draw_presses(board, CHECKERBOARD, 12, 2021, 0)
    with pytest.raises(SchemaError, match="presses for labels, but labels_n asks for 500"):
        label_sets(board, draw, (0, 500))


def test_nearest_label_method_is_exact_for_the_labelled_presses(board):
    scores = score_nearest(board.presses, board.presses)
    assert scores["accuracy_pct"] == 100
    assert scores["r2_f"] == 1
    assert scores["mse_f_N2"] == scores["median_error_N"] == 0
    assert scores["r2_line_f"] == pytest.approx(0)  # This is the score of a constant estimate, which is the mean force.


@pytest.fixture(scope="module")
def rows(board) -> list[dict]:
    model = PriorModel(new_map(make_tables()), [draw_weights(15, rng_for(0, "random presses"))])
    variant = Variant(SkinPrior("nominal", NOMINAL, NOMINAL_SPREADS, SETUP), model)
    section = RandomPresses(presses_n=(12, 65), labels_n=(0, 10), draws_n=1)
    variants = Variants(variant, {"b1": variant})
    return score_draw(board, variants, POWERS, section, 2021, 0)


def test_each_combination_of_settings_is_scored(rows):
    names = {(row["tested"], row["presses_n"], row["method"], row["labels"]) for row in rows}
    universal = {name for name in names if name[2] != NEAREST}
    assert {name[3] for name in universal} == {"0", WEIGHT, "10"}
    # Each of the two variants has scores for three numbers of labels with 65 presses, for two with 12 presses, and for
    # three if labels and tested presses are on different halves of the skin.
    assert len(universal) == 2 * (3 + 2 + 3)
    assert {name[:2] for name in names if name[2] == NEAREST} == {(CHECKERBOARD, 65), (HALVES, 65)}


def test_labels_reduce_errors_of_places_and_forces(rows):
    def mean(labels: str, metric: str) -> float:
        values = [row[metric] for row in rows if row["labels"] == labels and row["tested"] == CHECKERBOARD
                  and row["method"] != NEAREST and row["presses_n"] == 65]  # fmt: skip
        return float(np.mean(values))

    assert mean("10", "mse_xy_mm2") < mean("0", "mse_xy_mm2")
    # The synthetic skin follows the formula of the model. A constant force would have a score of about 0.
    assert mean("10", "r2_f") > 0.8


def test_table_has_a_row_for_each_setting_and_names_its_source(rows):
    summary = summarise_rows(rows)
    (table,) = tables({"rows": summary, "draws_n": 1}, "recorded").values()
    assert len(table) == len(summary)
    assert (table["source"] == "recorded").all()
    best = next(row for row in summary if row["labels"] == "10" and row["method"] != NEAREST)
    assert best["accuracy_pct"]["n"] == 1  # The number n is that of boards, of which there is one.

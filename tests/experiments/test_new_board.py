"""Tests of experiment new_board: draws, methods, contact and summaries, on a simulated skin."""

from dataclasses import replace
from functools import cache

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import reskin
from pipeline.experiments.new_board import (
    AGES,
    CHECKERBOARD,
    GRID,
    HALVES,
    SHIPPED,
    Board,
    NewBoard,
    draw_presses,
    score_contact,
    score_draw,
    splits_of,
    summarise,
    tabulate_draws,
)
from pipeline.scores import make_table
from pipeline.training.methods import (
    Case,
    InContext,
    Prediction,
    Registered,
    Samples,
    constant,
    gaussian_process,
    kernel_ridge,
    score_prediction,
)
from reskin.errors import SchemaError
from reskin.metrics import score
from reskin.universal.layout import paper_layout
from reskin.universal.model import FILE
from reskin.universal.population import grid

SECTION = NewBoard(presses_n=(12,), labels_n=(0, 1, 10), draws_n=2)
MIDDLE_MM = (8.0, 8.0)
FEW = settings(max_examples=20, deadline=None)


@cache
def make_board(seed: int = 1) -> Board:
    """Return a board whose skin was pressed twice at each place of the grid, with two readings per press."""
    place_mm = np.repeat(grid(paper_layout().area) + MIDDLE_MM, 2, axis=0)
    depth_mm = np.tile([0.6, 1.0], len(place_mm) // 2)
    before_uT, pressed_uT, force_N = reskin.simulate_pokes(
        reskin.draw_skin(seed=seed), np.column_stack([place_mm, depth_mm]), board=reskin.draw_board(seed=seed)
    )
    noload_uT = before_uT.mean(axis=0, dtype=float)
    presses, press_i = (
        Samples(place_mm, force_N, noload_uT + pressed_uT - before_uT),
        np.repeat(np.arange(len(place_mm)), 2),
    )
    return Board(f"b{seed}", f"b{seed}_s0", noload_uT, presses, presses[press_i], press_i, press_i, press_i, MIDDLE_MM)


def case_of(board: Board, labels: np.ndarray, tested: np.ndarray) -> Case:
    none = board.presses[labels[:0]]
    return Case(board.noload_uT, board.presses.b_uT, board.presses[labels], none, board.presses.b_uT[tested])


@FEW
@given(st.sampled_from([CHECKERBOARD, HALVES, GRID]), st.integers(0, 9))
def test_tested_presses_are_used_for_nothing_else(split, draw_i):
    board = make_board()
    draw = draw_presses(board, split, 12, 0, draw_i)
    assert not {*draw.tested} & {*draw.unlabelled, *draw.labels, *draw.middle}
    off_mm = board.presses.place_mm - MIDDLE_MM
    if split == GRID:
        assert len(np.unique(board.presses.place_mm[draw.unlabelled], axis=0)) == len(draw.unlabelled) == 12
        assert {*draw.labels} == {*draw.unlabelled}
    elif split == HALVES:
        axis = draw_i // 2 % 2
        assert (np.sign(off_mm[draw.labels, axis]) == -np.sign(off_mm[draw.tested[0], axis])).all()
    else:
        colours = [{*np.rint(off_mm[part] / 2).astype(int).sum(axis=1) % 2} for part in (draw.labels, draw.tested)]
        assert colours in ([{0}, {1}], [{1}, {0}])
    assert (np.abs(off_mm[draw.middle]) < 1).all()


def test_draws_of_a_skin_do_not_depend_on_other_settings_and_differ_from_each_other():
    first, again, second = (draw_presses(make_board(), HALVES, n, 0, i) for n, i in ((12, 0), (12, 0), (12, 1)))
    assert first.labels.tolist() == again.labels.tolist() != second.labels.tolist()


def test_board_with_too_few_presses_is_refused():
    board = make_board()
    few = np.arange(4)
    small = replace(board, presses=board.presses[few])
    with pytest.raises(SchemaError, match="has only 4 presses"):
        draw_presses(small, CHECKERBOARD, 12, 0, 0)
    assert splits_of(board, 65) == [CHECKERBOARD, HALVES, GRID]
    assert splits_of(replace(board, presses=board.presses[np.arange(0, 130, 2)]), 65) == [CHECKERBOARD, HALVES]


@FEW
@given(st.floats(-3, 3), st.floats(-5, 5), st.floats(-5, 5), st.integers(2, 9))
def test_registration_removes_any_rotation_and_shift(angle, x_mm, y_mm, known_n):
    board, labels = make_board(), np.arange(0, 130, 130 // known_n)
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    place_of = {
        b_uT.tobytes(): place_mm for b_uT, place_mm in zip(board.presses.b_uT, board.presses.place_mm, strict=True)
    }

    def turned(case: Case) -> Prediction:
        place_mm = np.array([place_of[b_uT.tobytes()] for b_uT in case.tested_uT]) @ rotation + (x_mm, y_mm)
        return Prediction(np.column_stack([place_mm, np.ones(len(place_mm))]))

    found = Registered(turned)(case_of(board, labels, np.arange(130))).target
    np.testing.assert_allclose(found[:, :2], board.presses.place_mm, atol=1e-9)  # rounding of double precision


def test_methods_that_learn_from_labels_reproduce_labels_and_improve_with_them():
    board, tested = make_board(), np.arange(1, 130, 2)
    errors = {}
    for name, method in {"gp": gaussian_process, "ridge": kernel_ridge, "constant": constant}.items():
        for n in (8, 65):
            case = case_of(board, np.arange(0, 130, 2)[:: 65 // n], tested)
            if name == "ridge":
                other = make_board(2)
                case = replace(case, others=replace(other.presses, b_uT=other.presses.b_uT - other.noload_uT))
            errors[name, n] = score(board.presses.target[tested], method(case).target)["mse_xy_mm2"]
    assert errors["gp", 65] < errors["gp", 8] < errors["constant", 8]
    assert errors["ridge", 65] < errors["ridge", 8] < errors["constant", 8]
    labels = np.arange(5)
    mean = constant(case_of(board, labels, tested)).target
    np.testing.assert_allclose(mean, np.tile(board.presses.target[labels].mean(axis=0), (len(tested), 1)))


def test_mirrored_labels_give_mirrored_estimates():
    board, tested = make_board(), np.arange(0, 130, 5)
    plain, mirrored = (InContext(FILE, flag, MIDDLE_MM) for flag in (False, True))
    case = case_of(board, np.arange(10), tested)
    flipped = replace(case.labels, place_mm=case.labels.place_mm * (1, -1) + (0, 16))
    expected = plain(case).target * (1, -1, 1) + (0, 16, 0)
    np.testing.assert_allclose(mirrored(replace(case, labels=flipped)).target, expected, atol=1e-9)


def test_a_row_is_reproduced_by_the_public_interface_from_a_saved_draw():
    board = make_board()
    draw = draw_presses(board, CHECKERBOARD, 12, 0, 0)
    rows = score_draw(board, draw, SECTION, {SHIPPED: [InContext(FILE, False, MIDDLE_MM)]}, board.presses)
    saved = tabulate_draws(board, [draw])
    part = {name: group.sort_values("order")["press"].to_numpy() for name, group in saved.groupby("part")}
    model = reskin.load_universal().zero(board.noload_uT).see(board.presses.b_uT[part["unlabelled"]])
    labels = board.presses[part["labels"][:10]]
    model.label(labels.place_mm, labels.force_N, labels.b_uT)
    readings = board.readings_of(part["tested"])
    (row,) = [row for row in rows if row["labels_n"] == 10]
    expected = score(readings.target, model.predict(readings.b_uT))
    assert {name: row[name] for name in expected} == expected
    assert {row["labels_n"] for row in rows} == {0, 1, 10}


def test_coverage_is_the_percentage_of_true_values_inside_the_intervals():
    readings = Samples(np.zeros((4, 2)), np.array([1.0, 2.0, 3.0, 4.0]), np.zeros((4, 15)))
    low = np.array([[-1, -1, 0], [1, -1, 0], [-1, 1, 0], [-1, -1, 9]], float)
    scores = score_prediction(readings, Prediction(np.zeros((4, 3)), low, low + 2))
    assert (scores["coverage_pct"], scores["coverage_f_pct"]) == (100 * 6 / 8, 100 * 2 / 4)
    assert "coverage_pct" not in score_prediction(readings, Prediction(np.zeros((4, 3))))


def test_old_noload_reading_causes_false_touches_if_the_field_drifts():
    rng = np.random.default_rng(0)
    presses_n, readings_n = 20, 10
    quiet_i = np.repeat(np.arange(presses_n), readings_n)
    drift_uT = 10.0 * quiet_i[:, None] * np.ones(15)
    quiet_uT = drift_uT + rng.normal(0, 1, (len(quiet_i), 15))
    touched_uT = quiet_uT + 500.0
    part = quiet_i, quiet_uT, quiet_i, touched_uT, np.full(len(quiet_i), 2.0)
    rows = {row["split"]: row for row in score_contact({"b1": [part]})}
    assert tuple(rows) == AGES
    assert rows["each"]["false_pct"] == 0.0
    assert rows["previous"]["false_pct"] == rows["initial"]["false_pct"] == 100.0  # the drift is 39 uT per press
    assert all(row["missed_pct"] == 0.0 for row in rows.values())


def test_summary_equals_loops_over_boards_and_draws():
    rng = np.random.default_rng(1)
    rows = [
        {
            "experiment": "new_board",
            "method": method,
            "board": board,
            "skin": f"{board}_s{i}",
            "split": GRID,
            "draw": draw,
        }
        | {"pokes_n": 65, "labels_n": 0, "accuracy_pct": rng.uniform(0, 100), "mse_f_N2": rng.uniform(0, 4)}
        for method in (SHIPPED, "multi")
        for board in ("b1", "b2")
        for i in range(2)
        for draw in range(3)
    ]
    shipped, multi = summarise(make_table(rows), {})
    frame = pd.DataFrame(rows)

    def mean(method: str, board: str, draw: int) -> float:
        chosen = (frame["method"] == method) & (frame["board"] == board) & (frame["draw"] == draw)
        return float(frame[chosen]["accuracy_pct"].sum() / 2)

    by_board = {board: np.mean([mean("multi", board, draw) for draw in range(3)]) for board in ("b1", "b2")}
    assert multi["accuracy_pct"]["by_board"] == pytest.approx(by_board)
    assert multi["accuracy_pct"]["mean"] == pytest.approx(np.mean(list(by_board.values())))
    over = [np.mean([mean("multi", b, d) - mean(SHIPPED, b, d) for b in ("b1", "b2")]) for d in range(3)]
    assert multi["minus_shipped"]["accuracy_pct"]["mean"] == pytest.approx(np.mean(over))
    assert multi["minus_shipped"]["accuracy_pct"]["sd_draws"] == pytest.approx(np.std(over, ddof=1))
    assert "minus_shipped" not in shipped
    assert (shipped["method"], shipped["split"], shipped["pokes_n"], shipped["labels_n"]) == (SHIPPED, GRID, 65, 0)
